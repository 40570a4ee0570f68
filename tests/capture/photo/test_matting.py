"""Cut-outs against shapes drawn on known backgrounds, and against masks that people made of real photos."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from mv3d_cli.capture.photo import INSIDE, areas_apart, cut_out, is_cut_by_frame
from mv3d_cli.capture.photo.matting import alpha_of, bars, matted
from mv3d_cli.errors import BadImage
from mv3d_cli.formats.images import read_photo
from mv3d_cli.metrics.overlap import iou

SIDE = 300
LEAST = {
    "banana": 0.9,
    "bird_sparrow": 0.7,
    "colorful_teapot": 0.94,
    "fish_real_nemo": 0.92,
    "metal_dragon_statue": 0.92,
    "teddy_bear": 0.9,
}


def places(side: int = SIDE) -> tuple[np.ndarray, np.ndarray]:
    """(x, y) from -1 to 1 at the pixels' centres, y downwards."""
    centres = (np.arange(side) + 0.5) / side * 2 - 1
    return np.meshgrid(centres, centres)


def opaque(color: np.ndarray) -> np.ndarray:
    return np.dstack([color.clip(0, 255).astype(np.uint8), np.full(color.shape[:2], 255, np.uint8)])


def disc(x: float = 0.0, y: float = 0.0, radius: float = 0.5, side: int = SIDE) -> np.ndarray:
    across, down = places(side)
    return np.hypot(across - x, down - y) < radius


def drawn(mask: np.ndarray, ground: np.ndarray, color=(180, 60, 40), blur: float = 0.7) -> np.ndarray:
    """The mask in a colour before a ground, softened as lenses do."""
    mixed = gaussian_filter(mask.astype(np.float64), blur)[..., None]
    return opaque(np.array(color) * mixed + ground * (1 - mixed))


def ground(kind: str) -> np.ndarray:
    x, y = places()
    rng = np.random.default_rng(0)
    even = np.full((SIDE, SIDE, 3), 255.0)
    match kind:
        case "white":
            return even
        case "black":
            return even * 0
        case "light":  # falls off to one corner
            return even * (0.85 + 0.12 * x - 0.1 * y * y)[..., None] * [1, 0.95, 0.9]
        case "grain":
            return even * 0.7 + rng.normal(scale=6, size=even.shape)
        case _:  # lies in the dark on the table, with a soft shadow below
            return even * (0.8 - 0.25 * np.exp(-((x / 0.5) ** 2 + ((y - 0.6) / 0.1) ** 2)))[..., None]


@pytest.mark.parametrize("kind", ["white", "black", "light", "grain", "shadow"])
def test_a_disc_before_a_plain_background(kind: str) -> None:
    mask = disc()
    alpha = alpha_of(drawn(mask, ground(kind)))
    assert iou(alpha >= INSIDE, mask) > 0.97


def test_what_shows_the_background_is_a_hole_and_what_does_not_is_none() -> None:
    ring = disc() & ~disc(0.2, 0, 0.15)
    photo = drawn(ring, ground("light"))
    inlay = disc(-0.25, 0, 0.12)
    photo[inlay, :3] = (30, 30, 200)
    assert iou(alpha_of(photo) >= INSIDE, ring) > 0.97


def test_specks_are_left_out_and_legs_are_not() -> None:
    x, y = places()
    mask = (np.abs(x) < 0.5) & (np.abs(y + 0.2) < 0.2) | (np.abs(np.abs(x) - 0.4) < 0.03) & (np.abs(y - 0.3) < 0.4)
    speck = disc(0.8, 0.8, 0.03)
    found = alpha_of(drawn(mask | speck, ground("white"))) >= INSIDE
    assert not found[speck].any()
    assert iou(found, mask) > 0.95


def test_edges_are_soft_where_the_photo_is() -> None:
    mask = disc(side=1000)
    photo = drawn(mask, np.full((1000, 1000, 3), 240.0), blur=2.0)
    alpha = alpha_of(photo)
    true = 255 * gaussian_filter(mask.astype(float), 2.0)
    assert np.abs(alpha - true).mean() < 1.0
    soft = (true > 40) & (true < 215)
    assert np.abs(alpha - true)[soft].mean() < 40


