"""A training that is broken off and goes on equals one that is not; files of another training are refused."""

from __future__ import annotations

import errno
import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from accelerate import Accelerator
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from mv3d_cli.diffusion.model import Model
from mv3d_cli.diffusion.model.config import ModelConfig
from mv3d_cli.diffusion.training import Course, State, train
from mv3d_cli.diffusion.training.objectives import Batch, DiffusionObjective, Teaching
from mv3d_cli.diffusion.training.state import load_state, save_state
from mv3d_cli.errors import DamagedArtifact, OutOfSpace

COURSE = Course(steps=6, rate=3e-3, warmup=2, decay=0.5)
TEACHING = Teaching(dtype=torch.float32)


@pytest.fixture
def fresh(smallest: ModelConfig, accelerator) -> Callable[..., State]:
    """fresh(seed): a new training of a model drawn from the seed."""

    def made(seed: int = 0, teaching: Teaching = TEACHING, config: ModelConfig = smallest) -> State:
        torch.manual_seed(seed)
        return State(DiffusionObjective(Model(config), teaching), COURSE, accelerator)

    return made


@pytest.fixture
def go_on(batch_of, accelerator) -> Callable[[State, int], list[float]]:
    """go_on(state, 3): the training three steps further, each with its own batch; their losses."""

    def batches(step: int) -> Iterator[Batch]:
        while True:
            yield batch_of(3 * step, 3 * step + 1)
            step += 1

    def made(state: State, steps: int) -> list[float]:
        learning = train(state, batches(state.step), COURSE, accelerator)
        return [next(learning).loss for _ in range(steps)]

    return made


def everything(state: State) -> dict[str, Tensor]:
    """All numbers of a state by their names."""
    moments = state.optimizer.state_dict()["state"]
    found = {f"{index}.{name}": value for index, of_one in moments.items() for name, value in of_one.items()}
    found |= {f"{index}.value": parameter.detach() for index, parameter in enumerate(state.parameters)}
    return found | {f"{index}.average": average for index, average in enumerate(state.average.shadow_params)}


def same(one: State, other: State) -> bool:
    first, second = everything(one), everything(other)
    assert first.keys() == second.keys()
    return all(torch.equal(value, second[name]) for name, value in first.items())


@pytest.mark.parametrize("teaching", [TEACHING, replace(TEACHING, joint=False)], ids=["stage 2", "stage 1"])
def test_a_training_that_goes_on_equals_an_unbroken_one(fresh, go_on, tmp_path: Path, teaching: Teaching) -> None:
    """To the bit, in a process's place a fresh model of other numbers."""
    unbroken = fresh(0, teaching)
    losses = go_on(unbroken, 6)
    before, after = fresh(0, teaching), fresh(1, teaching)
    first = go_on(before, 3)
    save_state(before, tmp_path / "state.safetensors", {"curve": [1, 2.5], "note": "half way"})
    assert load_state(after, tmp_path / "state.safetensors") == {"curve": [1, 2.5], "note": "half way"}
    assert after.step == 3
    assert after.average.optimization_step == 3
    assert same(after, before)
    assert first + go_on(after, 3) == losses
    assert same(after, unbroken)
    assert not same(after, before)


def test_saving_changes_nothing_and_gives_the_same_bytes(fresh, go_on, tmp_path: Path) -> None:
    state = fresh()
    go_on(state, 2)
    before = {name: value.clone() for name, value in everything(state).items()}
    for name in ("one", "two"):
        save_state(state, tmp_path / name, {"a": 1})
    assert (tmp_path / "one").read_bytes() == (tmp_path / "two").read_bytes()
    assert all(torch.equal(value, before[name]) for name, value in everything(state).items())
    go_on(state, 1)
    save_state(state, tmp_path / "one", {"a": 1})
    assert (tmp_path / "one").read_bytes() != (tmp_path / "two").read_bytes()


class Plane(nn.Module):
    """Two parameters, so that files of it are quickly written and read."""

    def __init__(self, value: float = 0.5) -> None:
        super().__init__()
        self.slope, self.height = nn.Parameter(torch.full((3,), value)), nn.Parameter(torch.full((2,), value))

    def forward(self, batch: Tensor) -> Tensor:
        return (batch @ self.slope).square().mean() + self.height.square().sum()

    def parameters_in_training(self) -> list[nn.Parameter]:
        return [self.slope, self.height]


@pytest.fixture
def other(accelerator: Accelerator) -> State:
    """A training of a plane that has not begun."""
    return State(Plane(9.0), COURSE, accelerator)


