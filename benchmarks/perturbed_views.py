"""The standard perturbation: true views become views like generated ones, which disagree about the object.

Stated for pictures of 256 pixels and scaled with them. Per view, `smooth(s, std)` being white noise behind a wrapping
Gaussian of s pixels, rescaled to std:

warp        colour, depth and silhouette all move by smooth(32 px, 1.5 px) across and down
silhouette  its signed distance is shifted by U(-1, 1) px
depth       (1 + a) z + b + smooth(24 px, .015), a and b ~ N(0, .01), z from the rig's centre; then 255 steps of 2 units
colour      gain ~ N(1, .05)

The front is the photo: it is neither warped nor its silhouette shifted.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates

from mv3d_cli.scene.conventions import RIG_RADIUS
from mv3d_cli.scene.views import View, Views

FRONT = "front"

Picture = Float[np.ndarray, "height width"]


def generated_like(views: Views, seed: int) -> Views:
    """The views (colour and depth, parallel cameras of the rig) as a generator might have made them."""
    return Views(tuple(_perturbed(view, np.random.default_rng([seed, i])) for i, view in enumerate(views.frames)))


def _perturbed(view: View, rng: np.random.Generator) -> View:
    assert view.color is not None
    assert view.depth is not None
    unit = view.shape[1] / 256
    depth, color = view.depth.astype(np.float64), view.color.astype(np.float64)
    inside = depth > 0
    depth, color[..., :3] = _filled(depth, inside), _filled(color[..., :3], view.color[..., 3] > 127)
    warp = [_smooth(view.shape, 32 * unit, 1.5 * unit, rng) for _ in range(2)]
    shift = rng.uniform(-1, 1) * unit
    if view.camera.name != FRONT:
        distance = _moved(_signed_distance(inside), warp) + shift
        inside, alpha = distance > 0, (distance + 0.5).clip(0, 1) * 255
        depth = _moved(depth, warp)
        color = np.dstack([*(_moved(color[..., i], warp) for i in range(3)), alpha])
    scale, offset = rng.normal(0, 0.01, 2)
    depth = (1 + scale) * (depth - RIG_RADIUS) + offset + _smooth(view.shape, 24 * unit, 0.015, rng)
    depth = RIG_RADIUS - 1 + 2 * np.round((depth + 1).clip(0, 2) / 2 * 255) / 255
    color[..., :3] *= rng.normal(1, 0.05)
    return replace(
        view,
        color=np.round(color.clip(0, 255)).astype(np.uint8),
        depth=np.where(inside, depth, 0).astype(np.float32),
        normal=None,
        source="photo" if view.camera.name == FRONT else "generated",
    )


def _smooth(shape: tuple[int, int], pixels: float, std: float, rng: np.random.Generator) -> Picture:
    noise = gaussian_filter(rng.normal(size=shape), pixels, mode="wrap")
    return noise * (std / noise.std())


def _filled(picture: np.ndarray, known: Bool[np.ndarray, "height width"]) -> np.ndarray:
    """The picture with every unknown pixel taken from the nearest known one."""
    if not known.any():
        return picture
    rows, columns = np.asarray(distance_transform_edt(~known, return_distances=False, return_indices=True))
    return picture[rows, columns]


def _signed_distance(inside: Bool[np.ndarray, "height width"]) -> Picture:
    """Pixels to the silhouette's edge, which runs half-way between pixel centres; positive inside."""
    inner, outer = (np.asarray(distance_transform_edt(part)) for part in (inside, ~inside))
    return np.where(inside, inner - 0.5, 0.5 - outer)


def _moved(picture: Picture, warp: list[Picture]) -> Picture:
    """The picture looked up (wx, wy) pixels away, bilinearly."""
    rows, columns = np.indices(picture.shape)
    return map_coordinates(picture, [rows + warp[1], columns + warp[0]], order=1, mode="nearest")
