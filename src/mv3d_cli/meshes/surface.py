"""Signed distances into triangles: marching cubes on a grid or near the zero of a callable field.

World axes, scene units; distances are negative inside. Grids are indexed [x, y, z] and hold values at their nodes:
node (i, j, k) lies at origin + voxel * (i, j, k). Faces look outwards, and close at the grid's border.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from mv3d_cli.errors import EmptySurface
from mv3d_cli.scene.mesh import Material, Mesh

Distance = Callable[[Float[np.ndarray, "points 3"]], Float[np.ndarray, "points"]]

CHUNK = 1 << 18
"""Points that a field is asked for at once, which bounds its memory."""

OFF_NODE = 1e-3
"""Voxels: a zero nearer to a node than this would make needles and doubled vertices."""

# corners of a tetrahedron: four values give a field's gradient
TETRAHEDRON = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], np.float32)


def surface_of_grid(
    distance: Float[np.ndarray, "x y z"], origin: Float[np.ndarray, "3"], voxel: float, *, smooth: bool = True
) -> Mesh:
    """The closed zero surface of a grid of distances (Lewiner's marching cubes), without materials of its own.

    smooth  the mesh has shading normals
    Raises EmptySurface where the grid has no inside.
    """
    from skimage.measure import marching_cubes

    scaled = np.asarray(distance, np.float32) / np.float32(voxel)
    if not (scaled < 0).any():
        raise EmptySurface(
            "the field has no inside, so there is no surface.",
            "Look at the views: do they show an object before an empty background, and do their cameras agree?",
        )
    scaled = np.where(np.abs(scaled) < OFF_NODE, np.copysign(np.float32(OFF_NODE), scaled), scaled)
    padded = np.pad(scaled, 1, constant_values=100.0)  # so it closes right at the border
    vertices, faces, *_ = marching_cubes(padded, 0.0, gradient_direction="descent")
    placed = np.asarray(origin) + voxel * (vertices.astype(np.float64) - 1)
    mesh = mesh_of(placed, faces)
    return with_normals(mesh) if smooth else mesh


def surface_of_field(
    distance_of: Distance, bounds: Float[np.ndarray, "2 3"], resolution: int, *, stride: int = 4
) -> Mesh:
    """The closed zero surface of a field inside `bounds` (lower, upper), evaluated only near its zero.

    resolution  cells along the longest edge of the bounds
    stride      cells along the edge of a coarse cell; a coarse cell is refined if its corners differ in sign or one
                lies nearer to the surface than the cell is wide, so a thing thinner than a voxel may be missed
    Raises EmptySurface.
    """
    lower, upper = np.asarray(bounds, np.float64)
    voxel = float((upper - lower).max()) / resolution
    cells = np.ceil((upper - lower) / voxel / stride - 1e-6).astype(int)
    coarse = _values(distance_of, _nodes(np.ones(cells + 1, bool)), lower, voxel * stride).reshape(cells + 1)
    near = _near(coarse, voxel * stride)
    blocks = np.copysign(np.float32(stride * voxel), coarse[:-1, :-1, :-1])
    grid = np.pad(_repeated(blocks, stride), (0, 1), mode="edge")
    wanted = _touched(_repeated(near, stride))
    grid[wanted] = _values(distance_of, _nodes(wanted), lower, voxel)
    return surface_of_grid(grid, lower, voxel)


def refine(
    vertices: Float[np.ndarray, "vertices 3"], distance_of: Distance, voxel: float, *, steps: int = 2
) -> Float[np.ndarray, "vertices 3"]:
    """Vertices moved onto the field's zero: secant steps along the gradient, by a voxel at most, never for worse."""
    start = vertices.astype(np.float32)
    step = 0.25 * voxel
    probes = np.stack([_in_chunks(distance_of, start + np.float32(step) * corner) for corner in TETRAHEDRON], axis=1)
    gradient = probes @ TETRAHEDRON / np.float32(4 * step)
    slope = np.maximum(np.linalg.norm(gradient, axis=1), 1e-6)
    direction = gradient / slope[:, None]
    reached, value = np.zeros(len(start), np.float32), _in_chunks(distance_of, start)
    best, least = reached, np.abs(value)
    for _ in range(steps):
        following = np.clip(reached - value / slope, -voxel, voxel).astype(np.float32)
        found = _in_chunks(distance_of, start + following[:, None] * direction)
        moved = following - reached
        secant = np.divide(found - value, moved, out=slope.copy(), where=np.abs(moved) > 1e-4 * voxel)
        slope = np.where(secant > 0.1 * slope, secant, slope)
        reached, value = following, found
        better = np.abs(value) < least
        best, least = np.where(better, reached, best), np.where(better, np.abs(value), least)
    return (start + best[:, None] * direction).astype(np.float32)


def mesh_of(vertices: Float[np.ndarray, "vertices 3"], faces: np.ndarray) -> Mesh:
    """A bare mesh with one plain material."""
    zeros = np.zeros(len(faces), np.int32)
    return Mesh(np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(faces, np.int32), zeros, (Material(),))


def with_normals(mesh: Mesh) -> Mesh:
    """The mesh with shading normals: of each vertex, the mean of its faces' normals weighted by their areas."""
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    count = len(mesh.vertices)
    spread = np.repeat(cross, 3, axis=0)
    total = np.stack([np.bincount(mesh.faces.ravel(), spread[:, axis], count) for axis in range(3)], axis=1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    normals = np.where(length > 0, total / np.maximum(length, 1e-300), [0.0, 0.0, 1.0])
    return replace(mesh, normals=normals.astype(np.float32))


def _in_chunks(distance_of: Distance, points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points"]:
    parts = [distance_of(points[i : i + CHUNK]) for i in range(0, len(points), CHUNK)]
    return np.concatenate(parts).astype(np.float32) if parts else np.zeros(0, np.float32)


def _nodes(wanted: Bool[np.ndarray, "x y z"]) -> np.ndarray:
    return np.argwhere(wanted).astype(np.int16)


def _values(distance_of: Distance, nodes: np.ndarray, lower: np.ndarray, step: float) -> Float[np.ndarray, "nodes"]:
    """The field at nodes of a grid, which become points a chunk at a time."""
    values = np.empty(len(nodes), np.float32)
    for i in range(0, len(nodes), CHUNK):
        values[i : i + CHUNK] = distance_of((lower + step * nodes[i : i + CHUNK]).astype(np.float32))
    return values


def _near(coarse: Float[np.ndarray, "x y z"], width: float) -> Bool[np.ndarray, "x-1 y-1 z-1"]:
    """Coarse cells that the surface may pass."""
    corners = [
        coarse[i : i + coarse.shape[0] - 1, j : j + coarse.shape[1] - 1, k : k + coarse.shape[2] - 1]
        for i in (0, 1)
        for j in (0, 1)
        for k in (0, 1)
    ]
    lowest, highest = np.minimum.reduce(corners), np.maximum.reduce(corners)
    nearest = np.minimum.reduce([np.abs(corner) for corner in corners])
    return ((lowest < 0) & (highest >= 0)) | (nearest < width)


def _repeated(cells: np.ndarray, times: int) -> np.ndarray:
    for axis in range(3):
        cells = np.repeat(cells, times, axis=axis)
    return cells


def _touched(cells: Bool[np.ndarray, "x y z"]) -> Bool[np.ndarray, "x+1 y+1 z+1"]:
    """Nodes that are a corner of a cell."""
    for axis in range(3):
        low = [(0, int(axis == other)) for other in range(3)]
        cells = np.pad(cells, low) | np.pad(cells, [pair[::-1] for pair in low])
    return cells
