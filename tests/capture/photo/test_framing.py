"""Frames against shapes whose place and size are known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mv3d_cli.capture.photo.framing import INSIDE, OPAQUE, decontaminated, framed, reduced

RED = (200, 40, 30)


def cut(height: int, width: int, box: tuple[int, int, int, int], behind=(0, 0, 0)) -> np.ndarray:
    """A red box, rows [top, bottom) and columns [left, right), in a transparent picture."""
    top, bottom, left, right = box
    picture = np.zeros((height, width, 4), np.uint8)
    picture[..., :3] = behind
    picture[top:bottom, left:right] = (*RED, 255)
    return picture


def extent(frame: np.ndarray) -> tuple[float, float, float, float]:
    """The (top, bottom, left, right) of what a frame holds, to a fraction of a pixel, by its alpha's sums."""
    alpha = frame[..., 3] / 255
    rows, columns = alpha.max(axis=1), alpha.max(axis=0)
    (inner,) = np.nonzero(rows > 0)
    (across,) = np.nonzero(columns > 0)
    top, bottom, left, right = inner[0], inner[-1], across[0], across[-1]
    return top + 1 - rows[top], bottom + rows[bottom], left + 1 - columns[left], right + columns[right]


@settings(deadline=None, max_examples=25)
@given(
    height=st.integers(20, 700),
    width=st.integers(20, 700),
    fill=st.floats(0.2, 1),
    seed=st.integers(0, 99),
)
def test_the_longest_side_fills_its_share_and_the_middle_is_in_the_middle(height, width, fill, seed) -> None:
    rng = np.random.default_rng(seed)
    (top, bottom), (left, right) = (np.sort(rng.choice(length + 1, 2, replace=False)) for length in (height, width))
    side = 64
    frame = framed(cut(height, width, (top, bottom, left, right)), side, fill)
    assert frame.shape == (side, side, 4)
    scale = side * fill / max(bottom - top, right - left)
    expected = [side / 2 + sign * scale * length / 2 for length in (bottom - top, right - left) for sign in (-1, 1)]
    slack = 0.6 + scale  # a pixel of the photo, where it is enlarged, fades out over its own width
    inside = frame[..., 3] > 0
    covered = (frame[..., 3] / 255).sum()
    assert inside.any()
    assert covered == pytest.approx(scale**2 * (bottom - top) * (right - left), rel=0.05, abs=2 + 8 * scale**2)
    (rows,), (columns,) = np.nonzero(inside.any(axis=1)), np.nonzero(inside.any(axis=0))
    found = [rows[0], rows[-1] + 1, columns[0], columns[-1] + 1]
    np.testing.assert_allclose(found, np.clip(expected, 0, side), atol=slack + 1.5)


@pytest.mark.parametrize("factor", [1, 2, 7, 40])
def test_sizes_agree_to_a_fraction_of_a_pixel(factor: int) -> None:
    box = [factor * value for value in (20, 84, 30, 62)]
    frame = framed(cut(100 * factor, 120 * factor, tuple(box)), 128, 0.5)
    np.testing.assert_allclose(extent(frame), [32, 96, 48, 80], atol=0.6)


def test_keep_fits_the_whole_picture() -> None:
    frame = framed(cut(100, 200, (0, 50, 0, 100)), 64, None)
    np.testing.assert_allclose(extent(frame), [16, 32, 0, 32], atol=0.3)
    frame = framed(cut(200, 100, (0, 200, 0, 100)), 64, None)
    np.testing.assert_allclose(extent(frame), [0, 64, 16, 48], atol=0.3)


def test_fine_stripes_become_their_mean() -> None:
    picture = cut(1000, 1000, (0, 1000, 0, 1000))
    picture[:, ::2, :3] = 0
    picture[:, 1::2, :3] = 200
    inner = framed(picture, 64, 1.0)[4:-4, 4:-4, :3]
    assert np.abs(inner.astype(int) - 100).max() <= 5


def test_the_colour_behind_does_not_show() -> None:
    for behind in ((0, 255, 0), (255, 255, 255)):
        frame = framed(cut(333, 333, (51, 290, 77, 200), behind), 60, 0.7)
        seen = frame[frame[..., 3] > 0]
        assert np.abs(seen[:, :3].astype(int) - RED).max() <= 1


def test_mixed_edges_take_the_colour_inside() -> None:
    picture = cut(20, 20, (5, 15, 5, 15))
    picture[5:15, 14] = (0, 255, 0, 100)  # the background's green, half covered
    clean = decontaminated(picture)
    assert (clean[5:15, 5:15, :3] == RED).all()
    assert np.array_equal(clean[..., 3], picture[..., 3])
    assert not clean[clean[..., 3] == 0].any()


def test_a_ghost_keeps_its_colours() -> None:
    picture = cut(20, 20, (5, 15, 5, 15))
    picture[..., 3] = np.minimum(picture[..., 3], 200)
    assert picture[..., 3].max() < OPAQUE
    assert np.array_equal(decontaminated(picture), picture)


def test_blocks_are_means_and_beyond_the_picture_is_nothing() -> None:
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 256, (13, 10, 4), dtype=np.uint8)
    small = reduced(picture, 4)
    assert small.shape == (4, 3, 4)
    alpha = picture[..., 3:] / 255
    spread = np.pad(np.dstack([picture[..., :3] / 255 * alpha, alpha]), ((0, 3), (0, 2), (0, 0)))
    np.testing.assert_allclose(small, spread.reshape(4, 4, 3, 4, 4).mean(axis=(1, 3)), atol=1e-5)


def test_an_empty_cut_out_is_refused() -> None:
    with pytest.raises(ValueError, match="empty"):
        framed(np.full((30, 30, 4), INSIDE - 1, np.uint8), 16, 0.7)
