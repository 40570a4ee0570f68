"""A step's Config dataclass becomes the options of its command."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from mv3d_cli.cli.console import path_from_stdin
from mv3d_cli.steps.settings import Between, Doc, Setting, settings_of

Output = Annotated[
    Path | None,
    typer.Option("--output", "-o", help="Where to put the result; it stays in the cache in any case."),
]
Json = Annotated[bool, typer.Option("--json", help="Print the result's manifest instead of its path.")]


def inputs_from(names: Sequence[str]) -> list[Path]:
    """The inputs as paths; `-` stands for the path that an earlier command printed. Raises UsageError."""
    return [path_from_stdin() if name == "-" else Path(name) for name in names]


def _option(setting: Setting) -> inspect.Parameter:
    """The keyword parameter that Typer turns into a setting's option."""
    doc, bounds = setting.mark(Doc), setting.mark(Between)
    text = doc.text + (f" [{bounds}]" if bounds else "")
    names = [setting.option, f"-{doc.short}"] if doc.short else [setting.option]
    kind, default = setting.kind, setting.default
    if kind == tuple[str, ...]:
        kind, default = str, ",".join(default)
    annotation = Annotated[kind, typer.Option(*names, help=text, show_default=default not in (None, ""))]
    return inspect.Parameter(setting.name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


def with_settings(config: type) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Gives a command function, whose first parameter is `config`, one option for each setting of the dataclass."""
    settings = settings_of(config)

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        def run(**values: Any) -> None:
            given = {s.name: values.pop(s.name) for s in settings}
            for s in settings:
                if s.kind == tuple[str, ...]:
                    given[s.name] = tuple(part.strip() for part in given[s.name].split(",") if part.strip())
            command(config(**given), **values)

        own = list(inspect.signature(command, eval_str=True).parameters.values())[1:]
        run.__signature__ = inspect.Signature([*own, *map(_option, settings)])  # type: ignore[attr-defined]
        run.__annotations__ = {p.name: p.annotation for p in run.__signature__.parameters.values()}  # type: ignore[attr-defined]
        run.__doc__, run.__name__ = command.__doc__, command.__name__
        return run

    return decorate
