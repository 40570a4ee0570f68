"""PLY: triangles with vertex colours (sRGB) or one picture, named by the comment `TextureFile` (v upwards).

A file with both shows its picture, as in MeshLab. Written as binary, little endian.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from mv3d_cli.errors import BadMesh
from mv3d_cli.formats.images import check_readable
from mv3d_cli.formats.obj.materials import find_file
from mv3d_cli.formats.textures import GREY_MATERIAL, TextureFiles
from mv3d_cli.scene.conventions import linear_from_srgb, srgb_from_linear
from mv3d_cli.scene.mesh import Material, Mesh, Texture

_EXPORT_AGAIN = "Open it in a 3D program and export it again, for example as .glb."
_TEXTURE_COMMENT = re.compile(rb"^comment\s+TextureFile\s+(.+?)\s*$", re.IGNORECASE | re.MULTILINE)
_LONGEST_HEADER = 2**16
_TEXCOORDS = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))


def read_ply(path: Path) -> Mesh:
    """The mesh in the file's own axes, grey where it says no colour. Raises MissingInput or BadMesh."""
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
    if (textured := _textured(path, mesh, declared["vertex"])) is not None:
        return textured
    if (colors := read.get("vertex_colors")) is not None:
        return replace(mesh, colors=_linear_rgba(colors), materials=(Material(),))
    if (colors := read.get("face_colors")) is not None and len(colors) == len(faces):
        return _with_face_colors(mesh, np.tile(colors, (len(mesh.faces) // len(faces), 1)))  # quads became two faces
    return mesh


def ply_sources(path: Path) -> list[Path]:
    """The picture that the mesh reads, if it is there. Raises MissingInput."""
    name = _texture_name(path)
    found = find_file(path, path.parent, name) if name is not None else None
    return [] if found is None else [found]


def ply_bytes(mesh: Mesh, note: str, texture: str | None) -> bytes:
    """The mesh in its own axes, a comment, and the name of its picture if it has one."""
    columns = [(name, "f4", mesh.vertices[:, i]) for i, name in enumerate("xyz")]
    if mesh.normals is not None:
        columns += [(name, "f4", mesh.normals[:, i]) for i, name in enumerate(("nx", "ny", "nz"))]
    if texture is not None and mesh.uvs is not None:
        columns += [("s", "f4", mesh.uvs[:, 0]), ("t", "f4", 1 - mesh.uvs[:, 1])]
    elif mesh.colors is not None:
        rgba = mesh.colors.clip(0, 1)
        srgb = np.concatenate([srgb_from_linear(rgba[:, :3]), rgba[:, 3:]], axis=1)
        columns += [(n, "u1", np.round(srgb[:, i] * 255)) for i, n in enumerate(("red", "green", "blue", "alpha"))]
    vertices = np.empty(len(mesh.vertices), [(name, f"<{kind}") for name, kind, _ in columns])
    for name, _, values in columns:
        vertices[name] = values
    faces = np.empty(len(mesh.faces), [("corners", "u1"), ("vertices", "<i4", 3)])
    faces["corners"], faces["vertices"] = 3, mesh.faces
    kinds = {"f4": "float", "u1": "uchar"}
    header = ["ply", "format binary_little_endian 1.0", f"comment {note}"]
    header += [f"comment TextureFile {texture}"] * (texture is not None)
    header += [f"element vertex {len(vertices)}", *(f"property {kinds[kind]} {name}" for name, kind, _ in columns)]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    return "\n".join(header).encode() + vertices.tobytes() + faces.tobytes()


def _texture_name(path: Path) -> str | None:
    check_readable(path)
    with path.open("rb") as stream:
        header = stream.read(_LONGEST_HEADER).partition(b"end_header")[0]
    found = _TEXTURE_COMMENT.search(header)
    return found and found[1].decode("utf-8", errors="replace")


def _textured(path: Path, mesh: Mesh, vertex: dict[str, Any]) -> Mesh | None:
    """The mesh with its picture; None where it names none, or has no texture coordinates for its vertices."""
    name = _texture_name(path)
    names = next((pair for pair in _TEXCOORDS if set(pair) <= set(vertex["properties"])), None)
    if name is None or names is None:
        return None
    source = find_file(path, path.parent, name)
    pixels = TextureFiles(path).pixels(name, source, name)
    if pixels is None:
        return None
    u, v = (np.asarray(vertex["data"][name], np.float32).reshape(-1) for name in names)
    return replace(mesh, uvs=np.stack([u, 1 - v], axis=1), materials=(Material(texture=Texture(pixels)),))


def _plain_mesh(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    """A grey mesh of vertices [n, 3] and triangles or quads [m, 3 or 4]."""
    if faces.shape[1] == 4:
        faces = np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])
    if faces.max() >= len(vertices) or faces.min() < 0:
        raise BadMesh(f"a face refers to vertex {faces.max()} of {len(vertices)}.", _EXPORT_AGAIN)
    material = np.zeros(len(faces), np.int32)
    return Mesh(vertices.astype(np.float32), faces.astype(np.int32), material, (GREY_MATERIAL,))


def _with_face_colors(mesh: Mesh, colors: np.ndarray) -> Mesh:
    """The mesh with three vertices per face, all of the face's colour [faces, 3 or 4]."""
    corners = mesh.faces.reshape(-1)
    return replace(
        mesh,
        vertices=mesh.vertices[corners],
        faces=np.arange(len(corners), dtype=np.int32).reshape(-1, 3),
        normals=None if mesh.normals is None else mesh.normals[corners],
        colors=np.repeat(_linear_rgba(colors), 3, axis=0),
        materials=(Material(),),
    )


def _linear_rgba(colors: np.ndarray) -> Float32[np.ndarray, "rows 4"]:
    """Linear RGBA from sRGB [rows, 3 or 4]: integers of their type's range, or numbers in [0, 1]."""
    largest = np.iinfo(colors.dtype).max if colors.dtype.kind in "iu" else 1
    rgba = np.ones((len(colors), 4), np.float32)
    rgba[:, : colors.shape[1]] = (colors / largest).clip(0, 1)
    rgba[:, :3] = linear_from_srgb(rgba[:, :3])
    return rgba
