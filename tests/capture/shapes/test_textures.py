"""Patterns tile without a seam; prints show what they say, the right way up."""

import cv2
import numpy as np
import pytest

from mv3d_cli.capture.shapes import prints, textures
from mv3d_cli.capture.shapes.drawing import disc, printed, sheet, write
from mv3d_cli.capture.shapes.draws import count, fractal, noise, pick

WHITE, BLACK = np.ones(3), np.zeros(3)


def pixels_of(paint: textures.Paint) -> np.ndarray:
    assert paint.material.texture is not None
    return paint.material.texture.pixels


def seam_and_inside(field: np.ndarray, axis: int) -> tuple[float, float]:
    """The mean step across the border, and the largest mean step between neighbouring lines inside."""
    steps = np.abs(np.diff(field, axis=axis)).mean(axis=1 - axis)
    across = np.abs(np.take(field, 0, axis) - np.take(field, -1, axis)).mean()
    return float(across), float(steps.max())


@pytest.mark.parametrize("pattern", textures.PATTERNS, ids=lambda pattern: pattern.__name__)
def test_patterns_vary_stay_in_range_and_tile(pattern):
    for seed in range(4):
        field = pattern(np.random.default_rng(seed))
        field = np.broadcast_to(field, (max(field.shape),) * 2)
        assert field.min() >= 0
        assert field.max() <= 1
        assert np.ptp(field) > 0.2
        for axis in (0, 1):
            across, inside = seam_and_inside(field, axis)
            assert across <= 1.5 * inside + 0.02
        np.testing.assert_array_equal(pattern(np.random.default_rng(seed)), pattern(np.random.default_rng(seed)))


def test_noise_is_smooth_periodic_and_of_about_unit_variance():
    field = noise(np.random.default_rng(0), 12, 12)
    assert 0.5 < field.std() < 1.5
    assert np.abs(field[:, 0] - field[:, -1]).max() < 0.6
    assert 0.05 < fractal(np.random.default_rng(1), 4).std() < 0.35


def test_a_ramp_interpolates_its_colours():
    picture = textures.ramp(np.array([[0.0, 1.0], [0.5, 0.25]]), [BLACK, WHITE])
    assert picture[0, 0].tolist() == [0, 0, 0, 255]
    assert picture[0, 1].tolist() == [255, 255, 255, 255]
    assert abs(int(picture[1, 0, 0]) - 127) <= 1


def test_palettes_hold_something_light_and_something_dark():
    for seed in range(50):
        palette = textures.draw_palette(np.random.default_rng(seed))
        assert all(((colour >= 0) & (colour <= 1)).all() for colour in palette)
        assert palette.light.mean() > palette.dark.mean() + 0.4


def test_circles_have_their_area_whatever_the_aspect():
    for aspect in (0.5, 1.0, 3.0):
        page = sheet(WHITE, aspect)
        disc(page, 0.05, 0, (0.2, 0.2), BLACK)
        covered = (1 - page.pixels[..., 0]).mean() * aspect
        assert covered == pytest.approx(np.pi * 0.04, rel=0.02)


def test_letters_read_from_left_to_right_and_from_top_to_bottom():
    page = sheet(WHITE, 1.0)
    write(page, "L", 0, 0, (0.6, 0.8), BLACK)
    rows, columns = np.nonzero(pixels_of(printed(page))[..., 0] == 0)
    assert rows.mean() > 128  # the foot is below
    assert columns.mean() < 128  # the stem is on the left
    wide = sheet(WHITE, 1.0)
    write(wide, "LI", 0, 0, (0.6, 0.8), BLACK)
    assert (wide.pixels[:, :100] == 0).any()


@pytest.mark.parametrize("seed", range(3))
def test_prints_fill_their_sheet_with_several_colours(seed):
    rng = np.random.default_rng(seed)
    palette = textures.draw_palette(rng)
    ways = [
        prints.label(rng, palette, 3.0),
        prints.label(rng, palette, 0.7, around=False),
        prints.face(rng, palette, 2.0),
        prints.cover(rng, palette, 0.7),
        prints.dial(rng, palette),
        prints.facade(rng, palette, 1.4),
        prints.screen(rng, palette, 1.6),
        prints.eyeball(rng, palette.accent),
        prints.pips(5, palette.main, palette.light),
    ]
    for paint in ways:
        pixels = pixels_of(paint)
        assert pixels.dtype == np.uint8
        assert max(pixels.shape[:2]) <= 512
        assert (pixels[..., 3] == 255).all()
        assert len(np.unique(pixels.reshape(-1, 4), axis=0)) > 3
        assert paint.tile is None


def test_a_die_shows_as_many_pips_as_it_says():
    for number in range(1, 7):
        dark = (pixels_of(prints.pips(number, WHITE, BLACK))[..., 0] < 128).astype(np.uint8)
        assert cv2.connectedComponents(dark)[0] - 1 == number


def test_draws_follow_their_weights():
    rng = np.random.default_rng(0)
    drawn = [pick(rng, "abc", [1, 0, 3]) for _ in range(2000)]
    assert "b" not in drawn
    assert drawn.count("c") / 2000 == pytest.approx(0.75, abs=0.04)
    assert {count(rng, 2, 4) for _ in range(100)} == {2, 3, 4}
