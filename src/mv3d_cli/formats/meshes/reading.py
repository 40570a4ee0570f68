"""Mesh files as meshes in the world's axes (+Z up), in the files' own units."""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32

from mv3d_cli.errors import BadMesh
from mv3d_cli.formats.gltf.container import read_document
from mv3d_cli.formats.gltf.scene import document_sources, scene_mesh
from mv3d_cli.formats.images import check_readable
from mv3d_cli.formats.meshes.finding import SUFFIXES_HINT, MeshFile, Up, is_y_up
from mv3d_cli.formats.meshes.ply import ply_sources, read_ply
from mv3d_cli.formats.meshes.stl import read_stl
from mv3d_cli.formats.obj.reading import obj_sources, read_obj
from mv3d_cli.scene.conventions import WORLD_FROM_Y_UP
from mv3d_cli.scene.mesh import Mesh, transform

_EXPORT_AGAIN = "Open it in a 3D program and export it again, for example as .glb."
_CHUNK = 2**20


def mesh_sources(file: MeshFile) -> list[Path]:
    """All files that `read_mesh` reads and that are there, the mesh first. Raises MissingInput or BadMesh."""
    with _telling_of(file.path):
        match file.path.suffix.lower():
            case ".glb" | ".gltf":
                others = document_sources(read_document(file.path))
            case ".obj":
                others = obj_sources(file.path)
            case ".ply":
                others = ply_sources(file.path)
            case _:
                others = []
    check_readable(file.path)
    return list(dict.fromkeys([file.path, *others]))


def read_mesh(file: MeshFile, up: Up = "auto") -> Mesh:
    """The mesh in the world's axes, in the file's units; faces without area are dropped.

    `up` says which axis of the file points upwards. Raises MissingInput or BadMesh; gives a MeshWarning for what
    of it is not as its author meant it.
    """
    with _telling_of(file.path):
        mesh = _checked(_read(file.path))
        if is_y_up(file.path, up):
            mesh = transform(mesh, WORLD_FROM_Y_UP)
    return mesh


def _read(path: Path) -> Mesh:
    match path.suffix.lower():
        case ".glb" | ".gltf":
            return scene_mesh(read_document(path))
        case ".obj":
            return read_obj(path)
        case ".ply":
            return read_ply(path)
        case ".stl":
            return read_stl(path)
    raise BadMesh("it is not a mesh file that we read.", SUFFIXES_HINT)


@contextlib.contextmanager
def _telling_of(path: Path) -> Iterator[None]:
    """Errors say which file; what a malformed one makes of our readers is an error of the file."""
    try:
        yield
    except BadMesh as error:
        raise BadMesh(f"{path}: {error}", error.hint) from error
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, struct.error) as error:
        raise BadMesh(f"{path} is malformed ({type(error).__name__}: {error}).", _EXPORT_AGAIN) from error
    except MemoryError as error:
        raise BadMesh(f"{path} does not fit into memory.", "Simplify it first.") from error


def _checked(mesh: Mesh) -> Mesh:
    """The mesh without faces that have no area, and without attributes that are not numbers. Raises BadMesh."""
    if not len(mesh.faces):
        raise BadMesh("it has no face; points and lines have no surface.", "Give a mesh of triangles.")
    if not np.isfinite(mesh.vertices).all():
        raise BadMesh("it has vertices that are not finite.", _EXPORT_AGAIN)
    low, high = int(mesh.faces.min()), int(mesh.faces.max())
    if low < 0 or high >= len(mesh.vertices):
        bad = low if low < 0 else high
        raise BadMesh(f"a face refers to vertex {bad} of {len(mesh.vertices)}.", _EXPORT_AGAIN)
    kept = _have_area(mesh)
    if not kept.any():
        raise BadMesh("none of its faces has an area.", "Check the scale and the positions of its vertices.")
    if not kept.all():
        mesh = replace(mesh, faces=mesh.faces[kept], face_material=mesh.face_material[kept])
    uvs, colors = mesh.uvs, mesh.colors
    return replace(
        mesh,
        normals=_unit_normals(mesh),
        uvs=uvs if uvs is None or np.isfinite(uvs).all() else np.nan_to_num(uvs, posinf=0, neginf=0),
        colors=colors if colors is None or np.isfinite(colors).all() else np.nan_to_num(colors, nan=1).clip(0, 1),
    )


def _have_area(mesh: Mesh) -> Bool[np.ndarray, "faces"]:
    """Which faces are more than a line, in float64 and a part at a time: meshes may have millions of faces."""
    kept = np.empty(len(mesh.faces), bool)
    for start in range(0, len(kept), _CHUNK):
        a, b, c = (mesh.vertices[mesh.faces[start : start + _CHUNK, i]].astype(np.float64) for i in range(3))
        first, second = b - a, c - a
        twice_area = np.sqrt((np.cross(first, second) ** 2).sum(axis=1))
        longest = np.maximum((first**2).sum(axis=1), (second**2).sum(axis=1))
        kept[start : start + _CHUNK] = twice_area > 1e-10 * longest
    return kept


def _unit_normals(mesh: Mesh) -> Float32[np.ndarray, "vertices 3"] | None:
    """Normals of length 1; a vertex whose own is not a direction takes that of a face it belongs to."""
    if mesh.normals is None:
        return None
    lengths = np.linalg.norm(mesh.normals, axis=1, keepdims=True)
    bad = ~(np.isfinite(lengths) & (lengths > 1e-12))[:, 0]
    normals = mesh.normals / np.where(bad[:, None], np.float32(1), lengths)
    if bad.any():
        normals[bad] = (0, 0, 1)
        faces = mesh.faces[bad[mesh.faces].any(axis=1)]
        a, b, c = (mesh.vertices[faces[:, i]].astype(np.float64) for i in range(3))
        cross = np.cross(b - a, c - a)
        unit = cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-300)
        for corner in faces.T:
            normals[corner[bad[corner]]] = unit[bad[corner]]
    return normals.astype(np.float32)
