"""mv3d cache: what is kept, where it came from, whether it is whole, and making room."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from datetime import timedelta
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from mv3d_cli import errors, store
from mv3d_cli.cli.cache import app
from mv3d_cli.steps import cache
from mv3d_cli.store import Artifact, Recipe, produce


@pytest.fixture(autouse=True)
def kept(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("MV3D_CACHE_DIR", str(tmp_path / "kept"))
    return tmp_path / "kept"


def made(step: str, source: Path | None = None, size: int = 10, main: str | None = None, **config: object) -> Artifact:
    sources = {"input": str(source)} if source else {}
    inputs = {"input": store.digest_of_path(source)} if source else {}

    def build(work: Path) -> None:
        (work / "color").mkdir()
        (work / "color" / "front.png").write_bytes(step.encode() * (size // len(step)))
        (work / "mesh.glb").write_text(step + str(config))

    return produce(Recipe(step, 1, config, inputs, sources=sources), build, main=main)


def used(artifact: Artifact, days: float) -> None:
    then = time.time() - 86400 * days
    os.utime(artifact.path / "artifact.json", (then, then))


def run(*arguments: str) -> str:
    result = CliRunner().invoke(app, [*arguments])
    if result.exception is not None:
        raise result.exception
    return result.output


def chain(tmp_path: Path) -> tuple[Path, Path]:
    """A photo made into views, delivered, and the views made into a mesh, delivered as a file."""
    photo = tmp_path / "photo.jpg"
    photo.write_text("jpeg")
    views = store.deliver(made("generate", photo, seed=7), tmp_path / "views")
    mesh = store.deliver(made("fit-sdf", views, main="mesh.glb", steps=600), tmp_path / "mesh.glb")
    return views, mesh


def told(reference: object) -> list[tuple[int, str | None, str | None]]:
    return [
        (origin.depth, origin.step, origin.source and Path(origin.source).name) for origin in cache.why(str(reference))
    ]


def test_why_tells_the_whole_chain_from_whatever_is_given(tmp_path):
    views, mesh = chain(tmp_path)
    (fit,) = [entry for entry in cache.listed() if entry.step == "fit-sdf"]
    tail = [(1, "generate", "views"), (2, None, "photo.jpg")]
    for reference in (mesh, fit.path, fit.path / "mesh.glb", fit.key, fit.key[:8]):
        assert told(reference)[1:] == tail, reference
        assert told(reference)[0][:2] == (0, "fit-sdf")
    for reference in (views, views / "color", views / "color" / "front.png"):
        assert told(reference)[0] == (0, "generate", reference.name)
    assert cache.why(str(mesh))[0].config == {"steps": 600}
    assert cache.why(str(views / "color"))[0].part == "color"
    assert not any(origin.edited for origin in cache.why(str(mesh)))


def test_why_outlives_the_cache_and_sees_edits(tmp_path):
    views, mesh = chain(tmp_path)
    cache.pruned(max_size=0)
    assert [step for _, step, _ in told(mesh)] == ["fit-sdf", "generate", None]
    (views / "color" / "front.png").write_text("retouched")
    assert cache.why(str(views / "color" / "front.png"))[0].edited
    again = made("fit-sdf", views, steps=600)
    assert [origin.edited for origin in cache.why(again.key)] == [False, True, False]
    mesh.write_text("sculpted")
    with pytest.raises(errors.MissingInput, match="not made by mv3d"):
        cache.why(str(mesh))


def test_why_in_words_and_json(tmp_path):
    _, mesh = chain(tmp_path)
    words = run("why", str(mesh))
    for word in ("fit-sdf v1", "steps = 600", "generate v1", "seed = 7", "photo.jpg"):
        assert word in words
    assert [origin["step"] for origin in json.loads(run("why", str(mesh), "--json"))] == [
        "fit-sdf",
        "generate",
        None,
    ]


@pytest.mark.parametrize("reference", ["nothing", "abc", "ab" * 32, "x" * 5000, "null\0", "", "[red]"])
def test_what_is_not_there_is_one_clear_error(reference):
    for command in (cache.why, lambda text: cache.removed((text,))):
        with pytest.raises(errors.MissingInput) as caught:
            command(reference)
        assert "mv3d cache ls" in caught.value.hint


def test_ls_shows_every_state(tmp_path, kept):
    photo = tmp_path / "photo [1].jpg"
    photo.write_text("jpeg")
    whole, damaged = made("generate", photo, size=2000), made("render")
    (damaged.path / "artifact.json").write_text("?")

    def fail(work: Path) -> None:
        (work / "checkpoint").write_text("x" * 500)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        produce(Recipe("train", 1, {}, {}), fail, resumable=True)
    states = {entry.step: entry.state for entry in cache.listed()}
    assert states == {"generate": "whole", "render": "damaged", "train": "unfinished"}
    words = run("ls")
    assert f"input={photo}" in words
    assert whole.key[:12] in words
    assert "2.0 kB" in words
    assert "train (unfinished)" in words
    assert {entry["key"] for entry in json.loads(run("ls", "--json"))} >= {whole.key}
    assert run("dir") == f"{kept}\n"


def test_an_empty_cache_is_no_error(kept):
    assert [*cache.listed()] == []
    assert json.loads(run("ls", "--json")) == []
    assert "0 results are whole" in run("verify")
    assert "0 results removed" in run("prune", "--max-size", "0")
    assert not kept.exists()


def test_verify_names_what_is_damaged():
    whole, damaged = made("generate"), made("render")
    assert "2 results are whole" in run("verify")
    (damaged.path / "color" / "front.png").write_bytes(b"renderrende")
    found = {inspection.key: inspection.damage for inspection in cache.verified()}
    assert found == {whole.key: (), damaged.key: ("color/front.png has other bytes",)}
    with pytest.raises(errors.DamagedArtifact, match="1 of 2"):
        run("verify")


def test_prune_by_age_and_by_size_takes_the_least_recently_used():
    artifacts = {days: made("render", size=1000, days=days) for days in (40, 3, 2, 1)}
    for days, artifact in artifacts.items():
        used(artifact, days)
    size = artifacts[1].size
    assert [entry.key for entry in cache.pruned(older_than=timedelta(days=30)).removed] == [artifacts[40].key]
    made("render", size=1000, days=3)  # found again: used now
    result = cache.pruned(max_size=2 * size + 10)
    assert [entry.key for entry in result.removed] == [artifacts[2].key]
    assert abs(result.freed - size) < 10
    assert {entry.key for entry in cache.listed()} == {artifacts[1].key, artifacts[3].key}


def test_prune_removes_what_the_dead_left_and_keeps_paused_work(kept):
    def die(work: Path) -> None:
        (work / "half").write_text("")
        os._exit(9)

    for resumable in (False, True):
        child = os.fork()
        if child == 0:
            produce(Recipe("train", int(resumable), {}, {}), die, resumable=resumable)
        os.waitpid(child, 0)
    assert cache.pruned().leftovers == 1
    left = [path.name for path in kept.glob("v1/*/*/*")]
    assert {Path(name).suffix for name in left} - {".lock"} == {".work"}
    assert len(cache.pruned(max_size=0).removed) == 0  # it holds no bytes
    assert len(cache.pruned(older_than=timedelta()).removed) == 1
    assert not [*kept.glob("v1/*/*/*")]


def test_what_a_process_makes_or_uses_is_not_removed(tmp_path, kept):
    script = """
