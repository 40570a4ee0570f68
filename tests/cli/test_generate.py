"""`mv3d generate` as a user runs it."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from mv3d_cli.diffusion.model import Model
from mv3d_cli.diffusion.model.checkpoint import save_model
from mv3d_cli.diffusion.model.config import ModelConfig
from mv3d_cli.diffusion.noise import NoiseSettings
from mv3d_cli.formats.images import read_depth, read_image
from mv3d_cli.steps.generate import HORIZONTAL

Spoil = Callable[[Path], Path]


@pytest.fixture(scope="session")
def mending(smallest: ModelConfig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model that answers with the draft, for pictures of 32 x 32 pixels."""
    tokens = {**(smallest.patch_tokens or {}), "size": 32, "patch": 16}
    noise = NoiseSettings(prediction="sample")
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("mending") / "model"
    save_model(Model(replace(smallest, drafts=True, noise=noise, patch_tokens=tokens, picture_size=32)), folder)
    return folder


def disc(ground: int = 255, radius: float = 0.5, x: float = 0.0, side: int = 120) -> np.ndarray:
    """A blue disc on a grey ground."""
    centres = (np.arange(side) + 0.5) / side * 2 - 1
    inside = np.hypot(*np.meshgrid(centres - x, centres)) < radius
    return np.where(inside[..., None], [30, 60, 200], ground).astype(np.uint8)


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    path = tmp_path / "photo.png"
    Image.fromarray(disc()).save(path)
    return path


def test_a_photo_becomes_views(mv3d, mending: Path, photo: Path, tmp_path: Path) -> None:
    made = mv3d("generate", photo, "--model", mending, "-o", tmp_path / "views")
    assert made.stderr == ""
    folder = made.path
    assert {path.name for path in folder.iterdir()} == {
        "artifact.json", "color", "depth", "input.png", "mask.png", "normal", "sheet.png", "transforms.json",
    }  # fmt: skip
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    assert tuple(frame["name"] for frame in frames) == HORIZONTAL
    assert [frame["source"] for frame in frames] == ["photo"] + 7 * ["generated"]
    assert all(0.2 <= frame["weight"] <= 1 for frame in frames[1:])
    for name in HORIZONTAL:
        color, depth = read_image(folder / "color" / f"{name}.png"), read_depth(folder / "depth" / f"{name}.exr")
        assert color.shape == (32, 32, 4)
        assert np.array_equal(color[..., 3] >= 128, depth > 0)
        assert 1 < depth[depth > 0].mean() < 2
    assert read_image(folder / "mask.png").shape == (120, 120, 4)


def test_pipes_and_is_kept(mv3d, forked, mending: Path, photo: Path) -> None:
    words = ("--model", str(mending), "--depth-only")
    first = forked("generate", photo, *words).path
    assert mv3d("generate", "-", *words, stdin=f"{photo}\n").path == first
    command = [str(Path(sys.executable).parent / "mv3d"), "generate", "-", *words]
    bytes_in = subprocess.run(command, input=photo.read_bytes(), capture_output=True, check=True)
    assert Path(bytes_in.stdout.decode().strip()) == first
    manifest = json.loads(forked("generate", photo, *words, "--json").stdout)
    assert manifest["path"] == str(first)
    assert forked("generate", photo, *words, "--fill", "0.5").path != first


def turned(path: Path) -> Path:
    """Lying on its side, with a word to turn it."""
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(np.rot90(disc(x=0.3)).copy()).save(path, exif=exif, quality=95)
    return path


def saved(name: str, make: Callable[[], Image.Image], **how: object) -> Spoil:
    def save(folder: Path) -> Path:
        make().save(folder / name, **how)
        return folder / name

    return save


def sixteen_bit() -> Image.Image:
    return Image.fromarray(disc()[..., 0].astype(np.uint16) * 257)


def rgb() -> Image.Image:
    return Image.fromarray(disc())


def opaque() -> Image.Image:
    return Image.fromarray(np.dstack([disc(), np.full((120, 120), 255, np.uint8)]))


@pytest.mark.parametrize(
    "save",
    [
        lambda folder: turned(folder / "turned.jpg"),
        saved("sixteen.png", sixteen_bit),
        saved("cmyk.jpg", lambda: rgb().convert("CMYK"), quality=95),
        saved("palette.png", lambda: rgb().quantize(8)),
        saved("animated.gif", rgb, save_all=True, append_images=[Image.fromarray(disc(0))]),
        saved("opaque.webp", opaque, lossless=True),
        saved("grey.png", lambda: rgb().convert("L")),
    ],
    ids=["EXIF", "16 bits", "CMYK", "palette", "animated", "opaque alpha", "grey"],
)
def test_photos_of_other_kinds(forked, mending: Path, tmp_path: Path, save: Spoil) -> None:
    path = save(tmp_path)
    made = forked("generate", path, "--model", mending, "--depth-only").path
    mask = read_image(made / "mask.png")[..., 0] > 127
    expected = disc(x=0.3 if path.name == "turned.jpg" else 0.0)[..., 0] == 30
    assert (mask & expected).sum() / (mask | expected).sum() > 0.93


