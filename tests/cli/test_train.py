"""`mv3d train` as a user runs it: the artifact, data of all kinds, stages and presets."""

from __future__ import annotations

import csv
import json
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from mv3d_cli.diffusion.devices import has_quick_bf16
from mv3d_cli.diffusion.model.checkpoint import load_model
from mv3d_cli.formats.images import read_image

TINY = ("train", "--preset", "tiny", "--procedural", "3", "--batch", "2", "--steps", "3", "--jobs", "0")
PRECISION = "bf16" if has_quick_bf16(torch.device("cpu")) else "fp32"
SMALL = ("--batch", "1", "--jobs", "0", "--reuse", "1", "--views", "front,right")


def curve(folder: Path) -> list[dict[str, str]]:
    with (folder / "curve.csv").open(newline="") as file:
        return [*csv.DictReader(file)]


def record(folder: Path) -> dict:
    return json.loads((folder / "training.json").read_text())


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """A cache for the whole module."""
    return {"MV3D_CACHE_DIR": str(tmp_path_factory.mktemp("cache"))}


@pytest.fixture(scope="module")
def tiny(mv3d, cache: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny model after three steps, by the installed command."""
    folder = tmp_path_factory.mktemp("tiny") / "model"
    ran = mv3d(*TINY, "--validate-every", "2", "-o", folder, env=cache)
    assert ran.stderr == ""
    return ran.path


def test_the_model_and_what_tells_of_it(tiny: Path) -> None:
    names = {path.name for path in tiny.iterdir()}
    assert names == {
        *("artifact.json", "config.json", "curve.csv", "logs", "model.safetensors", "training.json", "validation")
    }
    model = load_model(tiny)
    assert model.config.picture_size == 32
    assert all(torch.isfinite(parameter).all() for parameter in model.parameters())
    told = record(tiny)
    assert not told["paused"]
    assert (told["settings"]["batch"], told["settings"]["lr"], told["settings"]["precision"]) == (2, 5e-4, PRECISION)
    (stage,) = told["stages"]
    assert (stage["stage"], stage["steps"], stage["objects"]) == ("1", 3, 6)
    assert stage["loss"] == pytest.approx(np.mean([float(row["loss"]) for row in curve(tiny)]))


def test_the_curve_has_a_row_for_each_step(tiny: Path) -> None:
    rows = curve(tiny)
    assert [(row["step"], row["objects"]) for row in rows] == [("1", "2"), ("2", "4"), ("3", "6")]
    assert all(0 < float(row["loss"]) < 10 for row in rows)
    assert [float(row["lr"]) for row in rows] == pytest.approx([5e-6, 1e-5, 1.5e-5])
    assert [bool(row["psnr"]) for row in rows] == [False, True, True]
    for name in ("0000002.png", "0000003.png"):
        sheet = read_image(tiny / "validation" / name)
        assert len(np.unique(sheet[::9, ::9].reshape(-1, sheet.shape[-1]), axis=0)) > 100


def test_tensorboard_is_told_the_same(tiny: Path) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(tiny / "logs"))
    events.Reload()
    scalars = set(events.Tags()["scalars"])
    assert {"loss", "lr", "gradient norm", "validation/psnr", "validation/depth error", "seconds/waiting"} <= scalars
    assert [event.step for event in events.Scalars("loss")] == [1, 2, 3]
    written = [float(row["loss"]) for row in curve(tiny)]
    assert [event.value for event in events.Scalars("loss")] == pytest.approx(written, rel=1e-6)
    assert [event.step for event in events.Scalars("validation/psnr")] == [2, 3]
    assert [event.step for event in events.Images("validation")] == [2, 3]


def test_the_same_once_more_is_there_already(forked, cache: dict[str, str], tiny: Path, tmp_path: Path) -> None:
    started = time.monotonic()
    ran = forked(*TINY, "--validate-every", "2", "--json", "-o", tmp_path / "again", env=cache)
    assert time.monotonic() - started < 20
    manifest = json.loads(ran.stdout)
    assert manifest["key"] == json.loads((tiny / "artifact.json").read_text())["key"]
    assert (manifest["path"], manifest["step"]) == (str(tmp_path / "again"), "train")
    assert (tmp_path / "again" / "curve.csv").read_bytes() == (tiny / "curve.csv").read_bytes()


@pytest.fixture(scope="module")
def dataset(forked, cache: dict[str, str]) -> Path:
    """Three rendered objects, 8 px."""
    return forked("render", "--procedural", "3", "--size", "8", "--jobs", "1", env=cache).path


def test_a_rendered_data_set_serves_as_meshes_do(forked, little: Path, dataset: Path, tmp_path: Path) -> None:
    words = ("--from", little, "--steps", "2", "--batch", "2", "--jobs", "0", "-o", tmp_path / "model")
    model = forked("train", dataset, *words).path
    assert load_model(model).config.picture_size == 8
    assert record(model)["stages"][0]["data"] == "3 objects"
    assert len(curve(model)) == 2
    drawn = forked("train", "--procedural", "3", *words[:-2]).path
    close = [(float(a["psnr"]), float(b["psnr"])) for a, b in zip(curve(model)[-1:], curve(drawn)[-1:], strict=True)]
    assert abs(close[0][0] - close[0][1]) < 6


def test_pictures_of_another_size_are_refused_with_the_right_one(refused, forked, dataset: Path) -> None:
    ran = refused("train", dataset, "--preset", "tiny", "--jobs", "0", by=forked)
    assert "8 x 8 pixels, the model 32 x 32" in ran.stderr
    assert "--size 32" in ran.stderr


def test_a_broken_object_among_good_ones_is_left_out(forked, little: Path, meshes: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(meshes, tmp_path / "meshes"))
    (folder / "broken.glb").write_bytes(b"glTF and then nothing")
    ran = forked("train", folder, "--from", little, "--steps", "6", "--batch", "2", "--reuse", "1", "--jobs", "0")
    assert len(curve(ran.path)) == 6
    (warning,) = ran.stderr.splitlines()
    assert warning.startswith("warning: broken is left out: ")


def test_stages_build_on_each_other(forked, tiny: Path, tmp_path: Path) -> None:
    """Two and distill from one; the record says all that was done."""
    words = ("--preset", "tiny", "--procedural", "2", "--steps", "2", *SMALL)
    two = forked("train", *words, "--stage", "2", "--from", tiny, "-o", tmp_path / "two").path
    few = forked("train", *words, "--stage", "distill", "--from", two, "-o", tmp_path / "few").path
    stages = record(few)["stages"]
    assert [done["stage"] for done in stages] == ["1", "2", "distill"]
    assert stages[:2] == record(two)["stages"]
    assert stages[:1] == record(tiny)["stages"]
    load_model(few)
    assert "train" in forked("cache", "why", few).stdout


def test_the_small_model_learns_from_its_autoencoder_on(forked, tmp_path: Path) -> None:
    words = ("--procedural", "1", "--steps", "1", *SMALL)
    autoencoder = forked("train", *words, "--stage", "autoencoder", "-o", tmp_path / "autoencoder").path
    assert [done["stage"] for done in record(autoencoder)["stages"]] == ["autoencoder"]
    model = forked("train", *words, "--from", autoencoder, "--half", "-o", tmp_path / "model").path
    assert [done["stage"] for done in record(model)["stages"]] == ["autoencoder", "1"]
    assert load_model(model).config.picture_size == 256


@pytest.fixture(scope="module")
def stable_diffusion(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Stable Diffusion Image Variations at tiny width, latents of 16 x 16, saved by the libraries."""
    transformers = pytest.importorskip("transformers")
    from diffusers import AutoencoderKL, PNDMScheduler, UNet2DConditionModel

    folder = tmp_path_factory.mktemp("stable_diffusion")
    torch.manual_seed(0)
    narrow = {"norm_num_groups": 4, "layers_per_block": 1}
    UNet2DConditionModel(
        sample_size=16, block_out_channels=(8, 8, 16, 16), attention_head_dim=2, cross_attention_dim=12, **narrow
    ).save_pretrained(folder / "unet")
    levels = {"down_block_types": ("DownEncoderBlock2D",) * 5, "up_block_types": ("UpDecoderBlock2D",) * 5}
    AutoencoderKL(block_out_channels=(8,) * 5, latent_channels=4, **levels, **narrow).save_pretrained(folder / "vae")
    clip = {"hidden_size": 16, "intermediate_size": 32, "num_hidden_layers": 1, "num_attention_heads": 2}
    vision = transformers.CLIPVisionConfig(image_size=28, patch_size=14, projection_dim=12, **clip)
    transformers.CLIPVisionModelWithProjection(vision).save_pretrained(folder / "image_encoder")
    noise = {"beta_schedule": "scaled_linear", "beta_start": 0.00085, "beta_end": 0.012}
    PNDMScheduler(**noise, skip_prk_steps=True).save_pretrained(folder / "scheduler")
    return folder


def test_stable_diffusion_is_a_start(forked, stable_diffusion: Path, tmp_path: Path) -> None:
    """Paused after its first step; and what was taught is a start again."""
    words = ("--preset", "sd", "--procedural", "1", *SMALL)
    first = ("train", *words, "--steps", "2", "--from", stable_diffusion, "-o", tmp_path / "one")
    assert "paused after 1 of 2 steps" in forked(*first, "--max-time", "0").stderr
    model = load_model(forked(*first).path)
    assert model.config.clip is not None
    assert model.config.picture_size == 256
    two = forked("train", *words, "--stage", "2", "--steps", "1", "--from", tmp_path / "one").path
    assert [done["stage"] for done in record(two)["stages"]] == ["1", "2"]
    assert record(two)["settings"]["lr"] == 5e-5
