"""Views from answers of known shape, and of a model that is silent: its answer is the draft of the photo."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from mv3d_cli.capture.draft import draft_views
from mv3d_cli.diffusion.model import Model
from mv3d_cli.diffusion.model.checkpoint import load_model, save_model
from mv3d_cli.diffusion.model.config import ModelConfig
from mv3d_cli.diffusion.noise import NoiseSettings
from mv3d_cli.errors import BadCameras, BadImage, MissingInput, UsageError, WorkFailed
from mv3d_cli.formats.cameras import load_cameras, select
from mv3d_cli.formats.images import read_image, read_photo, write_png
from mv3d_cli.formats.views_folder import read_views
from mv3d_cli.metrics.overlap import iou
from mv3d_cli.scene.conventions import normal_from_bytes
from mv3d_cli.steps.generate import HORIZONTAL, Config, fill_of, run
from mv3d_cli.steps.generate.answers import (
    LEAST_WEIGHT,
    NOTHING,
    PHOTO_WEIGHT,
    generated_view,
    halfway,
    is_level,
    outline_of,
    photo_view,
)
from mv3d_cli.steps.generate.making import is_half
from mv3d_cli.steps.generate.models import found
from mv3d_cli.steps.settings import Progress, Warned

SIDE = 256
FRONT, BACK = select(load_cameras(), ("front", "back"))


def places(side: int = SIDE) -> tuple[np.ndarray, np.ndarray]:
    centres = (np.arange(side) + 0.5) / side * 2 - 1
    return np.meshgrid(centres, centres)


def ball(radius: float = 0.6) -> tuple[np.ndarray, np.ndarray]:
    """(mask, depth as a model shows it) of a ball at the origin."""
    square = radius**2 - places()[0] ** 2 - places()[1] ** 2
    depth = np.where(square > 0, 2 - np.sqrt(np.maximum(square, 0)), NOTHING)
    return square > 0, depth.astype(np.float32)


def blurred(picture: np.ndarray, pixels: float) -> np.ndarray:
    return cv2.GaussianBlur(picture.astype(np.float32), (0, 0), pixels) if pixels else picture


def test_the_outline_of_a_ball_and_how_sure_it_is() -> None:
    mask, depth = ball()
    grain = np.random.default_rng(0).normal(scale=0.03, size=depth.shape).astype(np.float32)
    weights = []
    for pixels in (0, 1, 2, 4, 8):
        outline = outline_of(blurred(depth, pixels) + grain)
        assert iou(outline.mask, mask) > (0.98 if pixels < 3 else 0.85)
        assert not (outline.sure & ~outline.mask).any()
        weights.append(outline.weight)
    assert weights == sorted(weights, reverse=True)
    assert weights[0] > 0.9
    assert LEAST_WEIGHT <= weights[-1] < 0.5


def test_nothing_has_no_outline_and_the_least_weight() -> None:
    outline = outline_of(np.full((64, 64), NOTHING, np.float32))
    assert not outline.mask.any()
    assert outline.weight == pytest.approx(LEAST_WEIGHT)


def test_rows_that_are_empty_in_the_photo_are_empty() -> None:
    _, depth = ball()
    rows = np.zeros(SIDE, bool)
    rows[90:170] = True
    there = outline_of(depth, rows).mask.any(axis=1)
    assert there[90:170].all()
    assert not there[:87].any()
    assert not there[173:].any()


def test_a_far_leg_beside_a_near_seat_is_kept() -> None:
    x, y = places()
    depth = np.full((SIDE, SIDE), NOTHING, np.float32)
    seat, leg = (np.abs(x) < 0.5) & (np.abs(y + 0.1) < 0.1), (np.abs(x - 0.4) < 0.04) & (np.abs(y - 0.3) < 0.3)
    depth[leg], depth[seat] = 2.3, 1.3
    assert iou(outline_of(depth).mask, seat | leg) > 0.95


def test_specks_and_pinholes_are_gone() -> None:
    mask, depth = ball()
    depth[10:13, 10:13] = 1.5
    depth[120:124, 130:134] = NOTHING
    assert iou(outline_of(depth).mask, mask) > 0.98


def test_a_generated_view_has_no_halo() -> None:
    mask, depth = ball()
    pixels = 2.0
    color = np.where(mask[..., None], np.array([200, 40, 30]), 255).astype(np.float32)
    mixed = blurred(color, pixels).round().astype(np.uint8)
    soft = blurred(depth, pixels)
    view = generated_view(mixed, soft, outline_of(soft), BACK)
    assert view.color is not None
    assert view.depth is not None
    assert view.normal is not None
    inside = view.color[..., 3] >= 128
    assert np.array_equal(inside, view.depth > 0)
    assert (view.source, view.depth.dtype) == ("generated", np.float32)
    assert np.abs(view.color[inside][:, :3].astype(int) - [200, 40, 30]).max() < 25  # of 225
    assert ((view.color[..., 3] > 0) & (view.color[..., 3] < 255)).any()
    inner = np.hypot(*places()) < 0.5
    assert np.abs(view.depth - depth)[inner].max() < 0.05
    assert view.depth.max() < 2.2  # nothing between the surface and the far side
    x, y = places()
    true = np.dstack([x, -y, np.sqrt(np.maximum(0.36 - x**2 - y**2, 0))]) / 0.6
    cosine = (normal_from_bytes(view.normal) * true).sum(axis=-1)[inner]
    assert np.rad2deg(np.arccos(cosine.clip(-1, 1))).mean() < 3


def test_the_photo_keeps_its_alpha_and_gets_depth_inside_it() -> None:
    _, depth = ball(0.6)
    wider, _ = ball(0.65)
    photo = np.dstack([np.full((SIDE, SIDE, 3), 90, np.uint8), np.where(wider, 255, 0).astype(np.uint8)])
    view = photo_view(photo, depth, FRONT)
    assert view is not None
    assert view.depth is not None
    assert np.array_equal(view.color, photo)
    assert (view.source, view.weight) == ("photo", PHOTO_WEIGHT)
    assert np.array_equal(view.depth > 0, wider)
    assert view.depth.max() < 2.1
    assert photo_view(photo, np.full((SIDE, SIDE), NOTHING, np.float32), FRONT) is None


def test_two_depths_meet_halfway() -> None:
    depth = ball()[1]
    view = generated_view(np.full((SIDE, SIDE, 3), 90, np.uint8), depth, outline_of(depth), BACK)
    flat = np.where(np.hypot(*places()) < 0.4, 2.0, 0.0)
    met = halfway(view, replace(view, depth=flat))
    assert view.depth is not None
    assert met.depth is not None
    np.testing.assert_allclose(met.depth[flat > 0], (view.depth[flat > 0] + 2) / 2)
    np.testing.assert_array_equal(met.depth[flat == 0], view.depth[flat == 0])
    assert not np.array_equal(met.normal, view.normal)


def test_which_cameras_are_level() -> None:
    rig = load_cameras()
    assert tuple(camera.name for camera in rig if is_level(camera)) == HORIZONTAL


@pytest.fixture(scope="module")
def silent_model(smallest: ModelConfig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model that answers with the draft, for pictures of 64 x 64 pixels."""
    tokens = {**(smallest.patch_tokens or {}), "size": 64, "patch": 32}
    noise = NoiseSettings(prediction="sample")
    config = replace(smallest, drafts=True, noise=noise, patch_tokens=tokens, picture_size=64)
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("silent") / "model"
    save_model(Model(config), folder)
    return folder


