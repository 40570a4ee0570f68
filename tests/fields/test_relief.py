"""Reliefs of a sphere against its equation, outlines against circles, steps and gaps against what was drawn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from mv3d_cli.fields.relief import known, lookup, mask_of, outline_of, relief_of, reliefs_of
from mv3d_cli.scene.camera import Camera, Orthographic, look_at_origin
from mv3d_cli.scene.views import View, Views

SIZE = 128
FRONT = look_at_origin("front", (0.0, -2.0, 0.0), Orthographic())


def centres(size: int = SIZE) -> tuple[np.ndarray, np.ndarray]:
    y, x = np.indices((size, size)) + 0.5
    return x, y


def slopes_by_differences(shape, camera: Camera, step: float = 1e-4) -> np.ndarray:
    x, y = centres()
    right = shape.depth(camera, x + step, y, SIZE) - shape.depth(camera, x - step, y, SIZE)
    down = shape.depth(camera, x, y + step, SIZE) - shape.depth(camera, x, y - step, SIZE)
    return np.stack([right, down], axis=-1) / (2 * step)


def facing(shape, camera: Camera, size: int = SIZE) -> np.ndarray:
    """Where the surface is well seen: its silhouette shrunk."""
    return np.isfinite(replace(shape, radii=tuple(0.85 * r for r in shape.radii)).depth(camera, *centres(size), size))


@pytest.mark.parametrize("source", ["rendered", "generated"])
def test_a_sphere_has_its_depth_and_slopes(sphere, ring, source: str) -> None:
    relief = relief_of(sphere.view(ring[1], SIZE, source))
    where = facing(sphere, ring[1])
    true = sphere.depth(ring[1], *centres(), SIZE)
    # a window of 1.5 pixels flattens a curved surface: by 0.3 pixels' widths at most, here
    off = np.abs(relief.depth - true)[where]
    assert off.max() < (1e-6 if source == "rendered" else 0.3 / SIZE * 2)
    assert np.median(off) < (1e-6 if source == "rendered" else 0.12 / SIZE * 2)
    off = np.abs(relief.slope - slopes_by_differences(sphere, ring[1]))[where] * SIZE / 2
    assert np.median(off) < 0.005  # scene units deep per scene unit across
    assert off.max() < 0.06
    assert relief.smooth[where].all()


def test_noise_is_smoothed_unless_depth_was_rendered(sphere, ring) -> None:
    where, true = facing(sphere, ring[0]), sphere.depth(ring[0], *centres(), SIZE)
    noise = np.random.default_rng(0).normal(0, 0.005, true.shape).astype(np.float32)
    noisy = replace(sphere.view(ring[0], SIZE, "generated"), depth=np.nan_to_num(true + noise).astype(np.float32))
    assert (relief_of(noisy).depth - true)[where].std() < 0.4 * noise[where].std()
    kept = relief_of(replace(noisy, source="rendered"))
    assert np.array_equal(kept.depth[where], noisy.depth[where])


@pytest.mark.parametrize("source", ["rendered", "generated"])
def test_beside_a_step_depth_is_sharp_and_not_smooth(source: str) -> None:
    depth = np.full((32, 48), 1.5, np.float32)
    depth[:, 20:] = 2.5
    depth[:, 40:] = 0
    relief = relief_of(View(FRONT, depth=depth, source=source))
    expected = np.zeros(depth.shape, bool)
    expected[:, :19], expected[:, 21:40] = True, True
    assert np.array_equal(relief.smooth, expected)
    assert np.abs(relief.depth[:, :40] - depth[:, :40]).max() < 1e-3
    assert np.allclose(relief.depth[:, 40:], 2.5, atol=1e-3)  # continued over what is not known
    assert np.abs(relief.slope).max() < 1e-3


def test_a_slope_is_no_step() -> None:
    depth = (1.5 + 4 / 48 * np.arange(48, dtype=np.float32) * np.ones((32, 1))).astype(np.float32)  # 4 deep, 2 wide
    relief = relief_of(View(FRONT, depth=depth))
    assert relief.smooth.all()
    assert np.allclose(relief.slope, [4 / 48, 0], atol=1e-4)


def test_smooth_does_not_depend_on_how_far_the_camera_is(sphere) -> None:
    near = relief_of(sphere.view(FRONT, 64))
    away = look_at_origin("away", (0.0, -1502.0, 0.0), Orthographic())
    assert near.smooth.sum() > 500
    assert np.array_equal(relief_of(sphere.view(away, 64)).smooth, near.smooth)


@pytest.mark.parametrize("centre", [(32.0, 32.0), (30.3, 33.8)])
@pytest.mark.parametrize("radius", [12.25, 20.6])
def test_outlines_of_circles(centre: tuple[float, float], radius: float) -> None:
    fine = (np.arange(64 * 16) + 0.5) / 16
    inside = np.hypot(fine[None] - centre[0], fine[:, None] - centre[1]) < radius
    covered = inside.reshape(64, 16, 64, 16).mean((1, 3))
    x, y = centres(64)
    true = np.hypot(x - centre[0], y - centre[1]) - radius
    rgba = np.dstack([np.full((64, 64, 3), 99), np.round(255 * covered)]).astype(np.uint8)
    view = View(FRONT, rgba)
    outline = outline_of(view, mask_of(view))
    assert np.abs(outline - true)[np.abs(true) < 0.25].max() < 0.15
    assert np.abs(outline - true).max() < 0.75  # further away it is measured from pixel to pixel
    left, right = outline[:, :-1], outline[:, 1:]
    row, column = np.nonzero((left < 0) != (right < 0))
    crossing = column + 0.5 + left[row, column] / (left - right)[row, column]
    assert len(row) > 30
    assert np.abs(np.hypot(crossing - centre[0], row + 0.5 - centre[1]) - radius).max() < 0.15
    hard = replace(view, color=np.where(rgba > 127, 255, 0).astype(np.uint8))
    coarse = outline_of(hard, mask_of(hard))
    assert np.abs(coarse - true).max() < 0.75
    assert np.array_equal(coarse < 0, mask_of(hard))


def test_masks_come_from_alpha_else_from_depth_else_from_nowhere(sphere) -> None:
    view = sphere.view(FRONT, 64)
    assert np.array_equal(mask_of(view), view.color[..., 3] > 127)
    solid = replace(view, color=np.dstack([view.color[..., :3], np.full((64, 64, 1), 255, np.uint8)]))
    assert np.array_equal(mask_of(solid), view.depth > 0)
    assert mask_of(replace(solid, depth=None)) is None
    assert mask_of(View(FRONT, depth=np.full((4, 4), 2.0))) is None
    relief = relief_of(replace(solid, depth=None))
    assert relief.depth is None
    assert relief.outline is None
    assert not relief.smooth.any()
    assert relief.color is not None


def test_depth_that_is_no_number_is_no_depth(sphere) -> None:
    view = sphere.view(FRONT, 64)
    depth = np.where(view.depth > 0, view.depth, np.nan)
    depth[30:34, 30:34] = np.inf
    gaps = replace(view, depth=np.where(np.isfinite(depth), depth, 0))
    assert np.array_equal(known(depth), gaps.depth > 0)
    ours, plain = relief_of(replace(view, depth=depth)), relief_of(gaps)
    for name in ("depth", "slope", "smooth", "outline"):
        assert np.isfinite(getattr(ours, name)).all(), name
        assert np.array_equal(getattr(ours, name), getattr(plain, name)), name
    assert not ours.smooth[30:34, 30:34].any()


def test_colours_do_not_take_the_background_in(sphere) -> None:
    view = sphere.view(FRONT, 64)
    black, white = (
        replace(view, color=np.where(view.color[..., 3:] == 255, view.color, [v, v, v, 0]).astype(np.uint8))
        for v in (0, 255)
    )
    assert np.array_equal(relief_of(black).color, relief_of(white).color)


def test_reliefs_keep_their_order_and_weights(sphere, ring) -> None:
    frames = tuple(replace(sphere.view(camera, 32), weight=1.0 + i) for i, camera in enumerate(ring))
    reliefs = reliefs_of(Views(frames))
    assert [relief.camera.name for relief in reliefs] == [camera.name for camera in ring]
    assert [relief.weight for relief in reliefs] == [1.0 + i for i in range(8)]


def test_lookup_is_bilinear_and_the_border_goes_on() -> None:
    rng = np.random.default_rng(3)
    picture = rng.normal(size=(9, 13, 2)).astype(np.float32)
    x, y = rng.uniform(-3, 16, 500), rng.uniform(-3, 12, 500)
    found = lookup(picture, x, y)
    for channel in range(2):
        expected = map_coordinates(picture[..., channel], [y - 0.5, x - 0.5], order=1, mode="nearest")
        assert np.abs(found[:, channel] - expected).max() < 0.01  # it stops a thousandth of a pixel before the border
        assert np.abs(lookup(picture[..., channel], x, y) - found[:, channel]).max() == 0
