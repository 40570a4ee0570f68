"""Colours for what no view saw: carried over the surface, then over the atlas's gaps."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.sparse import coo_array, csc_array, diags_array
from scipy.sparse.linalg import splu

from mv3d_cli.scene.mesh import Mesh

HOLD = 10.0
"""How firmly a seen vertex keeps its colour, against one neighbour's pull."""


def harmonic(
    mesh: Mesh, colors: Float[np.ndarray, "vertices 3"], trust: Float[np.ndarray, "vertices"]
) -> Float[np.ndarray, "vertices 3"]:
    """Colours that are smooth over the surface and stay near `colors` where `trust` in [0, 1] is high.

    Solves (L + diag(h)) x = diag(h) c, L the Laplacian of the mesh's graph (doubled vertices are one), h = HOLD trust.
    A component without a trusted vertex takes the mean colour; a mesh without one is grey.
    """
    _, one = np.unique(mesh.vertices, axis=0, return_inverse=True)
    one = one.reshape(-1)
    count = int(one.max()) + 1
    hold = np.bincount(one, HOLD * trust, count)
    held = np.stack([np.bincount(one, HOLD * trust * channel, count) for channel in colors.T], axis=1)
    if not hold.any():
        return np.full((len(colors), 3), 0.5)
    mean = held.sum(axis=0) / hold.sum()
    ends = one[mesh.faces].ravel(), one[np.roll(mesh.faces, -1, axis=1)].ravel()
    beside = coo_array((np.ones(len(ends[0])), ends), shape=(count, count)).tocsc()
    beside = beside + beside.T
    faint = 1e-6
    laplacian = diags_array(beside.sum(axis=0) + hold + faint) - beside
    solved = splu(csc_array(laplacian), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve(
        held + faint * mean
    )
    return solved[one]


def dilated(picture: np.ndarray, valid: Bool[np.ndarray, "height width"]) -> np.ndarray:
    """The picture with every invalid texel taken from the nearest valid one."""
    if not valid.any():
        return picture
    invalid = (~valid).astype(np.uint8)
    label = np.asarray(cv2.distanceTransformWithLabels(invalid, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)[1], int)
    source = np.zeros(int(label.max()) + 1, np.int64)
    source[label[valid]] = np.flatnonzero(valid)
    return picture.reshape(-1, picture.shape[-1])[source[label]]
