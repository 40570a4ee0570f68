"""`mv3d train` killed, paused, or out of space, and run again: in the end nothing shows."""

from __future__ import annotations

import csv
import json
import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file

from mv3d_cli.diffusion.model.checkpoint import load_model

FEW = ("--views", "front,right", "--batch", "2", "--warmup", "1")
STATE = "v1/train/*/*.work/state.safetensors"


def losses(folder: Path) -> list[str]:
    """The losses of all steps, as they are written."""
    with (folder / "curve.csv").open(newline="") as file:
        return [row["loss"] for row in csv.DictReader(file)]


def is_same(one: Path, other: Path) -> bool:
    """Whether two trainings went the same way, to the bit."""
    first, second = (load_file(folder / "model.safetensors") for folder in (one, other))
    assert first.keys() == second.keys()
    return losses(one) == losses(other) and all(torch.equal(value, second[name]) for name, value in first.items())


def is_paused(folder: Path) -> bool:
    return json.loads((folder / "training.json").read_text())["paused"]


def step_of(state: Path) -> int:
    with safe_open(state, "pt") as file:
        return json.loads(file.metadata()["training"])["step"]


def newly_saved(cache: Path) -> Callable[[], bool]:
    """Whether there is another checkpoint than now."""

    def saved() -> list[int]:
        return [path.stat().st_mtime_ns for path in cache.glob(STATE)]

    before = saved()
    return lambda: saved() not in ([], before)


@pytest.fixture
def unbroken(forked, tmp_path: Path) -> Callable[..., Path]:
    """Runs a command to its end in a cache of its own."""
    return lambda *words: forked(*words, env={"MV3D_CACHE_DIR": str(tmp_path / "elsewhere")}).path


@pytest.mark.parametrize(("preset", "precision"), [("little", "fp32"), ("little", "bf16"), ("tiny", "bf16")])
def test_killed_and_run_again(
    forked, unbroken, little: Path, meshes: Path, cache_folder: Path, preset: str, precision: str
) -> None:
    start, steps = (("--from", little), 60) if preset == "little" else (("--preset", "tiny"), 5)
    command = ("train", meshes, *start, *FEW, "--steps", steps, "--precision", precision, "--jobs", "0")
    whole = unbroken(*command)
    reached = [0]
    for _ in range(2):
        ran = forked(*command, "--save-every", "0", until=newly_saved(cache_folder))
        assert ran.code == -signal.SIGKILL
        (state,) = cache_folder.glob(STATE)
        reached.append(step_of(state))
    assert reached == sorted(set(reached))
    assert reached[-1] < steps
    again = forked(*command).path
    assert is_same(again, whole)
    names = {path.name for path in again.iterdir()}
    assert names == {path.name for path in whole.iterdir()}
    assert [event for event, _ in logged(again)] == [*range(1, steps + 1)]
    assert [value for _, value in logged(again)] == pytest.approx([float(loss) for loss in losses(whole)], rel=1e-6)


def logged(folder: Path) -> list[tuple[int, float]]:
    """(step, loss) as tensorboard has them."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder / "logs"))
    events.Reload()
    return [(event.step, event.value) for event in events.Scalars("loss")]


def test_paused_and_run_again(forked, unbroken, little: Path, meshes: Path, tmp_path: Path) -> None:
    command = ("train", meshes, "--from", little, *FEW, "--steps", "3000", "--decay", "0", "--precision", "fp32")
    output = tmp_path / "model"
    ran = forked(*command, "--jobs", "0", "--max-time", "1s", "-o", output)
    assert ran.path == output
    assert is_paused(output)
    done = len(losses(output))
    assert ran.stderr == f"warning: paused after {done} of 3000 steps; the same command goes on\n"
    assert 3 < done < 3000
    load_model(output)
    ran = forked(*command, "--jobs", "0", "--max-time", "1s", "-o", output)
    assert "paused after" in ran.stderr
    more = losses(output)
    assert len(more) > done
    short = unbroken(*command[:-6], "--steps", len(more), "--decay", "0", "--precision", "fp32", "--jobs", "0")
    assert is_same(output, short)  # the course is the same so far, since the rate does not fall


def test_other_settings_are_refused_and_nothing_is_lost(
    forked, refused, little: Path, meshes: Path, tmp_path: Path
) -> None:
    output = tmp_path / "model"
    command = ("train", meshes, *FEW, "--steps", "2", "--jobs", "0", "-o", output)
    assert is_paused(forked(*command, "--from", little, "--max-time", "0").path)
    before = {path: path.read_bytes() for path in output.rglob("*") if path.is_file()}
    changes = {
        "--batch 1 (was 2)": (*command, "--from", little, "--batch", "1"),
        "--lr 0.001 (was 0.0005)": (*command, "--from", little, "--lr", "1e-3"),
        "--views ['front'] (was ['front', 'right'])": (*command, "--from", little, "--views", "front"),
        "the start": (*command, "--preset", "small", "--from", output),
    }
    for difference, changed in changes.items():
        told = refused(*changed, by=forked).stderr
        assert difference in told
        assert "another -o" in told
    assert {path: path.read_bytes() for path in output.rglob("*") if path.is_file()} == before
    assert not is_paused(forked(*command, "--from", little).path)
    assert len(losses(output)) == 2


def test_when_the_disk_is_full_the_last_checkpoint_survives(
    forked, refused, unbroken, little: Path, meshes: Path, cache_folder: Path
) -> None:
    command = ("train", meshes, "--from", little, *FEW, "--steps", "40", "--jobs", "0")
    often = (*command, "--save-every", "0")
    refused(*often, by=forked, code=1, limit=10_000)
    assert not [*cache_folder.glob(STATE)]
    assert forked(*often, until=newly_saved(cache_folder)).code == -signal.SIGKILL
    (state,) = cache_folder.glob(STATE)
    before = state.read_bytes()
    told = refused(*often, by=forked, code=1, limit=len(before) // 2).stderr
    assert "no space left" in told
    assert state.read_bytes() == before
    assert not [*state.parent.glob(".*")]
    assert is_same(forked(*command).path, unbroken(*command))


def test_a_damaged_checkpoint_is_told_of(
    forked, refused, little: Path, meshes: Path, cache_folder: Path, tmp_path: Path
) -> None:
    command = ("train", meshes, "--from", little, *FEW, "--steps", "2", "--jobs", "0")
    forked(*command, "--max-time", "0")
    (state,) = cache_folder.glob(STATE)
    whole = state.read_bytes()
    for damage in (whole[:-50], b"", os.urandom(len(whole))):
        state.write_bytes(damage)
        told = refused(*command, by=forked, code=1).stderr
        assert str(state) in told
        assert f"remove {state.parent}" in told
    state.write_bytes(whole)
    assert len(losses(forked(*command).path)) == 2
