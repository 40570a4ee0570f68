"""mv3d cache: what is kept, where it came from, and making room."""

from __future__ import annotations

import json
import sys
import time
from dataclasses import asdict
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text
from rich.tree import Tree

from mv3d_cli.errors import DamagedArtifact
from mv3d_cli.steps import cache

app = typer.Typer(name="cache", help="Look after the results that are kept.", no_args_is_help=True)

SHOWN_INPUTS = 2

Json = Annotated[bool, typer.Option("--json", help="Print JSON for programs.")]


@app.command("ls")
def list_entries(as_json: Json = False) -> None:
    """List what is kept, least recently used first."""
    entries = [*cache.listed()]
    if as_json:
        return _print_json([asdict(entry) for entry in entries])
    table = Table(box=None, pad_edge=False)
    for name in ("KEY", "STEP", "SIZE", "AGE", "INPUTS"):
        table.add_column(name, justify="right" if name in ("SIZE", "AGE") else "left", overflow="fold")
    for entry in entries:
        step = entry.step if entry.state == "whole" else f"{entry.step} ({entry.state})"
        cells = (
            entry.key[:12],
            step,
            _size(entry.size),
            _age(time.time() - entry.made),
            _shortened(entry.inputs),
        )
        table.add_row(*map(Text, cells))
    _console().print(table)


@app.command()
def why(
    reference: Annotated[str, typer.Argument(metavar="PATH|KEY", help="A result, a file in it, or a key.")],
    as_json: Json = False,
) -> None:
    """Show the steps, inputs and settings that made a result."""
    origins = cache.why(reference)
    if as_json:
        return _print_json([asdict(origin) for origin in origins])
    branches: list[Tree] = []
    for origin in origins:
        node = Tree(_origin(origin))
        if origin.depth:
            branches[origin.depth - 1].children.append(node)
        branches[origin.depth :] = [node]
    _console().print(branches[0])


@app.command()
def verify() -> None:
    """Compare every byte that is kept with its manifest. Exit code 1 when something is damaged."""
    inspections = [*cache.verified()]
    damaged = [inspection for inspection in inspections if inspection.damage]
    for inspection in damaged:
        typer.echo(f"{inspection.path}: {inspection.damage[0]}")
    if damaged:
        raise DamagedArtifact(
            f"{len(damaged)} of {len(inspections)} results are damaged",
            "They are made again when they are next needed; `mv3d cache rm KEY` removes them now.",
        )
    typer.echo(f"{len(inspections)} results are whole")


@app.command()
def prune(
    older_than: Annotated[
        str | None, typer.Option(metavar="TIME", help="Remove what was not used for this long, such as 30d.")
    ] = None,
    max_size: Annotated[
        str | None,
        typer.Option(metavar="SIZE", help="Remove the least recently used beyond this, such as 10G."),
    ] = None,
) -> None:
    """Make room. Without options, remove only what killed processes left behind."""
    result = cache.pruned(
        None if older_than is None else cache.duration(older_than),
        None if max_size is None else cache.byte_count(max_size),
    )
    kept = f", {len(result.in_use)} in use and kept" if result.in_use else ""
    removed = f"{len(result.removed)} results removed ({_size(result.freed)})"
    typer.echo(f"{removed}, {result.leftovers} leftovers removed{kept}")


@app.command()
def rm(references: Annotated[list[str], typer.Argument(metavar="KEY|PATH...")]) -> None:
    """Remove results from the cache by key, by its first digits, or by path."""
    for entry in cache.removed(tuple(references)):
        typer.echo(f"removed {entry.key[:12]} {entry.step} ({_size(entry.size)})")


@app.command("dir")
def directory() -> None:
    """Print where results are kept: $MV3D_CACHE_DIR, or the platform's place for caches."""
    typer.echo(cache.cache_dir())


def _console() -> Console:
    """Standard output; for a pipe, lines as long as they are."""
    return Console(width=None if sys.stdout.isatty() else 10_000)


def _origin(origin: cache.Origin) -> Text:
    """A link of the chain in words: what it was, what made it, and with which settings."""
    text = Text()
    if origin.depth:
        text.append(f"{origin.label}: ", style="bold")
    if origin.source is not None:
        text.append(origin.source)
    if origin.step is None:
        return text.append(f"  sha256 {origin.digest[:12]}", style="dim")
    made_by = f"  {origin.step} v{origin.step_version}, key {(origin.key or '')[:12]}"
    text.append(made_by + (f", {origin.part}" if origin.part else ""))
    if origin.edited:
        text.append("  (edited since)", style="bold")
    for name, value in sorted(origin.config.items()):
        text.append(f"\n  {name} = {json.dumps(value, ensure_ascii=False)}", style="dim")
    if origin.weights is not None:
        text.append(f"\n  weights sha256 {origin.weights[:12]}", style="dim")
    return text


def _print_json(value: Any) -> None:
    typer.echo(json.dumps(value, indent=2, default=str))


def _shortened(inputs: tuple[str, ...]) -> str:
    """The first inputs, and how many more there are."""
    shown = ", ".join(inputs[:SHOWN_INPUTS])
    more = len(inputs) - SHOWN_INPUTS
    return f"{shown} and {more} more" if more > 0 else shown


def _size(count: int) -> str:
    for unit, size in (("TB", 10**12), ("GB", 10**9), ("MB", 10**6), ("kB", 10**3)):
        if count >= size:
            return f"{count / size:.1f} {unit}"
    return f"{count} B"


def _age(seconds: float) -> str:
    for unit, length in (("d", 86400), ("h", 3600), ("min", 60)):
        if seconds >= length:
            return f"{seconds / length:.0f} {unit}"
    return f"{max(seconds, 0):.0f} s"
