"""What the user sees: one line on stdout, everything else on stderr."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bar
from rich.text import Text

from mv3d_cli.errors import Mv3dError, UsageError
from mv3d_cli.steps.settings import Progress, Tell, Warned
from mv3d_cli.store import Artifact, deliver

PATIENCE = 2.0  # seconds of work before a bar appears

stderr = Console(stderr=True, soft_wrap=True, highlight=False)


def show_error(error: Mv3dError) -> None:
    """One line that says what is wrong, one that says what to do."""
    _print("error:", "bold red", str(error))
    _print("hint:", "bold", error.hint)


def warn(text: str) -> None:
    _print("warning:", "yellow", text)


def show_result(artifact: Artifact, output: Path | None, as_json: bool) -> None:
    """Copies the result to `output`, if one is wanted, and prints where it is, or its manifest, alone on stdout."""
    path = deliver(artifact, output) if output is not None else artifact.path
    manifest = {**artifact.manifest, "path": str(path)}
    print(json.dumps(manifest, indent=2, sort_keys=True) if as_json else path, flush=True)


def _print(label: str, style: str, text: str) -> None:
    """One line, in which nothing is markup: it may name any file."""
    stderr.print(Text.assemble((label, style), " ", " ".join(text.split())))


@contextmanager
def progress_bar() -> Iterator[Tell]:
    """What a step tells becomes a bar with rate and time left (after two seconds), and warnings."""
    rate = TextColumn("{task.fields[rate]}")
    note = TextColumn("{task.fields[note]}")
    columns = [BarColumn(), MofNCompleteColumn(), TextColumn("{task.description}"), note, rate, TimeElapsedColumn()]
    bar = Bar(*columns, TextColumn("left"), TimeRemainingColumn(), console=stderr, transient=True)
    task = bar.add_task("", total=None, rate="", note="")

    def tell(event: Progress | Warned) -> None:
        if isinstance(event, Warned):
            warn(event.text)
            return
        elapsed = bar.tasks[task].elapsed or 0.0
        rate = f"{event.done / elapsed:.1f} {event.unit}/s" if elapsed > 0 else ""
        bar.update(task, completed=event.done, total=event.total, description=event.unit, rate=rate, note=event.note)
        if elapsed > PATIENCE and stderr.is_terminal and not bar.live.is_started:
            bar.start()

    bar.start_task(task)
    try:
        yield tell
    finally:
        if bar.live.is_started:  # or it would print an empty line
            bar.stop()


def path_from_stdin() -> Path:
    """The path that an earlier command printed, for an input given as `-`. UsageError if there is none."""
    if sys.stdin is None or sys.stdin.isatty():
        raise UsageError("'-' reads a path from standard input, which is a terminal", "pipe another command's output")
    line = sys.stdin.readline().strip()
    if not line:
        raise UsageError("standard input held no path", "the command before the pipe may have failed; see its error")
    return Path(line)
