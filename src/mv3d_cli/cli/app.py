"""The `mv3d` command: finds a command's module when it is called, and turns every error into one line and a hint."""

from __future__ import annotations

import importlib
import os
import signal
import sys
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command

import mv3d_cli
from mv3d_cli import __version__
from mv3d_cli.errors import Mv3dError, UsageError, WorkFailed

COMMANDS = {
    "render": "Meshes become views: colour, depth and normals from a rig of cameras.",
    "cache": "Look into and clean the cache of artifacts.",
}


UsageProblem: type[Exception] = typer.BadParameter.__bases__[0]  # what a command line that does not parse raises


class LazyGroup(TyperGroup):
    """Imports a command only when it is called, so that `mv3d --help` answers at once."""

    def list_commands(self, ctx: typer.Context) -> list[str]:  # type: ignore[override]
        return list(COMMANDS)

    def get_command(self, ctx: typer.Context, cmd_name: str) -> Any:  # type: ignore[override]
        if cmd_name not in COMMANDS:
            return None
        if "--help" in sys.argv[1:2]:
            return TyperCommand(cmd_name, help=COMMANDS[cmd_name])
        module = importlib.import_module(f"mv3d_cli.cli.{cmd_name}")
        command = get_command(module.app)
        command.name = cmd_name
        return command


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
    sys.argv[1:] = words or ["--help"]
    try:
        code = app(standalone_mode=False)
        sys.exit(code if isinstance(code, int) else 0)
    except (Mv3dError, UsageProblem, OSError, MemoryError) as error:
        if debug:
            raise
        sys.exit(_explain(error))
    except (KeyboardInterrupt, typer.Abort):
        sys.exit(130)


def _interrupt(signum: int, frame: object) -> None:
    raise KeyboardInterrupt


def _explain(error: BaseException) -> int:
    """Prints an error as one line and a hint; returns its exit code."""
    from mv3d_cli.cli.console import show_error

    if isinstance(error, BrokenPipeError):  # the reader of our stdout left: nobody to tell
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return 1
    if isinstance(error, UsageProblem):
        message = getattr(error, "format_message", lambda: str(error))()
        error = UsageError(message, f"see `{_command_line(error)} --help`")
    elif isinstance(error, OSError):
        error = WorkFailed(f"{error.strerror or error}: {error.filename or ''}", "see the whole story with --debug")
    elif isinstance(error, MemoryError):
        error = WorkFailed("there is not enough memory", "take a smaller --size, or fewer --jobs")
    assert isinstance(error, Mv3dError)
    show_error(error)
    return error.exit_code


def _command_line(error: BaseException) -> str:
    context = getattr(error, "ctx", None)
    return context.command_path if context is not None else "mv3d"
