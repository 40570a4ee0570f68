"""`mv3d generate`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from mv3d_cli.cli.console import progress_bar, show_result
from mv3d_cli.cli.options import Json, Output, with_settings
from mv3d_cli.errors import UsageError
from mv3d_cli.steps.generate import Config, run
from mv3d_cli.store import check_output

app = typer.Typer(add_completion=False)

_MOST = 2**29  # bytes of a photo
_LONGEST_PATH = 4096


@app.command()
@with_settings(Config)
def generate(
    config: Config,
    photo: Annotated[str, typer.Argument(metavar="PHOTO|-", help="A photo of one object; -: its path, or its bytes.")],
    output: Output = None,
    as_json: Json = False,
) -> None:
    """One photo becomes views: eight sides of the object, colour and depth."""
    inputs = [photo_from_stdin() if photo == "-" else Path(photo)]
    if output is not None:
        check_output(output)
    with progress_bar() as tell:
        artifact = run(config, inputs, tell)
    show_result(artifact, output, as_json)


def photo_from_stdin() -> Path | bytes:
    """The path that an earlier command printed, or a picture's bytes. Raises UsageError where there is neither."""
    if sys.stdin is None or sys.stdin.isatty():
        raise UsageError("'-' reads a photo from standard input, which is a terminal", "pipe a path or a picture to it")
    data = sys.stdin.buffer.read(_MOST + 1)
    if len(data) > _MOST:
        raise UsageError(f"standard input holds more than {_MOST >> 20} MiB, which is no photo", "scale it down")
    text = data.decode(errors="replace").strip() if len(data) <= _LONGEST_PATH else ""
    if not data.strip():
        raise UsageError("standard input held no photo", "the command before the pipe may have failed; see its error")
    return Path(text) if text.isprintable() and "\ufffd" not in text and text else data
