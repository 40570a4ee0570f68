"""The `mv3d` command: finds a command's module when it is called, and turns every error into one line and a hint."""

from __future__ import annotations

import difflib
import importlib
import os
import signal
import sys
from collections.abc import Sequence
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command

import mv3d_cli
from mv3d_cli import __version__
from mv3d_cli.errors import Mv3dError, UsageError, WorkFailed

COMMANDS = {
    "render": "Meshes become views: colour, depth and normals from a rig of cameras.",
    "train": "Objects become a model: photo -> views, colour and depth, by multi-view diffusion.",
    "generate": "One photo becomes views: eight sides of the object, colour and depth.",
    "depth2normal": "Depth becomes normals: metric, filtered, sharp at silhouettes and steps.",
    "fit-sdf": "Views become a textured mesh: aligned, fused, refined by a neural signed distance field.",
    "export": "Meshes and fits into glb, obj, ply or stl: simplified, coloured, to a height in millimetres.",
    "cache": "Look into and clean the cache of artifacts.",
}


UsageProblem: Any = typer.BadParameter.__bases__[0]  # what a command line that does not parse raises


class LazyGroup(TyperGroup):
    """Imports a command only when it is called, so that `mv3d --help` answers at once."""

    def list_commands(self, ctx: typer.Context) -> list[str]:  # type: ignore[override]
        return list(COMMANDS)

    def get_command(self, ctx: typer.Context, cmd_name: str) -> Any:  # type: ignore[override]
        if cmd_name not in COMMANDS:
            return None
        if "--help" in sys.argv[1:2]:
            return TyperCommand(cmd_name, help=COMMANDS[cmd_name])
        module = importlib.import_module(f"mv3d_cli.cli.{cmd_name.replace('-', '_')}")
        command = get_command(module.app)
        command.name = cmd_name
        return command

    def resolve_command(self, ctx: typer.Context, args: list[str]) -> Any:  # type: ignore[override]
        if args[0] not in COMMANDS and not args[0].startswith("-") and not ctx.resilient_parsing:
            raise UsageError(f"there is no command {args[0]}", _guess(args[0], [*COMMANDS], "see `mv3d --help`"))
        return super().resolve_command(ctx, args)  # type: ignore[arg-type]


app = typer.Typer(cls=LazyGroup, add_completion=True)


def _show_version(wanted: bool) -> None:
    if wanted:
        print(f"mv3d {__version__}")
        raise typer.Exit


@app.callback(help=f"{mv3d_cli.__doc__}")
def root(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version.", callback=_show_version, is_eager=True)
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
) -> None:
    """Options before the command; `main` looks at --debug itself, since errors end there."""


def main() -> None:
    """Runs the command line; the exit code says how it went (0, 1 work failed, 2 bad input, 130 interrupted)."""
    signal.signal(signal.SIGTERM, _interrupt)
    debug = "--debug" in sys.argv
    words = [word for word in sys.argv[1:] if word != "--debug"]  # it may stand anywhere
    completing = "_MV3D_COMPLETE" in os.environ
    sys.argv[1:] = words or ([] if completing else ["--help"])
    try:
        code = app(standalone_mode=False)
        sys.exit(code if isinstance(code, int) else 0)
    except (KeyboardInterrupt, typer.Abort):
        sys.exit(130)
    except Exception as error:
        if debug:
            raise
        sys.exit(_explain(error))


def _interrupt(signum: int, frame: object) -> None:
    raise KeyboardInterrupt


def _explain(error: Exception) -> int:
    """Prints an error as one line and a hint; returns its exit code."""
    from mv3d_cli.cli.console import show_error

    if isinstance(error, BrokenPipeError):  # the reader of our stdout left: nobody to tell
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return 1
    told = _in_our_words(error)
    show_error(told)
    return told.exit_code


def _in_our_words(error: Any) -> Mv3dError:
    """The error, as one of ours."""
    if isinstance(error, Mv3dError):
        return error
    if isinstance(error, UsageProblem):
        context = getattr(error, "ctx", None)
        page = f"see `{context.command_path if context is not None else 'mv3d'} --help`"
        options = getattr(error, "possibilities", None)
        if options:
            return UsageError(error.message, _guess(error.option_name, options, page))
        return UsageError(error.format_message(), page)
    if isinstance(error, OSError):
        place = f": {error.filename}" if error.filename else ""
        return WorkFailed(f"{error.strerror or error}{place}", "see the whole story with --debug")
    if isinstance(error, MemoryError):
        return WorkFailed("there is not enough memory", "take a smaller --size, or fewer --jobs")
    reason = f"a fault of mv3d itself ({type(error).__name__}: {error})"
    return WorkFailed(reason, "please report it with what the same command prints with --debug")


def _guess(word: str, known: Sequence[str], otherwise: str) -> str:
    """The hint for a word that is not known."""
    close = difflib.get_close_matches(word, known, n=1)
    return f"did you mean {close[0]}? {otherwise}" if close else otherwise
