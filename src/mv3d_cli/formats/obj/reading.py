"""An OBJ file as a mesh: one vertex per distinct (vertex, texture vertex, normal)."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int32, Int64

from mv3d_cli.errors import BadMesh
from mv3d_cli.formats.images import check_readable
from mv3d_cli.formats.obj.materials import (
    Entry,
    laid,
    library_paths,
    material,
    read_library,
    texture_path,
)
from mv3d_cli.formats.obj.statements import Statements, library_names, read_statements
from mv3d_cli.formats.textures import GREY_MATERIAL, TextureFiles
from mv3d_cli.scene.conventions import linear_from_srgb
from mv3d_cli.scene.mesh import Material, Mesh


def read_obj(path: Path) -> Mesh:
    """The mesh in the file's own axes. Raises MissingInput or BadMesh; warns of what materials lack."""
    files = TextureFiles(path)
    sources = obj_sources(path)
    with ThreadPoolExecutor(1) as beside, path.open("rb") as stream:
        files.decode_ahead((source for source in sources if source.suffix.lower() != ".mtl"), beside)
        said = read_statements(stream)
        _check_corners(said)
        entries = _entries(path, said, files)
        materials = [_material(path, name, said, entries, files) for name in said.material_names]
    face_material = said.face_material
    if not said.face_material.size or said.face_material.min() < 0:
        materials.append(GREY_MATERIAL if said.colors is None else Material())
        face_material = np.where(face_material < 0, np.int32(len(materials) - 1), face_material)
    maps = [entries[name].map_color if name in entries else None for name in said.material_names]
    texcoords, corners = said.texcoords, said.corners
    for number, placed in enumerate(maps):
        if placed is not None and (placed.scale, placed.offset) != ((1, 1), (0, 0)):
            corners = corners.copy()
            corners[..., 1] += np.where((face_material == number)[:, None] & (corners[..., 1] >= 0), len(texcoords), 0)
            texcoords = np.concatenate([texcoords, laid(said.texcoords, placed)])
    return _welded(said, corners, texcoords, face_material, tuple(materials))


def obj_sources(path: Path) -> list[Path]:
    """The material libraries and colour pictures that the mesh reads. Raises MissingInput or BadMesh."""
    check_readable(path)
    with path.open("rb") as stream:
        libraries = [library for _, library in library_paths(path, library_names(stream)) if library]
    entries = [entry for library in libraries for entry in read_library(library).values()]
    pictures = [picture for entry in entries if (picture := texture_path(path, entry))]
    return [*libraries, *pictures]


def _check_corners(said: Statements) -> None:
    tables = {"vertices": said.vertices, "texture vertices": said.texcoords, "normals": said.normals}
    for part, (name, table) in enumerate(tables.items()):
        if said.corners.size and (largest := said.corners[..., part].max()) >= len(table):
            raise BadMesh(f"a face refers to number {largest + 1} of {len(table)} {name}.", "Export the mesh again.")


def _entries(path: Path, said: Statements, files: TextureFiles) -> dict[str, Entry]:
    entries: dict[str, Entry] = {}
    for name, library in library_paths(path, said.libraries):
        if library is None:
            files.warn(f"the material library {name} is not there; its materials are grey.")
        else:
            entries = read_library(library) | entries
    return entries


def _material(path: Path, name: str, said: Statements, entries: dict[str, Entry], files: TextureFiles) -> Material:
    if name in entries:
        return material(path, name, entries[name], files)
    if all(library for _, library in library_paths(path, said.libraries)):  # else that was said already
        files.warn(f"material {name} is in no library; it is replaced by grey.")
    return GREY_MATERIAL


def _welded(
    said: Statements,
    corners: Int32[np.ndarray, "faces 3 3"],
    texcoords: Float32[np.ndarray, "texcoords 2"],
    face_material: Int32[np.ndarray, "faces"],
    materials: tuple[Material, ...],
) -> Mesh:
    """One vertex per distinct corner; v is turned to run downwards."""
    textured = len(texcoords) > 0 and any(material.texture for material in materials)
    shaded = len(said.normals) > 0 and bool((corners[..., 2] >= 0).all())
    vertex, faces = _distinct(corners, textured, shaded)
    uvs = None
    if textured:
        with_blank = np.concatenate([texcoords, np.zeros((1, 2), np.float32)])
        uvs = with_blank[vertex[:, 1]]
        uvs[:, 1] = 1 - uvs[:, 1]
    return Mesh(
        vertices=said.vertices[vertex[:, 0]],
        faces=faces,
        face_material=face_material.astype(np.int32),
        materials=materials,
        normals=said.normals[vertex[:, 2]] if shaded else None,
        uvs=uvs,
        colors=None if said.colors is None else _linear_rgba(said.colors[vertex[:, 0]]),
    )


def _distinct(
    corners: Int32[np.ndarray, "faces 3 3"], textured: bool, shaded: bool
) -> tuple[Int32[np.ndarray, "distinct 3"], Int32[np.ndarray, "faces 3"]]:
    """The distinct corners, and the faces that index them; parts that are not asked for do not count."""
    flat = corners.reshape(-1, 3)
    parts = [0] + [1] * textured + [2] * shaded
    if all((flat[:, part] == flat[:, 0]).all() for part in parts) and len(flat):  # as scans are written
        alike = np.repeat(np.arange(flat[:, 0].max() + 1, dtype=np.int32)[:, None], 3, axis=1)
        return alike, flat[:, 0].reshape(-1, 3)
    number = flat[:, 0].astype(np.int64)
    for part in parts[1:]:
        number = _combined(number, flat[:, part].astype(np.int64))
    _, first, inverse = np.unique(number, return_index=True, return_inverse=True)
    return flat[first], inverse.astype(np.int32).reshape(-1, 3)


def _combined(a: Int64[np.ndarray, "corners"], b: Int64[np.ndarray, "corners"]) -> Int64[np.ndarray, "corners"]:
    """One number per pair of (a from 0, b from -1), brought down to ranks where the product would not fit."""
    span = int(b.max(initial=0)) + 2
    if int(a.max(initial=0)) > 2**62 // span:
        a = np.unique(a, return_inverse=True)[1]
    return a * span + b + 1


def _linear_rgba(colors: Float32[np.ndarray, "vertices 3"]) -> Float32[np.ndarray, "vertices 4"]:
    rgba = np.ones((len(colors), 4), np.float32)
    rgba[:, :3] = linear_from_srgb(colors.clip(0, 1))
    return rgba