import sys
from mv3d_cli.store import Recipe, produce
def build(work):
    (work / "a").write_text("a")
    if sys.argv[1] == "making":
        print("ready", flush=True); sys.stdin.readline()
artifact = produce(Recipe("train", 1, {}, {}), build, resumable=True)
print("ready", flush=True); sys.stdin.readline()
"""
    for moment in ("making", "using"):
        process = subprocess.Popen(
            [sys.executable, "-c", script, moment], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        assert process.stdout is not None
        process.stdout.readline()
        (entry,) = cache.pruned(max_size=0).in_use
        with pytest.raises(errors.WorkFailed, match="in use"):
            cache.removed((entry.key[:6],))
        assert (entry.path / "a").exists()
        process.kill()
        process.communicate()
    assert "1 results removed" in run("prune", "--max-size", "0")
    assert not [*kept.glob("v1/*/*/*")]


def test_rm_by_key_digits_and_path_and_nothing_else(tmp_path):
    one, two, three = (made("render", number=number) for number in range(3))
    copy = store.deliver(one, tmp_path / "copy")
    with pytest.raises(errors.MissingInput):
        cache.removed((one.key, str(copy)))
    assert one.path.exists()
    assert copy.exists()
    words = run("rm", one.key[:12], str(two.path), str(three.path / "color"))
    assert words.count("removed") == 3
    assert [*cache.listed()] == []


def test_digits_that_fit_several_keys_are_refused():
    by_digits: dict[str, list[int]] = {}
    for number in range(2000):
        by_digits.setdefault(Recipe("render", 1, {"number": number}, {}).key[:4], []).append(number)
    digits, numbers = next((digits, numbers) for digits, numbers in by_digits.items() if len(numbers) == 2)
    for number in numbers:
        made("render", number=number)
    for command in (cache.why, lambda text: cache.removed((text,))):
        with pytest.raises(errors.UsageError, match="fits 2 keys"):
            command(digits)


@given(st.integers(0, 10**6), st.sampled_from("smhdw"))
def test_time_spans(number, unit):
    one = {
        "s": timedelta(seconds=1),
        "m": timedelta(minutes=1),
        "h": timedelta(hours=1),
        "d": timedelta(days=1),
    }
    assert cache.duration(f"{number}{unit}") == number * one.get(unit, timedelta(weeks=1))


def test_sizes():
    texts = ("10G", "500M", "1.5GB", "0", "7k", "2TB")
    assert [*map(cache.byte_count, texts)] == [10**10, 5 * 10**8, 1_500_000_000, 0, 7000, 2 * 10**12]


@pytest.mark.parametrize("text", ["", "d", "-3d", "30", "30 y", "1e9d", "999999999w", "nan"])
def test_bad_time_spans_and_sizes_are_refused(text):
    with pytest.raises(errors.UsageError):
        cache.duration(text)
    if text != "30":
        with pytest.raises(errors.UsageError):
            cache.byte_count(text)
