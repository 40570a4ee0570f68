"""Warps against what they say: pixels that move by so much end up there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mv3d_cli.fields.alignment.warps import GRID, Warp, basis_of, came_from, offsets_over, still, warped
from mv3d_cli.fields.relief import relief_of
from mv3d_cli.scene.conventions import RIG_RADIUS

SHAPE = (40, 64)


def smooth_warp(seed: int = 0, pixels: float = 1.0, depth: float = 0.02) -> Warp:
    """Offsets that change slowly over the picture."""
    rng = np.random.default_rng(seed)
    v, u = np.meshgrid(*[np.linspace(0, 1, GRID)] * 2, indexing="ij")
    waves = [np.sin(2.5 * (np.cos(t) * u + np.sin(t) * v) + p) for t, p in rng.uniform(0, 6, (3, 2))]
    return Warp(np.stack(waves, axis=-1) * [pixels, pixels, depth], scale=0.03, shift=-0.01, gain=1.1)


def pixel_centres() -> np.ndarray:
    y, x = np.indices(SHAPE) + 0.5
    return np.stack([x, y], axis=-1).reshape(-1, 2)


def test_shares_sum_to_one_and_reproduce_linear_functions() -> None:
    at = np.random.default_rng(0).uniform(0, 1, (200, 2)) * SHAPE[::-1]
    basis = basis_of(at, SHAPE, GRID)
    rows, columns = np.divmod(np.arange(GRID**2), GRID)
    assert np.allclose(basis.sum(1), 1, atol=1e-6)
    assert ((basis > 0).sum(1) <= 4).all()
    assert np.allclose(basis @ columns / (GRID - 1) * SHAPE[1], at[:, 0], atol=0.02)
    assert np.allclose(basis @ rows / (GRID - 1) * SHAPE[0], at[:, 1], atol=0.02)


def test_offsets_over_the_picture_are_those_of_the_basis() -> None:
    warp = smooth_warp()
    single = basis_of(pixel_centres(), SHAPE, GRID) @ warp.offsets.reshape(-1, 3)
    # OpenCV looks up between pixels in steps of a 32nd
    assert (
        np.abs(offsets_over(warp, SHAPE).reshape(-1, 3) - single).max()
        < np.abs(np.diff(warp.offsets, axis=1)).max() / 32
    )


def test_came_from_undoes_the_move() -> None:
    warp, at = smooth_warp(), pixel_centres()
    moved = at + basis_of(at, SHAPE, GRID) @ warp.offsets[..., :2].reshape(-1, 2)
    inner = (np.abs(moved / SHAPE[::-1] - 0.5) < 0.45).all(1)
    assert np.abs(moved - at)[inner].max() > 0.5
    assert np.abs(came_from(warp, moved, SHAPE) - at)[inner].max() < 0.15


def test_what_stands_still_stays(ellipsoid, ring) -> None:
    relief = relief_of(ellipsoid.view(ring[0], 64))
    after = warped(relief, still())
    for name in ("depth", "slope", "smooth", "outline", "color"):
        assert np.allclose(getattr(after, name), getattr(relief, name), atol=1e-6), name


def test_pictures_move_and_depth_changes_as_told(ellipsoid, ring) -> None:
    relief = relief_of(ellipsoid.view(ring[0], 64))
    offsets = np.tile([3.0, -2.0, 0.02], (GRID, GRID, 1))
    after = warped(relief, Warp(offsets, scale=0.05, shift=-0.01, gain=1.25))

    def moved(picture: np.ndarray) -> np.ndarray:
        return np.roll(picture, (-2, 3), (0, 1))[2:-2, 3:-3]

    inner = (slice(2, -2), slice(3, -3))
    depth = moved(relief.depth)
    assert np.allclose(after.depth[inner], depth + (depth - RIG_RADIUS) * 0.05 - 0.01 + 0.02, atol=1e-5)
    assert np.allclose(after.outline[inner], moved(relief.outline), atol=1e-4)
    assert np.allclose(after.color[inner], moved(relief.color) / 1.25, atol=1e-5)
    assert np.array_equal(after.smooth[inner], moved(relief.smooth))


def test_what_a_view_does_not_know_stays_unknown(ellipsoid, ring) -> None:
    view = ellipsoid.view(ring[0], 32)
    plain = warped(relief_of(replace(view, depth=None)), smooth_warp())
    assert plain.depth is None
    assert plain.slope is None
    assert not plain.smooth.any()
    assert warped(relief_of(replace(view, color=None)), smooth_warp()).color is None
