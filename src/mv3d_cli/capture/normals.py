"""Normals from depth: a plane is fitted around every pixel, to what lies on the pixel's own side of every step.

Across a plane, z is linear in the picture under parallel rays, and 1 / z is under a pinhole; that quantity is called
the *height* below. Its slope per pixel gives the plane's normal exactly, in scene units. Axes as in
`scene.conventions`: camera axes inside, the viewer's axes (x right, y up, z to the viewer) in what is returned.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from scipy.ndimage import gaussian_filter

from mv3d_cli.scene.camera import Camera, Perspective, pixel_from_camera
from mv3d_cli.scene.conventions import RIG_RADIUS, bytes_from_normal

ROUNDS = 3  # of reweighting; the third moves normals by less than a tenth of a degree
RIDGE = 1e-3  # keeps the first guess where the neighbours do not determine a plane

Heights = Float[np.ndarray, "height width"]


def normals_from_depth(
    depth: Float[np.ndarray, "height width"], camera: Camera, *, sigma: float = 1.0, edge: float = 2.0
) -> Float32[np.ndarray, "height width 3"]:
    """Unit normals in the viewer's axes; zero where there is no surface (depth 0 or not finite).

    sigma  of the Gaussian window of the fit, in pixels; 0: one-sided differences alone
    edge   neighbours off the plane by more than this many pixels' width hardly count: steps stay sharp

    Weighted least squares with the weights of Geman and McClure (1985), from a slope that ignores steps.
    """
    valid = np.isfinite(depth) & (depth > 0)
    solid = np.where(valid, depth, 1).astype(np.float64)
    (scale_x, offset_x), (scale_y, offset_y) = pixel_from_camera(camera, depth.shape[1], depth.shape[0])
    perspective = isinstance(camera.projection, Perspective)
    heights = 1 / solid if perspective else solid
    tolerance = edge / scale_x * (heights if perspective else np.ones_like(heights))
    right, down = _limited_slope(heights, valid, axis=1), _limited_slope(heights, valid, axis=0)
    if sigma > 0:
        heights, right, down = _fitted(heights, valid, (right, down), tolerance, sigma)
    if perspective:
        columns, rows = np.arange(depth.shape[1]) + 0.5 - offset_x, np.arange(depth.shape[0]) + 0.5 - offset_y
        along = right * columns[None, :] + down * rows[:, None] - heights
        normal = np.stack([-right * scale_x, down * scale_y, -along], axis=-1)
    else:
        normal = np.stack([right * scale_x, -down * scale_y, np.ones_like(right)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.where(valid[..., None], normal, 0).astype(np.float32)


def _limited_slope(heights: Heights, valid: Bool[np.ndarray, "height width"], axis: int) -> Heights:
    """Slope per pixel that leans to the flatter side where the two sides differ (van Albada et al., 1982)."""
    step = np.diff(heights, axis=axis)
    known = np.logical_and(*(np.take(valid, range(a, valid.shape[axis] + a - 1), axis) for a in (0, 1)))
    step = np.where(known, step, np.nan)
    pad = [(0, 0), (0, 0)]
    pad[axis] = (1, 0)
    before = np.pad(step, pad, constant_values=np.nan)
    pad[axis] = (0, 1)
    after = np.pad(step, pad, constant_values=np.nan)
    a, b = np.where(np.isnan(before), after, before), np.where(np.isnan(after), before, after)
    tiny = 1e-12
    slope = (a * (b**2 + tiny) + b * (a**2 + tiny)) / (a**2 + b**2 + 2 * tiny)
    return np.nan_to_num(slope)


def _fitted(
    heights: Heights,
    valid: Bool[np.ndarray, "height width"],
    slope: tuple[Heights, Heights],
    tolerance: Heights,
    sigma: float,
) -> tuple[Heights, Heights, Heights]:
    """Height and slopes (right, down) of the planes that fit the neighbours near them, reweighted round by round."""
    reach = int(np.ceil(2 * sigma))
    around, known = np.pad(heights, reach).ravel(), np.pad(valid, reach).ravel()
    place, width = np.flatnonzero(known), heights.shape[1] + 2 * reach
    plane = np.stack([heights[valid], slope[0][valid], slope[1][valid]])
    for _ in range(ROUNDS):
        sums = np.zeros((9, len(place)))
        for i in range(-reach, reach + 1):
            for j in range(-reach, reach + 1):
                neighbour = place + (i * width + j)
                off = around[neighbour] - plane[0] - j * plane[1] - i * plane[2]
                trust = np.exp(-(i**2 + j**2) / (2 * sigma**2)) / (1 + (off / tolerance[valid]) ** 2) ** 2
                weight = trust * known[neighbour]
                for k, factor in enumerate((1, j, i, j * j, i * j, i * i)):
                    if factor:
                        sums[k] += factor * weight
                weight *= off
                for k, factor in enumerate((1, j, i), start=6):
                    if factor:
                        sums[k] += factor * weight
        system = sums[[0, 1, 2, 1, 3, 4, 2, 4, 5]].T.reshape(-1, 3, 3) + RIDGE * np.eye(3)
        plane += np.linalg.solve(system, sums[6:].T[..., None])[..., 0].T
    found = np.zeros((3, *heights.shape))
    found[0] = heights
    found[:, valid] = plane
    return found[0], found[1], found[2]


def paper_normals(depth: Float[np.ndarray, "height width"]) -> UInt8[np.ndarray, "height width 3"]:
    """The normal map of a common recipe, kept for comparison: blind to units, mask, camera and steps.

    Depth as an 8-bit picture, a Gaussian of sigma 1, `numpy.gradient`, dz = 2, 8 bits again.
    """
    unit = np.clip((np.nan_to_num(depth) - (RIG_RADIUS - 1)) / 2, 0, 1)
    picture = gaussian_filter(np.round(np.where(depth > 0, unit, 1) * 255), sigma=1)
    down, right = np.gradient(picture)
    normal = np.dstack([right, -down, np.full_like(picture, 2.0)])
    return bytes_from_normal(normal / np.linalg.norm(normal, axis=-1, keepdims=True))
