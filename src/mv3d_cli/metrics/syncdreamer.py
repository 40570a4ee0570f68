"""The mesh protocol of SyncDreamer (Liu et al., 2023) and of the papers that compare with it.

Both meshes stand in the cameras' world, their bounding box centred and its longest side 1. Nothing is aligned.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from mv3d_cli.kernels.rasterize import rasterize
from mv3d_cli.metrics.overlap import iou, occupancy
from mv3d_cli.scene.camera import Camera, Perspective, pixel_from_camera
from mv3d_cli.scene.mesh import Mesh

PICTURE = 256
VOXEL = 0.01
GRID = 64

Points = Float[np.ndarray, "points 3"]


def syncdreamer_scores(predicted: Mesh, true: Mesh, cameras: Sequence[Camera]) -> tuple[float, float]:
    """(Chamfer distance of what the cameras see, volume IoU on a grid over [-1, 1]^3)."""
    one, other = (_thinned(seen_points(mesh, cameras)) for mesh in (predicted, true))
    insides = [occupancy(mesh.vertices, mesh.faces, GRID) for mesh in (predicted, true)]
    return chamfer(one, other), iou(*insides)


def chamfer(one: Float[np.ndarray, "one 3"], other: Float[np.ndarray, "other 3"]) -> float:
    """Mean of the two one-way mean distances to the nearest point, not squared; NaN where one has no points."""
    if not len(one) or not len(other):
        return float("nan")
    there, _ = KDTree(other).query(one, workers=-1)
    back, _ = KDTree(one).query(other, workers=-1)
    return float((np.mean(there) + np.mean(back)) / 2)


def seen_points(mesh: Mesh, cameras: Sequence[Camera]) -> Points:
    """World points of all pixels in which the cameras see the mesh."""
    depths = rasterize(mesh.vertices, mesh.faces, cameras, PICTURE, PICTURE).depth
    points = []
    for camera, depth in zip(cameras, depths, strict=True):
        rows, columns = np.nonzero(depth > 0)
        z = depth[rows, columns].astype(np.float64)
        (sx, ox), (sy, oy) = pixel_from_camera(camera, PICTURE, PICTURE)
        stretch = z if isinstance(camera.projection, Perspective) else 1.0
        place = np.stack([(columns + 0.5 - ox) / sx * stretch, (rows + 0.5 - oy) / sy * stretch, z], axis=1)
        points.append(place @ camera.world_from_camera[:3, :3].T + camera.world_from_camera[:3, 3])
    return np.concatenate(points)


def _thinned(points: Points) -> Float[np.ndarray, "voxels 3"]:
    """One point for each voxel that holds any: their mean."""
    cells = np.floor(points / VOXEL).astype(np.int64)
    _, cell, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    sums = [np.bincount(cell.reshape(-1), weights=points[:, i], minlength=len(counts)) for i in range(3)]
    return np.stack(sums, axis=1) / counts[:, None]
