"""Whole surfaces: components told apart, floaters and bubbles dropped, holes closed.

A surface is judged with its vertices welded, since texture seams and flat shading split them.
"""

# pymeshlab defines its classes where type checkers do not look:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mv3d_cli.meshes.surface import mesh_of, with_normals
from mv3d_cli.scene.mesh import Mesh


def welded(mesh: Mesh) -> Mesh:
    """The bare surface: vertices at the same place are one, faces without area are gone."""
    vertices, index = np.unique(mesh.vertices, axis=0, return_inverse=True)
    faces = index.reshape(-1)[mesh.faces]
    solid = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return mesh_of(vertices, faces[solid])


def watertight(mesh: Mesh) -> bool:
    """Whether every edge belongs to two faces that look to the same side."""
    return len(mesh.faces) > 0 and _is_closed(welded(mesh))


def components(mesh: Mesh) -> int:
    """How many connected surfaces the mesh has."""
    count, _ = _labels(welded(mesh))
    return count


def without_floaters(mesh: Mesh, keep: float = 0.01) -> Mesh:
    """The mesh without components smaller than `keep` of the largest one's area, and without enclosed bubbles.

    A bubble is a cavity (a component turned inside out), or what lies inside of another component.
    """
    count, label = _labels(mesh)
    if count == 1:
        return mesh
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.bincount(label, np.linalg.norm(normal, axis=1), count)
    volume = np.bincount(label, np.einsum("fi,fi->f", corners[:, 0], normal), count)
    kept = (area >= keep * area.max()) & (volume > 0)
    kept[area.argmax()] = True
    for component in np.flatnonzero(kept):
        others = corners[kept[label] & (label != component)]
        face = corners[np.argmax(label == component)]
        askew = np.array([0.00577, 0.00318, 0.0]) * np.ptp(face, axis=0).max()  # grids put vertices above each other
        if _encloses(others, face.mean(axis=0) + askew):
            kept[component] = False
    return _with_faces(mesh, np.flatnonzero(kept[label]))


def repaired(mesh: Mesh) -> Mesh:
    """The surface cut open where it touches itself, and with its holes closed; a watertight one is untouched."""
    if watertight(mesh):
        return mesh
    fixed = unpinched(welded(mesh))
    if not watertight(fixed):  # sheets that meet again at both ends of an edge
        fixed = unpinched(_halved(fixed))
    if not watertight(fixed):
        fixed = unpinched(_without_holes(fixed))
    return with_normals(fixed) if mesh.normals is not None else fixed


def unpinched(bare: Mesh) -> Mesh:
    """The surface parted where several sheets share an edge or meet at a point, by a hundredth of the faces there.

    Around such an edge the faces that bound the same solid wedge stay together, so the solid is cut and no two
    sheets touch. Leftovers that enclose nothing (fewer than four faces) are dropped.
    """
    corner_count = bare.faces.size
    i, j = np.concatenate(opposite_edges(bare)).T
    rows, columns = np.concatenate([i, _next(i)]), np.concatenate([_next(j), j])
    joined = coo_array((np.ones(len(rows), bool), (rows, columns)), shape=(corner_count, corner_count))
    count, vertex = connected_components(joined, directed=False)
    source = np.empty(count, np.int64)
    source[vertex] = bare.faces.ravel()
    middle = np.repeat(bare.vertices[bare.faces].mean(axis=1), 3, axis=0)
    fan = np.stack([np.bincount(vertex, middle[:, axis], count) for axis in range(3)], axis=1)
    fan /= np.bincount(vertex, minlength=count)[:, None]
    place = bare.vertices[source].astype(np.float64)
    split = (np.bincount(source, minlength=len(bare.vertices)) > 1)[source]
    place[split] += 0.01 * (fan[split] - place[split])
    parted = mesh_of(place, vertex.reshape(-1, 3))
    number, label = _labels(parted)
    return _with_faces(parted, np.flatnonzero(np.bincount(label, minlength=number)[label] >= 4))


def _next(edge: Int[np.ndarray, "edges"]) -> Int[np.ndarray, "edges"]:
    """The half-edge that follows in the same face; half-edge 3 f + k runs from corner k of face f to the next."""
    return edge - edge % 3 + (edge + 1) % 3


def opposite_edges(bare: Mesh) -> tuple[Int[np.ndarray, "plain 2"], Int[np.ndarray, "crowded 2"]]:
    """Pairs of half-edges that are two sides of one edge of the solid: where no other face has the edge, and where."""
    start = bare.faces.ravel().astype(np.int64)
    end = np.roll(bare.faces, -1, axis=1).ravel().astype(np.int64)
    key = np.minimum(start, end) * len(bare.vertices) + np.maximum(start, end)
    order = np.argsort(key, kind="stable")
    first = np.flatnonzero(np.diff(key[order], prepend=-1))
    size = np.diff(np.append(first, len(order)))
    pairs = np.stack([order[first[size == 2]], order[first[size == 2] + 1]], axis=1)
    crowded = [np.empty((0, 2), np.int64)]
    for begin, length in zip(first[size > 2], size[size > 2], strict=True):
        crowded.append(_wedges(bare, order[begin : begin + length]))
    return pairs[start[pairs[:, 0]] != start[pairs[:, 1]]], np.concatenate(crowded)