def test_bars_around_a_picture_are_no_background() -> None:
    photo = drawn(disc(), ground("light"))[40:-40]
    framed = np.zeros((SIDE, SIDE, 4), np.uint8)
    framed[..., 3] = 255
    framed[40:-40] = photo
    top, bottom, left, right = bars(framed[..., :3])
    assert (left, right) == (0, SIDE)
    assert (top, SIDE - bottom) == (42, 42)
    assert iou(alpha_of(framed) >= INSIDE, disc()) > 0.97
    assert bars(drawn(disc(), ground("white"))[..., :3]) == (0, SIDE, 0, SIDE)


def test_alpha_is_kept_where_it_is_used() -> None:
    photo = drawn(disc(), ground("white"))
    photo[..., 3] = 255 * disc(0.3, 0.3, 0.2) // 2 * 2
    assert np.array_equal(alpha_of(photo), photo[..., 3])
    assert np.array_equal(cut_out(photo), photo[..., 3])


def test_alpha_that_is_opaque_but_for_rounded_corners_is_none() -> None:
    photo = drawn(disc(), ground("white"))
    photo[:9, :9, 3] = 0
    assert iou(alpha_of(photo) >= INSIDE, disc()) > 0.97


@pytest.mark.parametrize("value", [0, 128, 255])
def test_nothing_is_found_in_nothing(value: int) -> None:
    assert not matted(np.full((64, 80, 3), value, np.uint8)).any()


@pytest.mark.parametrize("name", LEAST)
def test_photos_that_people_cut_out(shared: Path, name: str) -> None:
    folder = shared / "photos" / "matting"
    if not folder.is_dir():
        pytest.skip("there are no photos with masks in the shared data")
    true = read_photo(folder / f"{name}_mask.png")[..., 0] >= INSIDE
    assert iou(alpha_of(read_photo(folder / f"{name}.png")) >= INSIDE, true) > LEAST[name]


@pytest.mark.parametrize(
    ("photo", "problem", "advice"),
    [
        (np.full((1, 1, 4), 255, np.uint8), "1x1", "16 pixels"),
        (np.full((15, 400, 4), 255, np.uint8), "400x15", "16 pixels"),
        (np.zeros((64, 64, 4), np.uint8), "transparent everywhere", "opaque"),
        (opaque(np.zeros((64, 64, 3))), "nothing in the photo stands out", "plain background"),
        (drawn(disc(-0.5, 0, 0.3) | disc(0.5, 0, 0.3), ground("white")), "two objects", "Crop"),
    ],
    ids=["one pixel", "a strip", "transparent", "black", "two objects"],
)
def test_photos_that_are_refused(photo: np.ndarray, problem: str, advice: str) -> None:
    with pytest.raises(BadImage, match=problem) as refusal:
        cut_out(photo)
    assert advice in refusal.value.hint


def test_accessories_and_parts_with_a_thin_gap_are_no_second_object() -> None:
    near = disc(-0.31, 0, 0.3) | disc(0.31, 0, 0.3)
    assert len(areas_apart(near)) == 1
    assert len(areas_apart(disc(-0.4, 0, 0.3) | disc(0.4, 0, 0.3))) == 2
    both = disc(-0.3, 0, 0.4) | disc(0.5, 0, 0.2)
    assert iou(cut_out(drawn(both, ground("white"))) >= INSIDE, both) > 0.97


def test_the_frame_cuts_what_reaches_over_it() -> None:
    def alpha(mask: np.ndarray) -> np.ndarray:
        return np.where(mask, 255, 0).astype(np.uint8)

    assert not is_cut_by_frame(alpha(disc()))
    assert not is_cut_by_frame(alpha(disc(0.4, 0, 0.595)))
    for x, y in ((0.6, 0), (-0.6, 0), (0, 0.6), (0, -0.6)):
        assert is_cut_by_frame(alpha(disc(x, y)))
    x, _ = places()
    assert is_cut_by_frame(cut_out(drawn(disc(0, 0.6) & (x < 9), ground("light"))))
