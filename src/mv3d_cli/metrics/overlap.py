"""Insides: which points of a grid lie inside a mesh, and how much two insides, or two silhouettes, overlap."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

NUDGE = (1.13e-6, 1.71e-6)  # keeps rays off the edges of meshes that are aligned with the grid


def iou(one: Bool[np.ndarray, "*shape"], other: Bool[np.ndarray, "*shape"]) -> float:
    """Intersection over union; 1 where both are empty."""
    union = np.count_nonzero(one | other)
    return float(np.count_nonzero(one & other) / union) if union else 1.0


def occupancy(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"], resolution: int, extent: float = 1.0
) -> Bool[np.ndarray, "x y z"]:
    """Whether the centre of each cell of a grid over [-extent, extent]^3 lies inside the mesh.

    A ray inside leaves through an odd number of faces; the six rays along the axes vote, so that small holes do no
    harm. Inside needs four votes. In a watertight mesh all six agree.
    """
    place = (vertices.astype(np.float64) / extent + 1) * (resolution / 2) - 0.5  # cell centres at whole numbers
    votes = np.zeros((resolution,) * 3, np.uint8)
    for axis in range(3):
        turned = np.roll(place, -axis, axis=1)  # (axis, axis + 1, axis + 2)
        crossings = _crossings(turned[faces], resolution)
        behind = np.cumsum(crossings, axis=0)[:-1]
        ahead = crossings.sum(axis=0) - behind
        votes += np.moveaxis(behind % 2 + ahead % 2, (0, 1, 2), np.roll((0, 1, 2), -axis)).astype(np.uint8)
    return votes > 3


def _crossings(
    corners: Float[np.ndarray, "faces 3 3"], resolution: int
) -> Int[np.ndarray, "{resolution+1} {resolution} {resolution}"]:
    """How many faces each line along the first axis meets just before each cell centre; last: behind all of them."""
    flat = corners[..., 1:] - NUDGE
    low = np.ceil(flat.min(axis=1)).clip(0, resolution).astype(int)
    spread = (np.floor(flat.max(axis=1)).clip(-1, resolution - 1).astype(int) + 1 - low).clip(0)
    counts = spread.prod(axis=1)
    face = np.repeat(np.arange(len(corners)), counts)
    nth = np.arange(len(face)) - np.repeat(np.cumsum(counts) - counts, counts)
    line = low[face] + np.stack([nth // spread[face, 1], nth % spread[face, 1]], axis=1)
    a, b, c = (flat[face, i] - line for i in range(3))
    parts = np.stack([_cross(b, c), _cross(c, a), _cross(a, b)], axis=1)
    met = (parts > 0).all(axis=1) | (parts < 0).all(axis=1)
    parts, line, face = parts[met], line[met], face[met]
    height = (parts * corners[face, :, 0]).sum(axis=1) / parts.sum(axis=1)
    cell = np.ceil(height).clip(0, resolution).astype(int)
    crossings = np.zeros((resolution + 1, resolution, resolution), np.int64)
    np.add.at(crossings, (cell, line[:, 0], line[:, 1]), 1)
    return crossings


def _cross(a: Float[np.ndarray, "n 2"], b: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
