"""Texture coordinates: the surface cut into charts and laid flat in the unit square. uv as in `conventions`.

Charts are parts that look roughly along one axis, each laid flat along its mean normal; a part that would cover
another of its chart becomes a chart of its own. Charts are packed in rows. (xatlas makes rounder charts and takes ten
times as long.)
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components

from mv3d_cli.kernels.rasterize import rasterize
from mv3d_cli.meshes.repair import opposite_edges
from mv3d_cli.scene.camera import Camera, Orthographic
from mv3d_cli.scene.mesh import Mesh

PADDING = 3
"""Texels between charts, so that no chart's filtered texels reach into the next."""

AXES = np.concatenate([np.eye(3), -np.eye(3)])
SMALL = 40
"""Faces; smaller parts join a neighbour that looks nearly the same way."""

FACING = 0.1
"""Cosine between a face and its chart below which the face leaves the chart."""


@dataclass(frozen=True)
class Layout:
    """Charts laid flat, each in its own coordinates (scene units), y down.

    source  the mesh's vertex of each laid vertex
    chart   the chart of each laid vertex
    facing  cosine between each face and its chart
    """

    source: Int[np.ndarray, "laid"]
    chart: Int[np.ndarray, "laid"]
    faces: Int[np.ndarray, "faces 3"]
    flat: Float[np.ndarray, "laid 2"]
    facing: Float[np.ndarray, "faces"]


def unwrapped(mesh: Mesh, texture_size: int) -> Mesh:
    """The mesh with one atlas of charts for a square texture of `texture_size` texels; faces keep their order.

    Vertices on the borders of charts are doubled; shading normals stay as they are.
    """
    layout = _layout(mesh, _charts(mesh))
    for _ in range(3):
        apart = _covered(mesh, layout, texture_size) | (layout.facing < FACING)
        if not apart.any():
            break
        layout = _layout(mesh, _regrouped(mesh, layout, apart))
    source, uvs = layout.source, _packed(layout, texture_size)
    kept = {name: getattr(mesh, name)[source] for name in ("normals", "colors") if getattr(mesh, name) is not None}
    return replace(mesh, vertices=mesh.vertices[source], faces=layout.faces.astype(np.int32), uvs=uvs, **kept)


def uv_camera() -> Camera:
    """The camera that sees points (u, v, 0) at pixel (u, v) * size."""
    pose = np.eye(4)
    pose[:3, 3] = 0.5, 0.5, -1.0
    return Camera("uv", pose, Orthographic(0.5))


def _neighbours(mesh: Mesh) -> tuple[Int[np.ndarray, "pairs"], Int[np.ndarray, "pairs"]]:
    """Pairs of faces that share an edge."""
    pairs = opposite_edges(mesh)[0] // 3
    return pairs[:, 0], pairs[:, 1]


def _joined(a: np.ndarray, b: np.ndarray, count: int) -> csr_array:
    ends = np.concatenate([a, b]), np.concatenate([b, a])
    return coo_array((np.ones(len(ends[0]), np.float32), ends), shape=(count, count)).tocsr()


def _area_normals(mesh: Mesh) -> Float[np.ndarray, "faces 3"]:
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2


def _charts(mesh: Mesh) -> Int[np.ndarray, "faces"]:
    """The chart of each face: connected faces whose smoothed normals are nearest to the same axis."""
    count = len(mesh.faces)
    a, b = _neighbours(mesh)
    beside = _joined(a, b, count)
    normals = _area_normals(mesh)
    smooth = normals
    for _ in range(8):
        smooth = smooth + beside @ smooth
    towards = normals @ AXES.T > FACING * np.linalg.norm(normals, axis=1, keepdims=True)
    axis = (smooth @ AXES.T).argmax(axis=1)
    for _ in range(12):
        same = axis[a] == axis[b]
        _, part = connected_components(_joined(a[same], b[same], count), directed=False)
        small = np.bincount(part)[part] < SMALL
        votes = (beside @ (np.eye(6, dtype=np.float32)[axis] * ~small[:, None])) * towards
        moved = small & (votes.max(axis=1) > 0)
        if not moved.any():
            break
        axis = np.where(moved, votes.argmax(axis=1), axis)
    same = axis[a] == axis[b]
    return connected_components(_joined(a[same], b[same], count), directed=False)[1]


