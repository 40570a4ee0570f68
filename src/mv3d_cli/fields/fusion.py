"""The closed-form start: aligned views fused into signed distances on a grid, negative inside, scene units."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from mv3d_cli.errors import BadViews
from mv3d_cli.fields.relief import Relief
from mv3d_cli.kernels.fuse import Picture
from mv3d_cli.kernels.fuse import fuse as fuse_pictures
from mv3d_cli.scene.camera import Perspective, pixel_from_camera

EXTENT = 1.05  # half the grid's side, scene units: the unit sphere and a margin
REACH = 1.5  # voxels: the least distance at which a view's surface stops to count
DOUBT = 5.0  # disagreements of the views: the distance grows with them


@dataclass(frozen=True)
class Fusion:
    """Distances at `origin + voxel * (i, j, k)`, true within `reach` of the surface and clamped beyond."""

    distance: Float32[np.ndarray, "x y z"]
    origin: tuple[float, float, float]
    voxel: float
    reach: float


def fuse(reliefs: Sequence[Relief], resolution: int = 192, disagreement: float = 0.0, device: str = "cpu") -> Fusion:
    """The reliefs, already aligned, as signed distances; `disagreement`: what is left of it, scene units.

    Raises BadViews when no view has depth or an outline, and when nothing is left of the object.
    """
    if not any(relief.depth is not None or relief.outline is not None for relief in reliefs):
        raise BadViews("no view says where the object is", "views need depth, or colour with a transparent background")
    voxel = 2 * EXTENT / resolution
    reach = max(REACH * voxel, DOUBT * disagreement)
    first = -EXTENT + voxel / 2
    origin = (first, first, first)
    pictures = [_picture(relief) for relief in reliefs]
    distance = fuse_pictures(pictures, resolution, origin, voxel, reach, device)
    if not (distance < 0).any():
        raise BadViews(
            "the views contradict each other: their silhouettes leave nothing of the object",
            "check that the cameras and masks belong together; a view can be left out with --weight NAME=0",
        )
    return Fusion(distance, origin, voxel, reach)


def _picture(relief: Relief) -> Picture:
    """The relief as the kernel reads it."""
    height, width = relief.shape
    texels = np.zeros((height, width, 4), dtype=np.float32)
    if relief.depth is not None and relief.slope is not None:
        texels[..., 0], texels[..., 1], texels[..., 3] = relief.depth, _facing(relief), relief.known
    if relief.outline is not None:
        texels[..., 2] = relief.outline * relief.pixel_width
    else:
        texels[..., 2] = -1
    return Picture(relief.camera, texels, relief.depth is not None, relief.outline is not None, relief.weight)


def _facing(relief: Relief) -> Float32[np.ndarray, "height width"]:
    """|normal . ray| of the surface in each pixel, the ray's z being 1."""
    assert relief.depth is not None
    assert relief.slope is not None
    height, width = relief.shape
    (sx, ox), (sy, oy) = pixel_from_camera(relief.camera, width, height)
    slope = relief.slope * np.array([sx, sy], dtype=np.float32)
    if not isinstance(relief.camera.projection, Perspective):
        return 1 / np.sqrt(1 + (slope**2).sum(-1))
    x, y = (np.arange(width) + 0.5 - ox) / sx, (np.arange(height) + 0.5 - oy) / sy
    along = relief.depth + slope[..., 0] * x[None, :] + slope[..., 1] * y[:, None]
    return (relief.depth / np.sqrt((slope**2).sum(-1) + along**2)).astype(np.float32)
