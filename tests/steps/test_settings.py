"""A Config says all of itself: bounds, choices, what enters the key."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mv3d_cli.errors import UsageError
from mv3d_cli.steps.settings import Between, Doc, Runtime, check, key_config, settings_of

Colour = Literal["red", "green"]


@dataclass(frozen=True)
class Config:
    size: Annotated[int, Doc("Side.", short="s"), Between(8, 64)] = 16
    tilt: Annotated[float, Doc("Degrees."), Between(-0.5, 0.5)] = 0.25
    colour: Annotated[Colour, Doc("Paint.")] = "red"
    file: Annotated[Path | None, Doc("A file."), Runtime()] = None
    many_jobs: Annotated[int, Doc("Processes."), Runtime()] = 1
    parts: Annotated[tuple[str, ...], Doc("Which.")] = ()


def test_settings_are_the_fields_in_order():
    settings = settings_of(Config)
    assert [s.name for s in settings] == ["size", "tilt", "colour", "file", "many_jobs", "parts"]
    assert settings == settings_of(Config())
    assert [s.option for s in settings][3:5] == ["--file", "--many-jobs"]
    assert (settings[0].kind, settings[0].default, settings[0].mark(Doc).short) == (int, 16, "s")
    assert settings[2].kind == Colour
    assert settings[2].mark(Between) is None


def test_the_key_has_what_changes_the_bytes():
    assert key_config(Config()) == {"size": 16, "tilt": 0.25, "colour": "red", "parts": ()}
    assert key_config(Config(many_jobs=9, file=Path("x"))) == key_config(Config())


@given(st.integers())
def test_bounds_belong_to_the_range(size):
    config = Config(size=size)
    if 8 <= size <= 64:
        check(config)
    else:
        with pytest.raises(UsageError, match=rf"--size {size} "):
            check(config)


@pytest.mark.parametrize(
    ("change", "problem", "advice"),
    [
        ({"tilt": 0.75}, "--tilt 0.75", "-0.5 to 0.5"),
        ({"tilt": float("nan")}, "--tilt nan", "-0.5 to 0.5"),
        ({"colour": "blue"}, "--colour blue", "red, green"),
        ({"file": Path("there/is/no/such")}, "--file there/is/no/such", "path"),
    ],
)
def test_what_is_refused(change, problem, advice):
    with pytest.raises(UsageError) as caught:
        check(replace(Config(), **change))
    assert problem in str(caught.value)
    assert advice in caught.value.hint


def test_what_is_taken(tmp_path):
    check(Config(tilt=-0.5, colour="green", file=tmp_path, parts=("a",)))
