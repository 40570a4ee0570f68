"""How alike two shapes are: distances between samples of their surfaces.

Scene units and world axes, (points, 3) float64; distances are plain, never squared.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from mv3d_cli.kernels.rasterize import rasterize
from mv3d_cli.scene.camera import Camera, Orthographic, look_at_origin

PLANE_REACH = 0.008  # nearest points closer than this lie on one smooth piece: the step along it is sampling noise
DIRECTIONS = 50
PICTURE = 384  # pixels a side for each direction

Points = Float[np.ndarray, "points 3"]


@dataclass(frozen=True)
class Surface:
    """Samples of a surface with unit normals; `seen`: which of them the views that were given can see."""

    points: Points
    normals: Points
    seen: Bool[np.ndarray, "points"] | None = None


@dataclass(frozen=True)
class ShapeScores:
    """How near a predicted surface is to the true one; NaN where there is no such part.

    chamfer         mean of the two one-way mean distances, point to nearest point
    chamfer_plane   the same, to the nearest point's tangent plane where that point is closer than PLANE_REACH
    f_01 .. f_05    F-score: harmonic mean of precision and recall at .01, .02, .05 (Knapitsch et al., 2017)
    normals         normal consistency: |cosine| between nearest points' normals, mean of both ways
    seen, unseen    `chamfer` on the part of the true surface that the views see, or do not
    """

    chamfer: float
    chamfer_plane: float
    f_01: float
    f_02: float
    f_05: float
    normals: float
    seen: float
    unseen: float


@dataclass(frozen=True)
class Distances:
    """From each point of one surface to another: `nearest` index there, `to_point`, `to_plane`, |cosine|."""

    nearest: Int[np.ndarray, "points"]
    to_point: Float[np.ndarray, "points"]
    to_plane: Float[np.ndarray, "points"]
    cosine: Float[np.ndarray, "points"]


def surface_samples(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"], count: int, seed: int
) -> Surface:
    """`count` points spread evenly over the whole surface, inner sheets too, with the normals of their faces."""
    rng = np.random.default_rng(seed)
    a, b, c = (vertices[faces[:, i]].astype(np.float64) for i in range(3))
    cross = np.cross(b - a, c - a)
    double_area = np.linalg.norm(cross, axis=1)
    ends = np.cumsum(double_area)
    face = np.searchsorted(ends, rng.uniform(0, ends[-1], count), side="right")
    u, v = rng.uniform(size=(2, count, 1))
    beyond = u + v > 1
    u, v = np.where(beyond, 1 - u, u), np.where(beyond, 1 - v, v)
    points = a[face] + u * (b - a)[face] + v * (c - a)[face]
    return Surface(points, cross[face] / double_area[face, None])


def outer_surface(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"], count: int, seed: int
) -> Surface:
    """At most `count` points of the surface that can be seen from outside, with normals towards the viewer.

    They are the first hits of parallel rays from DIRECTIONS random directions (always the same), thinned by `seed`:
    sheets that are hidden inside do not count.
    """
    vertices = np.ascontiguousarray(vertices, np.float32)
    faces = np.ascontiguousarray(faces, np.int32)
    cameras = _cameras_around(float(np.linalg.norm(vertices[np.unique(faces)], axis=1).max()))
    seen = rasterize(vertices, faces, cameras, PICTURE, PICTURE)
    hits = np.flatnonzero(seen.face.reshape(-1) >= 0)
    kept = np.sort(np.random.default_rng(seed).permutation(hits)[:count])
    corners = vertices[faces[seen.face.reshape(-1)[kept]]].astype(np.float64)
    points = (corners * seen.barycentric.reshape(-1, 3)[kept][..., None]).sum(axis=1)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    forward = np.stack([camera.world_from_camera[:3, 2] for camera in cameras])[kept // PICTURE**2]
    return Surface(points, np.where((normals * forward).sum(axis=1, keepdims=True) > 0, -normals, normals))


def _cameras_around(radius: float) -> list[Camera]:
    """Parallel cameras at random directions that see a sphere of `radius` about the origin."""
    directions = np.random.default_rng(0).normal(size=(DIRECTIONS, 3))
    directions *= 2 * radius / np.linalg.norm(directions, axis=1, keepdims=True)
    lens = Orthographic(1.001 * radius)
    return [look_at_origin(f"{i:02d}", (x, y, z), lens) for i, (x, y, z) in enumerate(directions.tolist())]


def distances(a: Surface, b: Surface) -> Distances:
    """From each point of `a` to the nearest point of `b` and to its tangent plane."""
    to_point, nearest = KDTree(b.points).query(a.points, workers=-1)
    off = ((a.points - b.points[nearest]) * b.normals[nearest]).sum(axis=1)
    cosine = (a.normals * b.normals[nearest]).sum(axis=1)
    to_plane = np.where(to_point < PLANE_REACH, np.abs(off), to_point)
    return Distances(np.asarray(nearest), to_point, to_plane, np.abs(cosine))


def shape_scores(predicted: Surface, true: Surface) -> ShapeScores:
    """Scores of a predicted surface; `seen` and `unseen` need `true.seen`."""
    precise, complete = distances(predicted, true), distances(true, predicted)
    nowhere = np.zeros(len(true.points), bool)
    seen, unseen = (nowhere, nowhere) if true.seen is None else (true.seen, ~true.seen)
    return ShapeScores(
        chamfer=_mean(precise.to_point, complete.to_point),
        chamfer_plane=_mean(precise.to_plane, complete.to_plane),
        f_01=_f_score(precise, complete, 0.01),
        f_02=_f_score(precise, complete, 0.02),
        f_05=_f_score(precise, complete, 0.05),
        normals=_mean(precise.cosine, complete.cosine),
        seen=_chamfer_of(precise, complete, seen),
        unseen=_chamfer_of(precise, complete, unseen),
    )


def _mean(one: Float[np.ndarray, "a"], other: Float[np.ndarray, "b"]) -> float:
    """Mean of the two means; NaN where one has nothing."""
    return float((one.mean() + other.mean()) / 2) if len(one) and len(other) else float("nan")


def _chamfer_of(precise: Distances, complete: Distances, part: Bool[np.ndarray, "points"]) -> float:
    """Chamfer between a part of the true surface and what of the prediction is nearest to it."""
    return _mean(precise.to_point[part[precise.nearest]], complete.to_point[part])


def _f_score(precise: Distances, complete: Distances, reach: float) -> float:
    precision, recall = (precise.to_point < reach).mean(), (complete.to_point < reach).mean()
    return float(2 * precision * recall / max(precision + recall, 1e-12))