@pytest.fixture(scope="module")
def photo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A vase, left of the middle of a white page."""
    x, y = places(200)
    mask = (np.abs(y) < 0.6) & (np.abs(x + 0.2) < 0.25 + 0.15 * np.sin(5 * y))
    color = np.where(mask[..., None], np.array([30, 90, 170]), 255).astype(np.uint8)
    path = tmp_path_factory.mktemp("photos") / "vase.png"
    write_png(path, color)
    return path


def test_the_views_of_a_silent_model_are_the_draft(silent_model: Path, photo: Path) -> None:
    path = run(Config(model=str(silent_model), dtype="fp32"), [photo]).path
    made = read_views(path)
    assert tuple(view.camera.name for view in made.frames) == HORIZONTAL
    framed = read_image(path / "input.png")
    assert framed.shape == (64, 64, 4)
    assert np.array_equal(made.frames[0].color, framed)
    draft = draft_views(framed, [view.camera for view in made.frames])
    for view, guess in zip(made.frames, draft.frames, strict=True):
        assert view.depth is not None
        assert guess.depth is not None
        assert view.normal is not None
        assert iou(view.depth > 0, guess.depth > 0) > 0.93, view.camera.name
        both = (view.depth > 0) & (guess.depth > 0)
        assert np.abs(view.depth - guess.depth)[both].mean() < 0.03, view.camera.name
    assert [view.source for view in made.frames] == ["photo"] + 7 * ["generated"]
    weights = [view.weight for view in made.frames]
    assert weights[0] == PHOTO_WEIGHT
    assert all(LEAST_WEIGHT <= weight <= 1 for weight in weights[1:])
    mask = read_image(path / "mask.png")[..., 0] > 127
    assert iou(mask, read_photo(photo)[..., 0] < 200) > 0.97
    assert (path / "sheet.png").is_file()


def test_a_model_taught_front_and_back_has_the_others_between_them(silent_model: Path, photo: Path, tmp_path) -> None:
    """The draft's front and back are half circles, so what lies between them is the draft again."""
    model = load_model(silent_model)
    model.config = replace(model.config, views=("front", "back"))
    save_model(model, tmp_path / "taught")
    names = ("right", "front_left", "back", "top")
    made = read_views(run(Config(model=str(tmp_path / "taught"), views=names, dtype="fp32"), [photo]).path)
    assert tuple(view.camera.name for view in made.frames) == ("front", *names)
    front = made.frames[0]
    assert front.color is not None
    draft = draft_views(front.color, [view.camera for view in made.frames])
    for view, guess in zip(made.frames, draft.frames, strict=True):
        assert view.depth is not None
        assert guess.depth is not None
        assert view.normal is not None
        assert iou(view.depth > 0, guess.depth > 0) > 0.88, view.camera.name
        assert view.source == ("photo" if view is front else "generated")
    back = made.frames[3].color
    assert back is not None
    assert np.array_equal(back[..., 3], front.color[:, ::-1, 3])


