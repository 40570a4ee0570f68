"""Keys and digests: the same content is the same name for ever, and any other content another."""

from __future__ import annotations

import hashlib
import json
import math
import os
from pathlib import Path, PurePosixPath

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mv3d_cli import errors, store
from mv3d_cli.store import Recipe

SCALARS = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text()
VALUES = st.recursive(SCALARS, lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner), max_leaves=12)


@given(VALUES)
def test_canonical_json_is_json_of_the_same_value(value):
    text = store.canonical_json(value)
    assert json.loads(text) == value
    assert store.canonical_json(json.loads(text)) == text
    assert text.isascii()


@given(st.dictionaries(st.text(), VALUES, min_size=2), st.randoms())
def test_key_ignores_order_and_tuples_and_sees_every_value(config, chance):
    names = [*config]
    chance.shuffle(names)
    shuffled = {name: tuple(config[name]) if isinstance(config[name], list) else config[name] for name in names}
    key = Recipe("paint", 1, config, {}).key
    assert Recipe("paint", 1, shuffled, {}, sources={"photo": "a.jpg"}).key == key
    assert Recipe("paint", 1, {**config, names[0]: [config[names[0]]]}, {}).key != key


def test_key_is_the_same_for_ever_and_depends_on_each_part():
    first = Recipe("paint", 1, {"views": 8, "size": (2, 3.5)}, {"photo": "ab"})
    text = (
        '{"config":{"size":[2,3.5],"views":8},"inputs":{"photo":"ab"},"step":"paint","step_version":1,"weights":null}'
    )
    assert first.key == hashlib.sha256(text.encode()).hexdigest()
    others = [
        Recipe("draw", 1, first.config, first.inputs),
        Recipe("paint", 2, first.config, first.inputs),
        Recipe("paint", 1, {"views": 9}, first.inputs),
        Recipe("paint", 1, first.config, {"photo": "ac"}),
        Recipe("paint", 1, first.config, first.inputs, weights="ab"),
    ]
    assert len({first.key, *(other.key for other in others)}) == 6


@pytest.mark.parametrize("value", [PurePosixPath("a"), Path("a"), b"a", {1}, object(), {1: 2}])
def test_what_json_does_not_know_is_refused_by_name(value):
    with pytest.raises(TypeError, match=r"value\.config\.views\[1\]"):
        _ = Recipe("paint", 1, {"views": [0, value]}, {}).key


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_floats_that_are_not_finite_are_refused(value):
    with pytest.raises(ValueError, match="finite"):
        store.canonical_json({"a": value})


def test_digests_follow_content_and_names_and_nothing_else(tmp_path):
    one, two = tmp_path / "one", tmp_path / "two"
    for folder, order in ((one, "ab"), (two, "ba")):
        for name in order:
            (folder / name).mkdir(parents=True)
            (folder / name / "file").write_text(name)
    (two / "artifact.json").write_text("times differ")
    assert store.digest_of_path(one) == store.digest_of_folder(two)
    (two / "a" / "file").rename(two / "a" / "other")
    assert store.digest_of_folder(one) != store.digest_of_folder(two)
    assert store.digest_of_path(one / "a" / "file") == hashlib.sha256(b"a").hexdigest()
    (two / "loop").symlink_to(two)
    (two / "linked").symlink_to(one)
    (one / "b" / "file").write_text("seen through the link")
    before = store.digest_of_folder(two)
    (one / "b" / "file").write_text("and again")
    assert store.digest_of_folder(two) != before


@pytest.mark.timeout(5)
def test_what_cannot_be_read_has_no_digest(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path, tmp_path / "pipe", tmp_path / "nothing"):
        with pytest.raises(errors.MissingInput):
            store.digest_of_path(path)
