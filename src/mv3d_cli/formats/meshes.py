"""Mesh files: where they are, what they read, and their triangles in the world's axes (+Z up), in their own units.

glTF and OBJ are +Y up, PLY and STL +Z up, as Blender's importers take them; the OBJ files of the Google Scanned
Objects (NAME/meshes/model.obj, NAME/materials/textures/texture.png) are +Z up.
"""

from __future__ import annotations

import contextlib
import os
import re
import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float32

from mv3d_cli.errors import BadMesh, MissingInput
from mv3d_cli.formats.gltf.container import read_document
from mv3d_cli.formats.gltf.scene import document_sources, scene_mesh
from mv3d_cli.formats.images import check_readable
from mv3d_cli.formats.obj.reading import obj_sources, read_obj
from mv3d_cli.formats.textures import GREY_MATERIAL, MeshWarning
from mv3d_cli.scene.conventions import WORLD_FROM_Y_UP, linear_from_srgb
from mv3d_cli.scene.mesh import Material, Mesh, transform

__all__ = ["SUFFIXES", "MeshFile", "MeshWarning", "Up", "find_meshes", "mesh_sources", "read_mesh"]

SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl")
Up = Literal["auto", "y", "z"]

_HINT = f"Meshes are {', '.join(suffix[1:] for suffix in SUFFIXES)} files, or folders of them."
_EXPORT_AGAIN = "Open it in a 3D program and export it again, for example as .glb."
_CHUNK = 2**20


@dataclass(frozen=True)
class MeshFile:
    """A mesh on disk; `name` is distinct among those found together and can be a file name."""

    name: str
    path: Path


def find_meshes(path: Path) -> list[MeshFile]:
    """The mesh at `path`, or all below it, sorted by name; hidden folders are passed over.

    A mesh is called after its path below `path` (`a/b.glb`: a__b), with its suffix where two would be called the
    same; a Google Scanned Object after its folder. Raises MissingInput where there is none.
    """
    if path.is_file():
        if path.suffix.lower() not in SUFFIXES:
            raise MissingInput(f"{path} is not a mesh file that we read.", _HINT)
        return [MeshFile(_plain(_object_folder(path).name if _is_scanned(path) else path.stem), path)]
    if not path.is_dir():
        raise MissingInput(f"there is no file or folder {path}.", "Check the path.")
    files = list(_files_below(path))
    if not files:
        raise MissingInput(f"there is no mesh in {path}.", _HINT)
    stems = {file: _name_below(path, file) for file in files}
    shared = Counter(name.casefold() for name in stems.values())
    named = [(f"{n}_{f.suffix[1:]}" if shared[n.casefold()] > 1 else n, f) for f, n in stems.items()]
    taken: set[str] = set()
    found = []
    for name, file in sorted(named):
        while name.casefold() in taken:
            name += "_"
        taken.add(name.casefold())
        found.append(MeshFile(name, file))
    return found


def mesh_sources(file: MeshFile) -> list[Path]:
    """All files that `read_mesh` reads and that are there, the mesh first. Raises MissingInput or BadMesh."""
    with _telling_of(file.path):
        match file.path.suffix.lower():
            case ".glb" | ".gltf":
                others = document_sources(read_document(file.path))
            case ".obj":
                others = obj_sources(file.path)
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
        if up == "y" or (up == "auto" and _is_y_up(file.path)):
            mesh = transform(mesh, WORLD_FROM_Y_UP)
    return mesh


def _read(path: Path) -> Mesh:
    match path.suffix.lower():
        case ".glb" | ".gltf":
            return scene_mesh(read_document(path))
        case ".obj":
            return read_obj(path)
        case ".ply":
            return _read_ply(path)
        case ".stl":
            return _read_stl(path)
    raise BadMesh("it is not a mesh file that we read.", _HINT)


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


