"""What `mv3d train` cannot use is refused in two lines, and nothing is left behind."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

FEW = ("--procedural", "2", "--views", "front", "--batch", "1", "--steps", "2", "--jobs", "0")


@pytest.mark.parametrize(
    ("words", "problem", "advice"),
    [
        ([], "nothing to learn from", "--procedural"),
        (["none.glb"], "none.glb", "path"),
        ([*FEW, "--max-time", "nonsense"], "--max-time nonsense", "9m"),
        ([*FEW, "--stage", "nonsense"], "nonsense", "mv3d train --help"),
        ([*FEW, "--preset", "tiny", "--stage", "autoencoder"], "no autoencoder", "--stage 1"),
        ([*FEW, "--preset", "tiny", "--stage", "distill"], "nothing to distill", "stages 1 and 2"),
        ([*FEW, "--preset", "huge"], "huge", "mv3d train --help"),
        ([*FEW, "--views", "front,lft"], "lft", "did you mean left?"),
        ([*FEW, "--views", ","], "--views", "front"),
        ([*FEW, "--steps", "0"], "--steps 0", "1 to"),
        ([*FEW, "--lr", "nan"], "--lr nan", "0 to 1"),
        ([*FEW, "--validation", "nowhere"], "nowhere", "path"),
        ([*FEW, "--from", "nowhere"], "nowhere", "model folder"),
        ([*FEW, "--preset", "sd", "--from", "no where"], "no where", "diffusers"),
        ([*FEW, "--stpes", "3"], "--stpes", "did you mean --steps?"),
    ],
)
def test_a_command_that_cannot_be(refused, forked, words: list[str], problem: str, advice: str) -> None:
    error, hint = refused("train", *words, by=forked).stderr.splitlines()
    assert problem in error
    assert advice.lower() in hint.lower()


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_no_cuda(refused, forked) -> None:
    ran = refused("train", *FEW, "--device", "cuda", by=forked)
    assert "--device cuda" in ran.stderr
    assert "cpu" in ran.stderr


def test_a_hub_id_without_a_network(refused, tmp_path: Path) -> None:
    offline = {"HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path)}
    ran = refused("train", *FEW, "--preset", "sd", "--from", "someone/something", env=offline)
    assert "hf download someone/something" in ran.stderr


@pytest.mark.parametrize("preset", ["small", "tiny"])
def test_data_of_which_nothing_can_be_used(refused, forked, little: Path, tmp_path: Path, preset: str) -> None:
    refused("train", tmp_path, "--preset", preset, "--from", little, by=forked)
    (tmp_path / "broken.glb").write_bytes(b"glTF and then nothing")
    (tmp_path / "empty.stl").write_bytes(b"")
    ran = refused("train", tmp_path, "--preset", preset, "--from", little, "--jobs", "1", by=forked)
    assert "no object of the data can be used" in ran.stderr
    assert "broken" in ran.stderr or "empty" in ran.stderr


def truncated(folder: Path) -> None:
    weights = folder / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-100])


def _changed(folder: Path, change: Callable[[torch.Tensor], torch.Tensor]) -> None:
    """The first convolution otherwise."""
    weights, name = folder / "model.safetensors", "network.unet.conv_in.weight"
    with safe_open(weights, "pt") as file:
        metadata = file.metadata()
    tensors = load_file(weights)
    save_file(tensors | {name: change(tensors[name]).contiguous()}, weights, metadata)


def of_another_shape(folder: Path) -> None:
    _changed(folder, lambda weight: weight[:, 1:])


def without_configuration(folder: Path) -> None:
    (folder / "config.json").unlink()


def with_half_a_configuration(folder: Path) -> None:
    path = folder / "config.json"
    path.write_text(path.read_text()[:100])


def of_another_model(folder: Path) -> None:
    path = folder / "config.json"
    content = json.loads(path.read_text())
    content["network"]["block_out_channels"] = [16, 16]
    path.write_text(json.dumps(content))


def without_weights(folder: Path) -> None:
    (folder / "model.safetensors").unlink()


@pytest.mark.parametrize(
    ("spoil", "problem"),
    [
        (truncated, "damaged"),
        (of_another_shape, "conv_in"),
        (of_another_model, "conv_shortcut"),
        (without_configuration, "config.json"),
        (with_half_a_configuration, "config.json"),
        (without_weights, "model.safetensors"),
    ],
)
def test_a_start_that_cannot_be_used(
    refused, forked, little: Path, tmp_path: Path, spoil: Callable[[Path], None], problem: str
) -> None:
    folder = Path(shutil.copytree(little, tmp_path / "model"))
    spoil(folder)
    ran = refused("train", *FEW, "--from", folder, "-o", tmp_path / "out", by=forked)
    assert problem in ran.stderr
    assert os.listdir(tmp_path) == ["model"]


@pytest.mark.parametrize("suffix", [".bin", ".pt", ".ckpt"])
def test_pickles_are_not_opened(refused, forked, tmp_path: Path, suffix: str) -> None:
    class Trap:
        def __reduce__(self):
            return open, (str(tmp_path / "sprung"), "w")

    path = tmp_path / f"model{suffix}"
    torch.save({"weight": Trap()}, path)
    assert "pickled weights can run code" in refused("train", *FEW, "--from", path, by=forked).stderr
    assert not (tmp_path / "sprung").exists()


def test_a_loss_that_is_no_number_stops_it(refused, forked, little: Path, cache_folder: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(little, tmp_path / "model"))
    _changed(folder, lambda weight: weight * float("nan"))
    command = ("train", *FEW, "--from", folder, "--save-every", "0", "-o", tmp_path / "out")
    ran = refused(*command, by=forked, code=1)
    assert "no longer a number at step 1" in ran.stderr
    assert "no checkpoint before it" in ran.stderr
    assert not (tmp_path / "out").exists()
    assert not [*cache_folder.rglob("state.safetensors")]


def test_a_checkpoint_before_the_loss_was_lost_is_named(refused, forked, little: Path, cache_folder: Path) -> None:
    """A state in which a number was spoilt stands for weights that grow until they overflow."""
    command = ("train", *FEW, "--from", little)
    forked(*command, "--max-time", "0")
    (state,) = cache_folder.rglob("state.safetensors")
    with safe_open(state, "pt") as file:
        metadata, tensors = file.metadata(), {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    save_file(tensors | {"0.value": tensors["0.value"] * float("inf")}, state, metadata)
    ran = refused(*command, by=forked, code=1)
    assert "no longer a number at step 2" in ran.stderr
    assert f"the last good checkpoint is {state}" in ran.stderr


def test_outputs_that_must_not_be_written(refused, forked, little: Path, tmp_path: Path) -> None:
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs" / "thesis.txt").write_text("mine")
    refused("train", *FEW, "--from", little, "-o", tmp_path / "theirs", by=forked)
    assert os.listdir(tmp_path / "theirs") == ["thesis.txt"]
