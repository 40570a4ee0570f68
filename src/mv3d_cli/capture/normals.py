"""Normals from depth: a plane is fitted around every pixel, to what lies on the pixel's own side of every step.

Across a plane, z is linear in the picture under parallel rays, and 1 / z is under a pinhole; that quantity is called
the *height* below. Its slope per pixel gives the plane's normal exactly, in scene units. Axes as in
`scene.conventions`: camera axes inside, the viewer's axes (x right, y up, z to the viewer) in what is returned.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32, UInt8
from scipy.ndimage import gaussian_filter

from mv3d_cli.kernels.plane_fit import fitted_planes
from mv3d_cli.scene.camera import Camera, Perspective, pixel_from_camera
from mv3d_cli.scene.conventions import RIG_RADIUS, bytes_from_normal


def normals_from_depth(
    depth: Float[np.ndarray, "height width"], camera: Camera, *, sigma: float = 1.0, edge: float = 2.0
) -> Float32[np.ndarray, "height width 3"]:
    """Unit normals in the viewer's axes; zero where there is no surface (depth 0 or not finite).

    sigma  of the Gaussian window of the fit, in pixels; 0: one-sided differences alone
    edge   neighbours off the plane by more than this many pixels' width hardly count: steps stay sharp

    See `kernels.plane_fit`.
    """
    valid = np.isfinite(depth) & (depth > 0)
    solid = np.where(valid, depth, 1).astype(np.float64)
    (scale_x, offset_x), (scale_y, offset_y) = pixel_from_camera(camera, depth.shape[1], depth.shape[0])
    perspective = isinstance(camera.projection, Perspective)
    heights = 1 / solid if perspective else solid
    tolerance = edge / scale_x * (heights if perspective else np.ones_like(heights))
    heights, right, down = fitted_planes(heights, valid, tolerance, sigma)
    if perspective:
        columns, rows = np.arange(depth.shape[1]) + 0.5 - offset_x, np.arange(depth.shape[0]) + 0.5 - offset_y
        along = right * columns[None, :] + down * rows[:, None] - heights
        normal = np.stack([-right * scale_x, down * scale_y, -along], axis=-1)
    else:
        normal = np.stack([right * scale_x, -down * scale_y, np.ones_like(right)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.where(valid[..., None], normal, 0).astype(np.float32)


def paper_normals(depth: Float[np.ndarray, "height width"]) -> UInt8[np.ndarray, "height width 3"]:
    """The normal map of a common recipe, kept for comparison: blind to units, mask, camera and steps.

    Depth as an 8-bit picture, a Gaussian of sigma 1, `numpy.gradient`, dz = 2, 8 bits again.
    """
    unit = np.clip((np.nan_to_num(depth) - (RIG_RADIUS - 1)) / 2, 0, 1)
    picture = gaussian_filter(np.round(np.where(depth > 0, unit, 1) * 255), sigma=1)
    down, right = np.gradient(picture)
    normal = np.dstack([right, -down, np.full_like(picture, 2.0)])
    return bytes_from_normal(normal / np.linalg.norm(normal, axis=-1, keepdims=True))