def _halved(bare: Mesh) -> Mesh:
    """Edges of more than two faces cut in the middle, each wedge of the solid with a middle of its own."""
    faces, vertices = list(bare.faces.tolist()), list(bare.vertices)
    cut: set[int] = set()
    for pair in opposite_edges(bare)[1]:
        if cut.intersection(pair // 3):
            continue
        cut.update(pair // 3)
        place = bare.vertices[bare.faces[pair // 3]].mean(axis=(0, 1))
        ends = bare.faces.ravel()[[pair[0], _next(pair[:1])[0]]]
        middle = bare.vertices[ends].mean(axis=0)
        for edge in pair:
            turned = np.roll(bare.faces[edge // 3], -(edge % 3)).tolist()
            faces[edge // 3] = [turned[0], len(vertices), turned[2]]
            faces.append([len(vertices), turned[1], turned[2]])
        vertices.append(middle + np.float32(0.05) * (place - middle))
    return mesh_of(np.array(vertices), np.array(faces))


def _wedges(bare: Mesh, edges: Int[np.ndarray, "edges"]) -> Int[np.ndarray, "pairs 2"]:
    """Half-edges at the same two vertices, paired so that each pair bounds a wedge of the solid."""
    start, end = bare.faces.ravel()[edges], bare.faces.ravel()[_next(edges)]
    forward = start < end
    if 2 * forward.sum() != len(edges):
        return np.empty((0, 2), np.int64)
    low, high = min(start[0], end[0]), max(start[0], end[0])
    origin = bare.vertices[low].astype(np.float64)
    axis = bare.vertices[high] - origin
    radial = bare.vertices[bare.faces.ravel()[_next(_next(edges))]] - origin
    across = np.cross(axis, radial[0])
    angle = np.arctan2(radial @ across, radial @ np.cross(across, axis) / max(np.linalg.norm(axis), 1e-30))
    order = np.lexsort((forward, np.round(angle, 6)))
    # a forward face has the solid before it, a backward one behind it: pair them like brackets
    depth = np.cumsum(np.where(forward[order], -1, 1))
    order = np.roll(order, -(int(depth.argmin()) + 1))
    pairs, waiting = [], []
    for edge in order:
        if forward[edge]:
            pairs.append((edges[edge], edges[waiting.pop()]))
        else:
            waiting.append(edge)
    return np.array(pairs, np.int64)


def _without_holes(bare: Mesh) -> Mesh:
    """Faces on impossible edges removed, then holes closed, by MeshLab's filters."""
    import pymeshlab

    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(bare.vertices.astype(np.float64), bare.faces))
    meshes.meshing_remove_duplicate_faces()
    meshes.meshing_repair_non_manifold_edges(method="Remove Faces")
    meshes.meshing_repair_non_manifold_vertices(vertdispratio=0.0)
    meshes.meshing_close_holes(maxholesize=1000, selfintersection=False)
    done = meshes.current_mesh()
    return welded(mesh_of(done.vertex_matrix(), done.face_matrix()))


def _is_closed(bare: Mesh) -> bool:
    edges = bare.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2).astype(np.int64)
    count = len(bare.vertices)
    forth = np.sort(edges[:, 0] * count + edges[:, 1])
    back = np.sort(edges[:, 1] * count + edges[:, 0])
    return bool((np.diff(forth) > 0).all() and np.array_equal(forth, back))


def _labels(mesh: Mesh) -> tuple[int, Int[np.ndarray, "faces"]]:
    """The number of components, and each face's."""
    count = len(mesh.vertices)
    ends = mesh.faces[:, [0, 1]].ravel(), mesh.faces[:, [1, 2]].ravel()
    joined = coo_array((np.ones(len(ends[0]), bool), ends), shape=(count, count))
    _, label = connected_components(joined, directed=False)
    used, label = np.unique(label[mesh.faces[:, 0]], return_inverse=True)
    return len(used), label.reshape(-1)


def _encloses(corners: Float[np.ndarray, "faces 3 3"], point: Float[np.ndarray, "3"]) -> bool:
    """Whether the point lies inside of closed surfaces: signed crossings of the ray that rises from it."""
    flat = corners[:, :, :2] - point[:2]
    following = np.roll(flat, -1, axis=1)
    side = flat[..., 0] * following[..., 1] - flat[..., 1] * following[..., 0]
    met = ((side >= 0).all(axis=1) | (side <= 0).all(axis=1)) & (side != 0).any(axis=1)
    twice_area = side[met].sum(axis=1)
    height = (np.roll(side[met], -1, axis=1) * corners[met, :, 2]).sum(axis=1) / twice_area
    return int(np.sign(twice_area)[height > point[2]].sum()) > 0


def _with_faces(mesh: Mesh, kept: Int[np.ndarray, "kept"]) -> Mesh:
    """The mesh of some of its faces, and of the vertices that they use."""
    used, faces = np.unique(mesh.faces[kept], return_inverse=True)
    rest = {name: getattr(mesh, name)[used] for name in ("normals", "uvs", "colors") if getattr(mesh, name) is not None}
    faces = faces.reshape(-1, 3).astype(np.int32)
    return replace(mesh, vertices=mesh.vertices[used], faces=faces, face_material=mesh.face_material[kept], **rest)
