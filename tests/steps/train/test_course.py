"""Trainings as artifacts: the same once more, gone on with in every stage, stopped where they must be."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file

from mv3d_cli.diffusion.model.checkpoint import load_model
from mv3d_cli.diffusion.training.objectives import DiffusionObjective
from mv3d_cli.errors import DamagedArtifact, MissingInput, UsageError, WorkFailed
from mv3d_cli.steps.settings import Progress, Warned, silent
from mv3d_cli.steps.train import run, seconds_of
from mv3d_cli.store import Artifact, deliver

Runs = Callable[..., Artifact]


def losses(artifact: Artifact) -> list[str]:
    """The losses of all steps, as they are written."""
    with (artifact.path / "curve.csv").open(newline="") as file:
        return [row["loss"] for row in csv.DictReader(file)]


def same_weights(one: Artifact, other: Artifact) -> bool:
    first, second = (load_file(artifact.path / "model.safetensors") for artifact in (one, other))
    assert first.keys() == second.keys()
    return all(torch.equal(value, second[name]) for name, value in first.items())


def record(artifact: Artifact) -> dict:
    return json.loads((artifact.path / "training.json").read_text())


def works(cache: Path) -> list[Path]:
    """The folders of trainings that are not finished."""
    return sorted(cache.glob("v1/train/*/*.work"))


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Runs:
    """Runs a training in a cache of its own."""

    def made(*args: object) -> Artifact:
        with monkeypatch.context() as patched:
            patched.setenv("MV3D_CACHE_DIR", str(tmp_path / "elsewhere"))
            return run(*args)

    return made


def test_a_training_is_told_step_by_step_and_made_once(settings, meshes: Path) -> None:
    told: list[Progress | Warned] = []
    first = run(settings(), [meshes], told.append)
    assert [(event.done, event.total, event.unit) for event in told] == [(n, 3, "steps") for n in (1, 2, 3)]
    assert "loss" in told[-1].note
    assert run(settings(jobs=1, save_every=0.0, max_time="9m"), [meshes], told.append).path == first.path
    assert len(told) == 3
    load_model(first.path)


@pytest.mark.parametrize(
    "changes",
    [{"lr": 1e-3}, {"seed": 1}, {"precision": "bf16"}, {"views": ("front",)}],
)
def test_what_changes_the_result_is_another_training(settings, meshes: Path, changes: dict) -> None:
    few = settings(steps=1)
    first, other = run(few, [meshes]), run(replace(few, **changes), [meshes])
    assert other.path != first.path
    assert not same_weights(first, other)


def test_other_objects_to_validate_on_are_another_training(settings, meshes: Path, tmp_path: Path) -> None:
    """Also where a file changes and keeps its size; what is learnt is the same."""
    wedge = tmp_path / "wedge.obj"
    config = settings(steps=1, validation=wedge)
    wedge.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n")
    first = run(config, [meshes])
    wedge.write_text(wedge.read_text().replace("v 0 0 1", "v 0 0 3"))
    other = run(config, [meshes])
    assert other.path != first.path
    assert record(other)["stages"][0]["psnr"] != record(first)["stages"][0]["psnr"]
    assert same_weights(first, other)


def test_validation_data_without_a_usable_object_is_told_before_learning(settings, meshes: Path, broken) -> None:
    told: list[Progress | Warned] = []
    with pytest.raises(MissingInput, match="no object to validate on"):
        run(settings(validation=broken.mesh.path.parent), [meshes], told.append)
    assert told == []


STAGES = {
    "1": {},
    "1 in bf16": {"precision": "bf16"},
    "2": {"stage": "2"},
    "distill": {"stage": "distill", "guidance": 2.0},
}


@pytest.mark.parametrize("stage", STAGES)
def test_a_training_with_pauses_equals_an_unbroken_one(settings, meshes: Path, elsewhere, stage: str) -> None:
    config = settings(**STAGES[stage], warmup=1, ema=0.5)
    if stage == "distill":
        config = replace(config, from_=str(run(settings(stage="2", steps=1), [meshes]).path))
    unbroken = elsewhere(config, [meshes])
    told: list[Progress | Warned] = []
    pieces = [run(replace(config, max_time=time), [meshes], told.append) for time in ("0", "0s", "1h")]
    assert [record(piece)["paused"] for piece in pieces] == [True, True, False]
    assert [event.text for event in told if isinstance(event, Warned)] == [
        f"paused after {step} of 3 steps; the same command goes on" for step in (1, 2)
    ]
    assert [event.done for event in told if isinstance(event, Progress)] == [1, 2, 3]
    assert losses(pieces[-1]) == losses(unbroken)
    assert same_weights(pieces[-1], unbroken)
    assert not same_weights(pieces[0], pieces[1])
    assert "state.safetensors" not in {path.name for piece in pieces for path in piece.path.iterdir()}
    load_model(pieces[0].path)


def test_validating_and_saving_change_nothing(settings, meshes: Path, elsewhere) -> None:
    plain = elsewhere(settings(), [meshes])
    watched = run(settings(validate_every=1, save_every=0.0), [meshes])
    assert losses(watched) == losses(plain)
    assert same_weights(watched, plain)
    assert {path.name for path in (watched.path / "validation").iterdir()} == {f"000000{n}.png" for n in (1, 2, 3)}
    with (watched.path / "curve.csv").open(newline="") as file:
        assert all(float(row["psnr"]) > 0 and float(row["depth_error"]) > 0 for row in csv.DictReader(file))


def test_the_average_is_what_is_kept(settings, meshes: Path) -> None:
    """With a decay of zero it is the last step's weights; with a large one it stays near the first."""
    runs = [run(settings(ema=ema, lr=1e-2, warmup=0), [meshes]) for ema in (1.0, 0.0)]
    near, far = (load_file(artifact.path / "model.safetensors") for artifact in runs)
    start = load_file(Path(settings().from_) / "model.safetensors")
    moved = [sum((weights[name] - start[name]).abs().sum() for name in start) for weights in (near, far)]
    assert 0 < moved[0] < 0.9 * moved[1]


