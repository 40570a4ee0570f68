"""Alignment of exact views that were moved, dented and tinted in a way that is known.

The oracle is the shape itself: once aligned, every view's pixels lie nearer to its surface than before.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from mv3d_cli.fields.alignment import align
from mv3d_cli.fields.alignment.warps import Warp, still
from mv3d_cli.fields.relief import Relief, relief_of
from mv3d_cli.scene.camera import Camera, Perspective, pixel_from_camera
from mv3d_cli.scene.conventions import RIG_RADIUS
from mv3d_cli.scene.views import View

SIZE = 128
MOVED = 1.0  # pixels
SCALES, SHIFTS = (0.0, 0.012, -0.01, 0.008, -0.012, 0.01), (0.0, -0.012, 0.01, 0.012, -0.008, 0.009)
GAINS = np.array([1.0, 1.06, 0.95, 1.08, 0.94, 1.03])


def spoiled(view: View, index: int) -> View:
    """The view as a generator might have made it; view 0 is a photo, and only its depth is wrong."""
    assert view.color is not None
    assert view.depth is not None
    rng = np.random.default_rng(index)
    y, x = np.indices(view.shape)
    waves = [np.sin(2 * np.pi * (np.cos(t) * x + np.sin(t) * y) / 110 + p) for t, p in rng.uniform(0, 6, (2, 2))]
    place = [y - (MOVED * waves[0] if index else 0), x - (MOVED * waves[1] if index else 0)]
    channels = [map_coordinates(channel, place, order=1, mode="nearest") for channel in np.moveaxis(view.color, 2, 0)]
    color = np.stack(channels, axis=-1).astype(np.float64)
    color[..., :3] *= GAINS[index]
    inside = map_coordinates((view.depth > 0).astype(float), place, order=1) > 0.99
    depth = map_coordinates(view.depth, place, order=1)
    depth = RIG_RADIUS + (1 + SCALES[index]) * (depth - RIG_RADIUS) + SHIFTS[index] + 0.006 * waves[0] * waves[1]
    return replace(
        view,
        color=np.round(color.clip(0, 255)).astype(np.uint8),
        depth=np.where(inside, depth, 0).astype(np.float32),
        source="generated" if index else "photo",
    )


@pytest.fixture(scope="module")
def cameras(ring) -> tuple[Camera, ...]:
    """Six cameras of the ring."""
    return tuple(ring[i] for i in (0, 1, 3, 4, 5, 7))


@pytest.fixture(scope="module")
def reliefs(ellipsoid, cameras) -> list[Relief]:
    return [relief_of(spoiled(ellipsoid.view(camera, SIZE), index)) for index, camera in enumerate(cameras)]


def distance_of(shape, relief: Relief, warp: Warp) -> float:
    """Median distance of a view's warped pixels from the shape."""
    assert relief.depth is not None
    rows, columns = np.nonzero(relief.smooth)
    grid = warp.offsets.shape[0]
    place = [(rows + 0.5) / SIZE * (grid - 1), (columns + 0.5) / SIZE * (grid - 1)]
    dx, dy, dz = (map_coordinates(warp.offsets[..., axis], place, order=1, mode="nearest") for axis in range(3))
    depth = relief.depth[rows, columns]
    depth = depth + (depth - RIG_RADIUS) * warp.scale + warp.shift + dz
    (sx, ox), (sy, oy) = pixel_from_camera(relief.camera, SIZE, SIZE)
    ray = np.stack([(columns + 0.5 + dx - ox) / sx, (rows + 0.5 + dy - oy) / sy], axis=-1)
    if isinstance(relief.camera.projection, Perspective):
        ray = ray * depth[:, None]
    pose = relief.camera.world_from_camera
    return float(np.median(np.abs(shape.distance(np.column_stack([ray, depth]) @ pose[:3, :3].T + pose[:3, 3]))))


def test_views_come_to_agree_and_onto_the_shape(ellipsoid, reliefs) -> None:
    held = [True, *[False] * 5]
    alignment = align(reliefs, held)
    before = [distance_of(ellipsoid, relief, still()) for relief in reliefs]
    after = [distance_of(ellipsoid, relief, warp) for relief, warp in zip(reliefs, alignment.warps, strict=True)]
    assert alignment.after < 0.1 * alignment.before
    assert np.mean(after) < 0.5 * np.mean(before)
    gains = np.array([warp.gain for warp in alignment.warps])
    assert np.allclose(gains / gains.mean(), GAINS / GAINS.mean(), rtol=0.02)
    assert not alignment.warps[0].offsets[..., :2].any()
    assert alignment.warps[0].offsets[..., 2].any()
    assert all(np.abs(warp.offsets[..., :2]).max() > 0.2 for warp in alignment.warps[1:])


def test_views_that_agree_are_left_exactly_as_they_are(ellipsoid, cameras) -> None:
    alignment = align([relief_of(ellipsoid.view(camera, SIZE)) for camera in cameras], [False] * 6)
    assert alignment.before == alignment.after < 1e-3
    for warp in alignment.warps:
        assert not warp.offsets.any()
        assert (warp.scale, warp.shift, warp.gain) == (0, 0, 1)


def test_views_without_depth_stay_and_do_not_hinder(reliefs) -> None:
    flat = replace(reliefs[2], depth=None, slope=None, smooth=np.zeros_like(reliefs[2].smooth))
    alignment = align([*reliefs[:2], flat, *reliefs[3:]], [False] * 6)
    assert not alignment.warps[2].offsets.any()
    assert (alignment.warps[2].scale, alignment.warps[2].shift) == (0, 0)
    assert alignment.warps[2].gain == pytest.approx(1, abs=1e-3)
    assert alignment.after < 0.2 * alignment.before
    assert all(warp.offsets.any() for i, warp in enumerate(alignment.warps) if i != 2)


def test_one_view_or_none_with_depth_has_nothing_to_agree_with(reliefs) -> None:
    flat = replace(reliefs[1], depth=None, slope=None, smooth=np.zeros_like(reliefs[1].smooth))
    for pair in ([reliefs[0], flat], [flat, flat], [reliefs[0]]):
        alignment = align(pair, [False] * len(pair))
        assert np.isnan(alignment.before)
        assert np.isnan(alignment.after)
        assert not any(warp.offsets.any() for warp in alignment.warps)


def test_exact_views_without_a_surface_in_common_hardly_move(sphere, cameras) -> None:
    turned = cameras[0].world_from_camera @ np.array([[-1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 4], [0, 0, 0, 1]])
    pair = [cameras[0], replace(cameras[0], name="behind", world_from_camera=turned)]
    alignment = align([relief_of(sphere.view(camera, SIZE)) for camera in pair], [False] * 2)
    assert np.isnan(alignment.before)
    for warp in alignment.warps:  # their outlines still hold them together
        assert np.abs(warp.offsets[..., :2]).max() < 0.02
        assert max(np.abs(warp.offsets[..., 2]).max(), abs(warp.scale), abs(warp.shift)) < 1e-3
        assert warp.gain == 1


def test_the_same_warps_each_time(reliefs) -> None:
    first, second = (align(reliefs[:3], [True, False, False]) for _ in range(2))
    assert first.after == second.after
    for a, b in zip(first.warps, second.warps, strict=True):
        assert a.offsets.tobytes() == b.offsets.tobytes()
        assert (a.scale, a.shift, a.gain) == (b.scale, b.shift, b.gain)