def _layout(mesh: Mesh, chart: Int[np.ndarray, "faces"]) -> Layout:
    """Each chart projected along its mean normal."""
    normals = _area_normals(mesh)
    count = int(chart.max()) + 1
    mean = np.stack([np.bincount(chart, normals[:, axis], count) for axis in range(3)], axis=1)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-300)
    upright = np.where(np.abs(mean[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[0.0, 1.0, 0.0]])
    right = np.cross(upright, mean)
    right /= np.maximum(np.linalg.norm(right, axis=1, keepdims=True), 1e-300)
    down = -np.cross(mean, right)
    laid, faces = np.unique(chart[:, None] * len(mesh.vertices) + mesh.faces, return_inverse=True)
    source, owner = laid % len(mesh.vertices), laid // len(mesh.vertices)
    points = mesh.vertices[source].astype(np.float64)
    flat = np.stack([(points * right[owner]).sum(axis=1), (points * down[owner]).sum(axis=1)], axis=1)
    lengths = np.maximum(np.linalg.norm(normals, axis=1), 1e-300)
    facing = np.where(lengths > 1e-12, (normals * mean[chart]).sum(axis=1) / lengths, 1.0)
    return Layout(source, owner, faces.reshape(-1, 3), _lying(flat, owner), facing)


def _covered(mesh: Mesh, layout: Layout, size: int) -> Bool[np.ndarray, "faces"]:
    """Faces that another part of their chart covers: at their middle lies a point of the surface far from them."""
    _, width = _shelves(layout, size)
    uv = _packed(layout, size)
    picture = rasterize(np.pad(uv, ((0, 0), (0, 1))), layout.faces.astype(np.int32), [uv_camera()], size, size)
    corners = mesh.vertices[mesh.faces]
    middle = (uv[layout.faces].mean(axis=1) * size).astype(int).clip(0, size - 1)
    seen = picture.face[0, middle[:, 1], middle[:, 0]]
    place = np.einsum("fc,fcx->fx", picture.barycentric[0, middle[:, 1], middle[:, 0]], corners[seen])
    reach = np.linalg.norm(corners - corners.mean(axis=1, keepdims=True), axis=2).max(axis=1)
    far = np.linalg.norm(place - corners.mean(axis=1), axis=1) > reach + 6 * width / size
    return (seen >= 0) & far


def _shelves(layout: Layout, size: int) -> tuple[Float[np.ndarray, "charts 2"], float]:
    """Where charts lie apart, row by row, highest first; and the width of the smallest square found that holds them."""
    count = int(layout.chart.max()) + 1
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    np.minimum.at(low, layout.chart, layout.flat)
    np.maximum.at(high, layout.chart, layout.flat)
    extent = high - low
    start = max(float(np.sqrt(extent.prod(axis=1).sum())), float(extent.max()))
    best, least = np.zeros((count, 2)), np.inf
    for row in start * np.linspace(1.0, 1.7, 29):
        gap = PADDING * row / size
        places, width = _rows(extent + gap, row)
        if width < least:
            best, least = places + gap / 2, width
    return best - low, least


def _rows(extent: Float[np.ndarray, "charts 2"], row: float) -> tuple[Float[np.ndarray, "charts 2"], float]:
    """Corners of boxes in rows of that length, highest first, and the side of the square around them."""
    places = np.zeros_like(extent)
    x = y = height = longest = 0.0
    sizes = extent.tolist()
    for index in np.argsort(-extent[:, 1], kind="stable").tolist():
        wide, high = sizes[index]
        if x > 0 and x + wide > row:
            x, y, height = 0.0, y + height, 0.0
        places[index] = x, y
        x, height = x + wide, max(height, high)
        longest = max(longest, x)
    return places, max(longest, y + height)


def _regrouped(mesh: Mesh, layout: Layout, apart: Bool[np.ndarray, "faces"]) -> Int[np.ndarray, "faces"]:
    """Charts without the faces that are `apart`, which form charts of their own."""
    chart = layout.chart[layout.faces[:, 0]]
    a, b = _neighbours(mesh)
    same = (chart[a] == chart[b]) & (apart[a] == apart[b])
    return connected_components(_joined(a[same], b[same], len(chart)), directed=False)[1]


def _packed(layout: Layout, size: int) -> Float[np.ndarray, "laid 2"]:
    """uv of the laid vertices in the unit square, one scale for all charts."""
    places, width = _shelves(layout, size)
    return ((layout.flat + places[layout.chart]) / width).clip(0, 1).astype(np.float32)


def _lying(flat: Float[np.ndarray, "laid 2"], chart: Int[np.ndarray, "laid"]) -> Float[np.ndarray, "laid 2"]:
    """Each chart turned so that the box around it is smallest, and wider than high."""
    order = np.argsort(chart, kind="stable")
    turned = np.empty_like(flat)
    for part in np.split(order, np.flatnonzero(np.diff(chart[order])) + 1):
        _, (wide, high), degrees = cv2.minAreaRect(flat[part].astype(np.float32))
        angle = np.deg2rad(degrees + (90 if high > wide else 0))
        c, s = np.cos(angle), np.sin(angle)
        turned[part] = flat[part] @ np.array([[c, -s], [s, c]])
    return turned
