"""What a step's frozen Config dataclass says of itself: the one source of defaults, help, validation and the key.

@dataclass(frozen=True)
class Config:
    size: Annotated[int, Doc("Picture side in pixels."), Between(8, 4096)] = 512
    jobs: Annotated[int, Doc("Worker processes."), Runtime()] = 1
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

from mv3d_cli.errors import UsageError


@dataclass(frozen=True)
class Doc:
    """The help of a setting; `short` is its one-letter option."""

    text: str
    short: str = ""


@dataclass(frozen=True)
class Between:
    """The least and the greatest value of a number."""

    least: float
    most: float

    def __str__(self) -> str:
        return f"{self.least} to {self.most}"


@dataclass(frozen=True)
class Runtime:
    """Marks a setting that cannot change the result's bytes, or enters the key as an input: it stays out of the key."""


@dataclass(frozen=True)
class Progress:
    """How far a step has come; `note`: what it can say of the result so far."""

    done: int
    total: int
    unit: str
    note: str = ""


@dataclass(frozen=True)
class Warned:
    """Something the user should know though the work goes on."""

    text: str


Tell = Callable[[Progress | Warned], None]


def silent(event: Progress | Warned) -> None:
    """Tells nobody."""


@dataclass(frozen=True)
class Setting:
    """One field of a Config: `kind` is its bare type."""

    name: str
    kind: Any
    default: Any
    marks: tuple[Any, ...]

    def mark(self, kind: type) -> Any:
        return next((mark for mark in self.marks if isinstance(mark, kind)), None)

    @property
    def option(self) -> str:
        return "--" + self.name.rstrip("_").replace("_", "-")


def settings_of(config: Any) -> list[Setting]:
    """The settings of a Config class or instance, in order."""
    kind = config if isinstance(config, type) else type(config)
    hints = get_type_hints(kind, include_extras=True)
    found = []
    for field in fields(kind):
        bare, *marks = get_args(hints[field.name])
        found.append(Setting(field.name, bare, field.default, tuple(marks)))
    return found


def key_config(config: Any) -> dict[str, Any]:
    """The part of a Config that belongs to an artifact's key."""
    return {s.name: getattr(config, s.name) for s in settings_of(config) if s.mark(Runtime) is None}


def check(config: Any) -> None:
    """Raises UsageError for a setting that is out of range or not among its choices."""
    for setting in settings_of(config):
        value, bounds = getattr(config, setting.name), setting.mark(Between)
        if bounds is not None and value is not None and not bounds.least <= value <= bounds.most:
            raise UsageError(
                f"{setting.option} {value} is out of range",
                f"take a value from {bounds}",
            )
        if get_origin(setting.kind) is Literal and value not in get_args(setting.kind):
            choices = ", ".join(map(str, get_args(setting.kind)))
            raise UsageError(f"{setting.option} {value} is not known", f"choose from: {choices}")
        if isinstance(value, Path) and not value.exists():
            raise UsageError(f"{setting.option} {value} does not exist", "check the path")