def test_a_subject_that_touches_the_frame_is_warned_of(forked, mending: Path, tmp_path: Path) -> None:
    Image.fromarray(disc(x=0.7)).save(tmp_path / "cut.png")
    ran = forked("generate", tmp_path / "cut.png", "--model", mending, "--depth-only")
    assert ran.code == 0
    assert ran.stderr.startswith("warning:")
    assert "border" in ran.stderr


@pytest.mark.parametrize(
    ("make", "problem"),
    [
        (lambda: b"no picture at all", "cannot be decoded"),
        (lambda: b"", "cannot be decoded"),
        (lambda: Image.new("RGB", (1, 1)), "1x1"),
        (lambda: Image.new("1", (30_000, 20)), "30000x20"),
        (lambda: Image.new("RGBA", (64, 64)), "transparent everywhere"),
        (lambda: Image.new("RGB", (64, 64)), "stands out"),
        (lambda: Image.fromarray(np.hstack([disc(side=80), disc(side=80)])), "two objects"),
    ],
    ids=["text", "empty", "one pixel", "30,000 pixels", "transparent", "black", "two objects"],
)
def test_photos_that_are_refused(refused, forked, mending: Path, tmp_path: Path, make, problem: str) -> None:
    path, content = tmp_path / "photo.png", make()
    path.write_bytes(content) if isinstance(content, bytes) else content.save(path)
    ran = refused("generate", path, "--model", mending, "-o", tmp_path / "views", by=forked)
    assert problem in ran.stderr
    assert not (tmp_path / "views").exists()


@pytest.mark.parametrize(
    ("words", "problem", "advice"),
    [
        (["none.png"], "none.png", "path"),
        (["."], ". cannot be read", "file"),
        (["PHOTO", "--views", "front,lft"], "lft", "did you mean left?"),
        (["PHOTO", "--views", ","], "--views", "front"),
        (["PHOTO", "--fill", "2"], "--fill 2", "0.2 to 1"),
        (["PHOTO", "--steps", "0"], "--steps 0", "1 to"),
        (["PHOTO", "--sampler", "euler"], "euler", "mv3d generate --help"),
        (["PHOTO", "--guidance", "0"], "--guidance 0", "1 to 20"),
        (["PHOTO", "--model", "nowhere"], "nowhere", "small"),
        (["PHOTO", "--model", "."], "no model", "small"),
        (["PHOTO", "--stpes", "2"], "--stpes", "did you mean --steps?"),
    ],
)
def test_a_command_that_cannot_be(
    refused, forked, mending: Path, photo: Path, words: list[str], problem: str, advice: str
) -> None:
    given = [str(photo) if word == "PHOTO" else word for word in words]
    model = [] if "--model" in given else ["--model", str(mending)]
    error, hint = refused("generate", *given, *model, by=forked).stderr.splitlines()
    assert problem in error
    assert advice.lower() in hint.lower()


def test_nothing_on_standard_input(refused) -> None:
    assert "no photo" in refused("generate", "-").stderr


def test_a_hub_id_without_a_network(refused, photo: Path, tmp_path: Path) -> None:
    offline = {"HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path)}
    ran = refused("generate", photo, "--model", "someone/something", env=offline)
    assert "hf download someone/something" in ran.stderr


def truncated(folder: Path) -> None:
    weights = folder / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-100])


def without_configuration(folder: Path) -> None:
    (folder / "config.json").unlink()


def with_half_a_configuration(folder: Path) -> None:
    path = folder / "config.json"
    path.write_text(path.read_text()[:100])


def without_weights(folder: Path) -> None:
    (folder / "model.safetensors").unlink()


def of_another_model(folder: Path) -> None:
    path = folder / "config.json"
    content = json.loads(path.read_text())
    content["network"]["block_out_channels"] = [16, 16]
    path.write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("spoil", "problem"),
    [
        (truncated, "damaged"),
        (without_configuration, "config.json"),
        (with_half_a_configuration, "config.json"),
        (without_weights, "model.safetensors"),
        (of_another_model, "another model"),
    ],
)
def test_models_that_cannot_be_used(
    refused, forked, mending: Path, photo: Path, tmp_path: Path, spoil: Callable[[Path], None], problem: str
) -> None:
    folder = Path(shutil.copytree(mending, tmp_path / "model"))
    spoil(folder)
    assert problem in refused("generate", photo, "--model", folder, by=forked).stderr


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_no_cuda(refused, forked, mending: Path, photo: Path) -> None:
    assert "--device cuda" in refused("generate", photo, "--model", mending, "--device", "cuda", by=forked).stderr