@pytest.fixture
def saved(accelerator: Accelerator, tmp_path: Path) -> Path:
    """The file of a plane's training after one step."""
    state = State(Plane(), COURSE, accelerator)
    next(train(state, iter([torch.ones(2, 3)]), COURSE, accelerator))
    save_state(state, tmp_path / "state.safetensors", {})
    return tmp_path / "state.safetensors"


@pytest.mark.parametrize("keep", [0.0, 0.01, 0.5, 0.999])
def test_a_truncated_file_is_refused(saved: Path, other: State, keep: float) -> None:
    whole = saved.read_bytes()
    saved.write_bytes(whole[: int(len(whole) * keep)])
    with pytest.raises(DamagedArtifact, match=r"state\.safetensors cannot be used") as refusal:
        load_state(other, saved)
    assert str(saved.parent) in refusal.value.hint


def test_a_file_that_is_not_there_is_refused(saved: Path, other: State) -> None:
    saved.unlink()
    with pytest.raises(DamagedArtifact):
        load_state(other, saved)


def changed(path: Path, change: Callable[[dict[str, Tensor], dict[str, str]], None]) -> None:
    """The file with other tensors or another text."""
    with safe_open(path, "pt") as file:
        tensors, metadata = {name: file.get_tensor(name) for name in file.keys()}, file.metadata()  # noqa: SIM118
    change(tensors, metadata)
    save_file(tensors, path, metadata)


CHANGES: dict[str, Callable[[dict[str, Tensor], dict[str, str]], object]] = {
    "no text": lambda _, metadata: metadata.clear(),
    "no JSON": lambda _, metadata: metadata.update(training="{"),
    "no step": lambda _, metadata: metadata.update(training=json.dumps({"averaged": 1, "about": {}})),
    "no mapping": lambda _, metadata: metadata.update(training="[]"),
    "no moment": lambda tensors, _: tensors.pop("0.exp_avg_sq"),
    "no average": lambda tensors, _: tensors.pop("1.average"),
    "a parameter less": lambda tensors, _: [tensors.pop(name) for name in [*tensors] if name.startswith("0.")],
    "a parameter more": lambda tensors, _: tensors.update({"2.value": torch.zeros(1)}),
    "another shape": lambda tensors, _: tensors.update({"0.value": torch.zeros(2, 2)}),
    "a shape that spreads": lambda tensors, _: tensors.update({"0.value": torch.zeros(1)}),
    "an average that spreads": lambda tensors, _: tensors.update({"0.average": torch.zeros(1)}),
    "a moment of another shape": lambda tensors, _: tensors.update({"0.exp_avg": torch.zeros(1)}),
}


@pytest.mark.parametrize("change", list(CHANGES))
def test_a_file_that_lacks_something_or_has_too_much_is_refused(saved: Path, other: State, change: str) -> None:
    """And nothing of it is taken; unchanged, it is."""
    changed(saved, CHANGES[change])
    with pytest.raises(DamagedArtifact):
        load_state(other, saved)
    assert all(value.eq(9).all() for value in everything(other).values())


def test_a_file_that_is_read_and_written_anew_is_taken(saved: Path, other: State) -> None:
    changed(saved, lambda tensors, metadata: None)
    assert load_state(other, saved) == {}
    assert not any(value.eq(9).any() for value in everything(other).values())


def test_the_state_of_another_model_or_stage_is_refused(fresh, go_on, smallest, tmp_path: Path) -> None:
    path = tmp_path / "state.safetensors"
    first_stage = fresh(0, replace(TEACHING, joint=False))
    go_on(first_stage, 1)
    save_state(first_stage, path, {})
    wider = replace(smallest, network=smallest.network | {"block_out_channels": (8, 32)})
    deeper = replace(smallest, patch_tokens=smallest.patch_tokens | {"layers": 2})
    for other in (
        fresh(0, TEACHING),
        fresh(0, replace(TEACHING, joint=False), wider),
        fresh(0, replace(TEACHING, joint=False), deeper),
    ):
        with pytest.raises(DamagedArtifact):
            load_state(other, path)


def test_when_the_disk_is_full_the_previous_state_survives(fresh, go_on, tmp_path: Path, monkeypatch) -> None:
    state, path = fresh(), tmp_path / "state.safetensors"
    go_on(state, 2)
    save_state(state, path, {"note": "before"})
    go_on(state, 1)

    def full(_tensors: object, place: Path, _metadata: object) -> None:
        place.write_bytes(b"half of it")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("mv3d_cli.diffusion.training.state.save_file", full)
    with pytest.raises(OutOfSpace):
        save_state(state, path, {"note": "after"})
    again = fresh(1)
    assert load_state(again, path) == {"note": "before"}
    assert again.step == 2
    assert [*tmp_path.iterdir()] == [path]
