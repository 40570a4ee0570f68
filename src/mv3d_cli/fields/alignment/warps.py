"""Warps: how one view's pixels move so that the views agree.

A pixel (x, y, z) moves to (x + dx, y + dy, z + (z - r) scale + shift + dz): dx and dy in pixels, the rest in scene
units, r the rig's distance; dx, dy and dz are read off a coarse grid over the picture, bilinearly.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, Float32

from mv3d_cli.fields.relief import Relief, lookup
from mv3d_cli.scene.conventions import RIG_RADIUS

GRID = 9  # control points a side


@dataclass(frozen=True)
class Warp:
    """How one view's pixels move: `offsets` (grid, grid, 3) dx, dy in pixels and dz; `gain`: its colours' excess."""

    offsets: Float[np.ndarray, "grid grid 3"]
    scale: float = 0.0
    shift: float = 0.0
    gain: float = 1.0


def still() -> Warp:
    """The warp that moves nothing."""
    return Warp(np.zeros((GRID, GRID, 3)))


def basis_of(at: Float[np.ndarray, "points 2"], shape: tuple[int, int], grid: int) -> Float32[np.ndarray, "points _"]:
    """Bilinear weights (n, grid^2) of a grid over the picture (height, width), its corners on the picture's."""
    u = np.clip(at / np.array(shape[::-1]) * (grid - 1), 0, grid - 1.001)
    cell = u.astype(np.int64)
    part = (u - cell).astype(np.float32)
    basis, each = np.zeros((len(at), grid * grid), dtype=np.float32), np.arange(len(at))
    for down in (0, 1):
        for right in (0, 1):
            x, y = (part[:, axis] if far else 1 - part[:, axis] for axis, far in ((0, right), (1, down)))
            basis[each, (cell[:, 1] + down) * grid + cell[:, 0] + right] = x * y
    return basis


def offsets_over(warp: Warp, shape: tuple[int, int]) -> Float32[np.ndarray, "height width 3"]:
    """dx, dy and dz at every pixel's centre."""
    height, width = shape
    grid = warp.offsets.shape[0]
    x, y = ((np.arange(n, dtype=np.float32) + 0.5) / n * (grid - 1) for n in (width, height))
    at = np.meshgrid(x, y)
    return cv2.remap(warp.offsets.astype(np.float32), at[0], at[1], cv2.INTER_LINEAR)


def came_from(warp: Warp, pixels: Float[np.ndarray, "points 2"], shape: tuple[int, int]) -> np.ndarray:
    """The pixels (x, y) of the view as it came that belong at `pixels`; offsets hardly change over their own length."""
    offsets = offsets_over(warp, shape)[..., :2]
    return pixels - lookup(offsets, pixels[:, 0], pixels[:, 1])


def warped(relief: Relief, warp: Warp) -> Relief:
    """The relief where it belongs, colours divided by their gain."""
    offsets = offsets_over(warp, relief.shape)
    rows, columns = np.indices(relief.shape, dtype=np.float32)
    x, y = columns - offsets[..., 0], rows - offsets[..., 1]

    def moved(picture: np.ndarray) -> np.ndarray:
        return cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    depth = slope = outline = color = None
    if relief.depth is not None and relief.slope is not None:
        depth = moved(relief.depth)
        depth = depth + (depth - RIG_RADIUS) * np.float32(warp.scale) + np.float32(warp.shift) + offsets[..., 2]
        slope = moved(relief.slope)
    if relief.outline is not None:
        outline = moved(relief.outline)
    if relief.color is not None:
        color = moved(relief.color) / np.float32(warp.gain)
    smooth = moved(relief.smooth.astype(np.float32)) > 0.99
    sure = moved(relief.known.astype(np.float32)) > 0.5
    return replace(relief, depth=depth, known=sure, slope=slope, smooth=smooth, outline=outline, color=color)