def _read_ply(path: Path) -> Mesh:
    from trimesh.exchange.ply import load_ply

    check_readable(path)
    with path.open("rb") as stream:
        try:
            read: dict[str, Any] = load_ply(stream, fix_texture=False, skip_materials=True)
        except OSError as error:  # it seeks to wherever the header says
            raise BadMesh(f"it is truncated or damaged: {error}.", "Copy or export the file again.") from error
    faces = read.get("faces")
    if faces is None or not len(faces):
        raise BadMesh("it has no face; points and lines have no surface.", "Give a mesh of triangles.")
    declared = read["metadata"]["_ply_raw"]
    if len(read["vertices"]) < declared["vertex"]["length"] or len(faces) < declared["face"]["length"]:
        raise BadMesh("it is truncated.", "Copy or export the file again.")
    mesh = _plain_mesh(read["vertices"], np.asarray(faces))
    if (normals := read.get("vertex_normals")) is not None:
        mesh = replace(mesh, normals=normals.astype(np.float32))
    if (colors := read.get("vertex_colors")) is not None:
        return replace(mesh, colors=_linear_rgba(colors), materials=(Material(),))
    if (colors := read.get("face_colors")) is not None and len(colors) == len(faces):
        corners = mesh.faces.reshape(-1)
        colors = np.tile(colors, (len(mesh.faces) // len(faces), 1))  # each quad became two faces
        return replace(
            mesh,
            vertices=mesh.vertices[corners],
            faces=np.arange(len(corners), dtype=np.int32).reshape(-1, 3),
            normals=None if mesh.normals is None else mesh.normals[corners],
            colors=np.repeat(_linear_rgba(colors), 3, axis=0),
            materials=(Material(),),
        )
    return mesh


def _read_stl(path: Path) -> Mesh:
    from trimesh.exchange.stl import load_stl

    check_readable(path)
    with path.open("rb") as stream:
        read: dict[str, Any] = load_stl(stream)
    solids = list(read["geometry"].values()) if "geometry" in read else [read]
    if not solids:
        raise BadMesh("it has no face.", "Give a mesh of triangles.")
    vertices = np.concatenate([solid["vertices"] for solid in solids])
    return _plain_mesh(vertices, np.arange(len(vertices)).reshape(-1, 3))


def _plain_mesh(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    """A grey mesh of vertices [n, 3] and triangles or quads [m, 3 or 4]."""
    if faces.shape[1] == 4:
        faces = np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])
    if faces.max() >= len(vertices) or faces.min() < 0:
        raise BadMesh(f"a face refers to vertex {faces.max()} of {len(vertices)}.", _EXPORT_AGAIN)
    material = np.zeros(len(faces), np.int32)
    return Mesh(vertices.astype(np.float32), faces.astype(np.int32), material, (GREY_MATERIAL,))


def _linear_rgba(colors: np.ndarray) -> Float32[np.ndarray, "rows 4"]:
    """Linear RGBA from sRGB [rows, 3 or 4]: integers of their type's range, or numbers in [0, 1]."""
    largest = np.iinfo(colors.dtype).max if colors.dtype.kind in "iu" else 1
    rgba = np.ones((len(colors), 4), np.float32)
    rgba[:, : colors.shape[1]] = (colors / largest).clip(0, 1)
    rgba[:, :3] = linear_from_srgb(rgba[:, :3])
    return rgba


def _files_below(folder: Path) -> Iterator[Path]:
    for parent, folders, names in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith((".", "__MACOSX")))
        for name in sorted(names):
            if not name.startswith(".") and name.lower().endswith(SUFFIXES):
                yield Path(parent, name)


def _name_below(root: Path, file: Path) -> str:
    if _is_scanned(file):
        place = _object_folder(file)
        below = Path(os.path.relpath(place, root)).parts
        named = list(below) if below and below[0] != ".." else [place.name]
    else:
        named = [*file.relative_to(root).parts[:-1], file.stem]
    return _plain("__".join(named))


def _plain(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_.-]", "_", name).lstrip(".-") or "mesh"


def _object_folder(file: Path) -> Path:
    return Path(os.path.abspath(file)).parent.parent


def _is_scanned(file: Path) -> bool:
    """Whether the file lies as in the archives of the Google Scanned Objects."""
    place = Path(os.path.abspath(file))
    return (
        place.name.lower() == "model.obj"
        and place.parent.name == "meshes"
        and (place.parent.parent / "materials" / "textures").is_dir()
    )


def _is_y_up(file: Path) -> bool:
    return file.suffix.lower() in (".glb", ".gltf", ".obj") and not _is_scanned(file)
