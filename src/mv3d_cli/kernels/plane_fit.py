"""Planes fitted around the pixels of a height map, to what lies on the pixel's own side of every step.

A *height* is any quantity that is linear in the picture across a plane: z under parallel rays, 1 / z under a pinhole.
Slopes are per pixel, to the right and down.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

ROUNDS = 3  # of reweighting; the third moves normals by less than a tenth of a degree
RIDGE = 1e-3  # keeps the first guess where the neighbours do not determine a plane

Heights = Float[np.ndarray, "height width"]


def fitted_planes(
    heights: Heights, valid: Bool[np.ndarray, "height width"], tolerance: Heights, sigma: float
) -> tuple[Heights, Heights, Heights]:
    """Height and slopes (right, down) of the plane around each valid pixel.

    tolerance  neighbours off the plane by more than this hardly count, so that steps stay sharp
    sigma      of the Gaussian window, in pixels; 0: the heights as they are, one-sided differences alone

    Weighted least squares with the weights of Geman and McClure (1985), from a slope that ignores steps.
    """
    right, down = _limited_slope(heights, valid, axis=1), _limited_slope(heights, valid, axis=0)
    if sigma == 0:
        return heights, right, down
    return _fitted(heights, valid, (right, down), tolerance, sigma)


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