def interrupted(*_: object) -> None:
    raise KeyboardInterrupt


def test_a_process_that_ends_after_the_last_step_has_not_to_learn_again(settings, meshes: Path, monkeypatch) -> None:
    with monkeypatch.context() as patched:
        patched.setattr("mv3d_cli.store.production.describe", interrupted)
        with pytest.raises(KeyboardInterrupt):
            run(settings(), [meshes])
    told: list[Progress | Warned] = []
    artifact = run(settings(), [meshes], told.append)
    assert told == []
    assert len(losses(artifact)) == 3
    assert not record(artifact)["paused"]


def test_what_a_killed_process_left_half_written_is_not_kept(settings, meshes: Path, cache_folder: Path) -> None:
    run(settings(max_time="0"), [meshes])
    (work,) = works(cache_folder)
    (work / ".state.safetensors.12345").write_bytes(b"half")
    artifact = run(settings(), [meshes])
    names = {path.name for path in artifact.path.iterdir()}
    assert names == {
        *("artifact.json", "config.json", "curve.csv", "logs", "model.safetensors", "training.json", "validation")
    }


@pytest.mark.parametrize("kind", ["loss", "gradient"])
def test_numbers_that_are_none_stop_it_and_are_not_saved(
    settings, meshes: Path, cache_folder: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    """The root of zero has a value, and no slope."""
    forward, calls = DiffusionObjective.forward, []

    def spoilt(objective: DiffusionObjective, batch: object) -> torch.Tensor:
        calls.append(batch)
        loss = forward(objective, batch)
        if len(calls) < 3:
            return loss
        return loss * float("nan") if kind == "loss" else loss + (loss * 0).sqrt()

    monkeypatch.setattr(DiffusionObjective, "forward", spoilt)
    with pytest.raises(WorkFailed, match=f"the {kind} is no longer a number at step 3; the last good checkpoint is"):
        run(settings(save_every=0.0), [meshes])
    (work,) = works(cache_folder)
    with safe_open(work / "state.safetensors", "pt") as file:
        assert json.loads(file.metadata()["training"])["step"] == 2
        assert all(torch.isfinite(file.get_tensor(name)).all() for name in file.keys())  # noqa: SIM118
    monkeypatch.setattr(DiffusionObjective, "forward", forward)
    assert len(losses(run(settings(), [meshes]))) == 3


def test_without_a_checkpoint_that_is_said(settings, meshes: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(DiffusionObjective, "forward", lambda *_: torch.full((), torch.nan, requires_grad=True))
    with pytest.raises(WorkFailed, match="at step 1; there is no checkpoint before it") as caught:
        run(settings(), [meshes])
    assert "--lr" in caught.value.hint


def test_a_damaged_checkpoint_is_told_of(settings, meshes: Path, cache_folder: Path) -> None:
    run(settings(max_time="0"), [meshes])
    (work,) = works(cache_folder)
    state = work / "state.safetensors"
    state.write_bytes(state.read_bytes()[:-100])
    with pytest.raises(DamagedArtifact, match=r"state\.safetensors") as caught:
        run(settings(), [meshes])
    assert str(work) in caught.value.hint


def test_a_paused_training_is_not_taken_for_another(settings, meshes: Path, tmp_path: Path) -> None:
    given = settings(lr=1e-3, max_time="0")
    output = tmp_path / "model"
    deliver(run(given, [meshes], silent, output), output)
    others = {
        "--lr 0.0005 \\(was 0.001\\)": (replace(given, lr=None), [meshes]),
        "--batch 1 \\(was 2\\), --seed 4 \\(was 0\\)": (replace(given, batch=1, seed=4), [meshes]),
        "the data": (given, [meshes, meshes / "box.ply"]),
        "the start": (replace(given, from_=None, preset="tiny"), [meshes]),
    }
    for difference, (config, inputs) in others.items():
        with pytest.raises(UsageError, match=difference):
            run(config, inputs, silent, output)
    deliver(run(replace(given, max_time=None), [meshes], silent, output), output)
    assert not json.loads((output / "training.json").read_text())["paused"]
    run(settings(steps=1), [meshes], silent, output)  # what is finished may be replaced


@pytest.mark.parametrize(
    ("text", "seconds"), [("90", 90), ("90s", 90), (" 1.5 m ", 90), ("2h", 7200), ("0", 0), (None, None)]
)
def test_times_are_read(text: str | None, seconds: float | None) -> None:
    assert seconds_of(text) == seconds


@pytest.mark.parametrize("text", ["soon", "", "-1s", "1d", "1h30m", "nan", "1e3"])
def test_what_is_no_time_is_refused(settings, meshes: Path, text: str) -> None:
    with pytest.raises(UsageError, match="--max-time"):
        run(settings(max_time=text), [meshes])


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"stage": "autoencoder"}, "no autoencoder"),
        ({"stage": "distill"}, "nothing to distill"),
        ({"stage": "3"}, "--stage 3"),
        ({"dropout": 0.5}, "--dropout 0.5"),
        ({"validation": Path("nowhere")}, "nowhere"),
        pytest.param(
            {"device": "cuda"}, "cuda", marks=pytest.mark.skipif(torch.cuda.is_available(), reason="there is CUDA")
        ),
    ],
)
def test_settings_that_cannot_be_are_refused(settings, meshes: Path, changes: dict, problem: str) -> None:
    with pytest.raises(UsageError, match=problem) as caught:
        run(settings(**changes), [meshes])
    assert len(caught.value.hint) > 8


def test_the_record_grows_from_stage_to_stage(settings, meshes: Path) -> None:
    first = run(settings(steps=2), [meshes])
    second = run(settings(stage="2", steps=1, from_=str(first.path)), [meshes])
    third = run(settings(stage="distill", steps=2, from_=str(second.path)), [meshes])
    stages = record(third)["stages"]
    assert [(done["stage"], done["steps"], done["objects"]) for done in stages] == [
        ("1", 2, 4),
        ("2", 1, 2),
        ("distill", 2, 4),
    ]
    assert record(third)["settings"]["lr"] == 5e-5
    (start,) = (item for item in third.manifest["inputs"] if item["label"] == "start")
    assert start["made_by"]["key"] == second.key
    assert not start["made_by"]["edited"]