def test_the_front_comes_first_and_alone_with_depth_only(silent_model: Path, photo: Path) -> None:
    model = str(silent_model)
    both = run(Config(model=model, views=("back",)), [photo])
    assert [view.camera.name for view in read_views(both.path).frames] == ["front", "back"]
    assert run(Config(model=model, views=("back", "front")), [photo]).key == both.key
    alone = run(Config(model=model, depth_only=True), [photo])
    assert [view.camera.name for view in read_views(alone.path).frames] == ["front"]
    assert run(Config(model=model, views=("front",), device="cpu"), [photo]).key == alone.key
    assert run(Config(model=model, depth_only=True), [photo.read_bytes()]).key == alone.key


def test_fills(silent_model: Path, photo: Path) -> None:
    config = Config(model=str(silent_model), depth_only=True)
    small, kept = (run(replace(config, fill=fill), [photo]).path for fill in ("0.5", "keep"))
    rows, columns = np.nonzero(read_image(small / "input.png")[..., 3] >= 128)
    assert rows.max() - rows.min() == pytest.approx(31, abs=1)
    rows, columns = np.nonzero(read_image(kept / "input.png")[..., 3] >= 128)
    assert (rows.min(), rows.max()) == (pytest.approx(13, abs=1), pytest.approx(51, abs=1))
    assert columns.mean() < 31


@pytest.mark.parametrize("fill", ["0.1", "1.2", "nan", "", "much", "inf"])
def test_fills_that_are_none(fill: str) -> None:
    with pytest.raises(UsageError, match="--fill"):
        fill_of(fill)


def test_a_model_that_sees_nothing_has_failed(little: Path, smallest: ModelConfig, photo: Path, tmp_path: Path) -> None:
    with torch.no_grad():
        model = Model(replace(smallest, noise=NoiseSettings(prediction="sample")))
        torch.nn.init.zeros_(model.network.unet.conv_out.weight)
        torch.nn.init.constant_(model.network.unet.conv_out.bias, 1.0)
    save_model(model, tmp_path / "blind")
    with pytest.raises(WorkFailed, match="no object"):
        run(Config(model=str(tmp_path / "blind")), [photo])


def test_a_photo_cut_by_its_frame_is_told_of(silent_model: Path, tmp_path: Path) -> None:
    heard: list[Progress | Warned] = []
    picture = np.full((100, 100, 3), 255, np.uint8)
    picture[40:, 30:70] = (30, 90, 170)
    write_png(tmp_path / "cut.png", picture)
    run(Config(model=str(silent_model), depth_only=True), [tmp_path / "cut.png"], heard.append)
    assert any(isinstance(event, Warned) and "border" in event.text for event in heard)


@pytest.mark.parametrize("model", ["nowhere", "/nowhere/at/all", "./some/thing", ""])
def test_models_that_are_not_there(model: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(MissingInput):
        found(model)


def test_what_cannot_be_asked(silent_model: Path, photo: Path, tmp_path: Path) -> None:
    config = Config(model=str(silent_model))
    with pytest.raises(UsageError, match="one photo"):
        run(config, [photo, photo])
    with pytest.raises(BadCameras, match="lft"):
        run(replace(config, views=("lft",)), [photo])
    with pytest.raises(UsageError, match="--views"):
        run(replace(config, views=()), [photo])
    with pytest.raises(BadImage, match="picture"):
        run(config, [b"no picture"])
    with pytest.raises(UsageError, match="--guidance"):
        run(replace(config, guidance=0.5), [photo])


def test_precision_is_as_asked_and_otherwise_what_the_device_is_quick_with() -> None:
    cpu, gpu = torch.device("cpu"), torch.device("cuda")
    assert is_half("bf16", cpu)
    assert not is_half("fp32", gpu)
    assert is_half("auto", cpu) == torch.cpu._is_amx_tile_supported()
    assert not is_half("auto", torch.device("mps"))
