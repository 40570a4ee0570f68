"""Meshes of the world's axes (+Z up, front -Y) as files: .glb, .obj with .mtl and .png, .ply with .png, .stl.

What a format cannot say is refused, but for what it has no place for at all: STL has no colours, PLY no transparency.
"""

from __future__ import annotations

import contextlib
import uuid
from dataclasses import replace
from pathlib import Path

import numpy as np

from mv3d_cli.errors import BadMesh, OutputRefused
from mv3d_cli.formats.gltf.writing import glb_bytes
from mv3d_cli.formats.images import png_bytes
from mv3d_cli.formats.meshes.finding import Up, is_y_up
from mv3d_cli.formats.meshes.ply import ply_bytes
from mv3d_cli.formats.meshes.stl import stl_bytes
from mv3d_cli.formats.obj.writing import obj_files
from mv3d_cli.formats.textures import stored_pictures, tinted
from mv3d_cli.scene.conventions import Y_UP_FROM_WORLD
from mv3d_cli.scene.mesh import Material, Mesh, Texture, Wrap, transform

WRITTEN_SUFFIXES = (".glb", ".obj", ".ply", ".stl")
_GLB_HINT = "Write it as .glb, which can say that."


def write_mesh(
    path: Path,
    mesh: Mesh,
    *,
    up: Up = "auto",
    scale: float = 1.0,
    unit: str = "scene unit (unit-sphere radius = 1)",
) -> list[Path]:
    """Write the mesh, its vertices times `scale`, and give the files written, the mesh first; same mesh, same bytes.

    `up` says which axis of the file points upwards (auto: glTF and OBJ +Y, PLY and STL +Z). `unit` names the
    file's unit; both are stated inside the file. Raises OutputRefused for another suffix, a name that a file
    cannot refer to, or a look that the format cannot say; BadMesh for a mesh without a surface.
    """
    if path.suffix.lower() not in WRITTEN_SUFFIXES:
        known = ", ".join(WRITTEN_SUFFIXES)
        raise OutputRefused(f"{path.name} has no suffix of a mesh that we write.", f"End it in one of {known}.")
    if not len(mesh.faces) or not np.isfinite(mesh.vertices).all():
        raise BadMesh("the mesh to write has no face, or vertices that are not finite.", "Make the mesh again.")
    y_up = is_y_up(path, up)
    file_from_world = (Y_UP_FROM_WORLD if y_up else np.eye(4)) @ np.diag([scale, scale, scale, 1.0])
    said = {"unit": unit, "scale": scale, "up": "+Y" if y_up else "+Z"}
    files = _encoded(path, transform(_by_material(mesh), file_from_world), said)
    for name, data in reversed(files.items()):  # a mesh that is there has its pictures
        _put(path.with_name(name), data)
    return [path.with_name(name) for name in files]


def _encoded(path: Path, mesh: Mesh, said: dict[str, str | float]) -> dict[str, bytes]:
    """The files by name, the mesh first."""
    note = f"mv3d, {said['up']} up, scale {said['scale']:g} per scene unit, unit: {said['unit']}"
    match path.suffix.lower():
        case ".glb":
            return {path.name: glb_bytes(mesh, said)}
        case ".stl":
            return {path.name: stl_bytes(mesh, note)}
        case ".obj":
            _check_name(path)
            return obj_files(_with_plain_pictures(mesh, path), path, note)
    return _ply_files(_with_plain_pictures(mesh, path), path, note)


def _ply_files(mesh: Mesh, path: Path, note: str) -> dict[str, bytes]:
    pictures, chosen = stored_pictures(mesh.materials)
    if not pictures:
        return {path.name: ply_bytes(_with_colors(mesh), note, None)}
    _check_name(path)
    if len(pictures) > 1 or None in chosen or (mesh.colors is not None and (mesh.colors[:, :3] < 1).any()):
        raise OutputRefused(f"{path.name}: a PLY has either vertex colours or one picture for all faces.", _GLB_HINT)
    texture = f"{path.stem}.png"
    return {path.name: ply_bytes(mesh, note, texture), texture: png_bytes(pictures[0])}


def _by_material(mesh: Mesh) -> Mesh:
    """The mesh with its faces sorted by material, each vertex in one material's, nothing that is not in use.

    A material's faces and vertices keep their order; without any texture there are no uv.
    """
    order = np.argsort(mesh.face_material, kind="stable")
    used, face_material = np.unique(mesh.face_material[order], return_inverse=True)
    keys = mesh.faces[order] + face_material[:, None].astype(np.int64) * len(mesh.vertices)
    corners, faces = np.unique(keys, return_inverse=True)
    vertices = corners % len(mesh.vertices)
    materials = tuple(mesh.materials[index] for index in used)
    textured = any(material.texture is not None for material in materials)
    return Mesh(
        vertices=mesh.vertices[vertices],
        faces=faces.reshape(-1, 3).astype(np.int32),
        face_material=face_material.astype(np.int32),
        materials=materials,
        normals=None if mesh.normals is None else mesh.normals[vertices],
        uvs=None if mesh.uvs is None or not textured else mesh.uvs[vertices],
        colors=None if mesh.colors is None else mesh.colors[vertices],
    )


def _with_colors(mesh: Mesh) -> Mesh:
    """The mesh with its materials' base colours in its vertices' colours."""
    base = np.array([material.base_color for material in mesh.materials], np.float32)
    colors = np.empty((len(mesh.vertices), 4), np.float32)
    colors[mesh.faces.reshape(-1)] = np.repeat(base[mesh.face_material], 3, axis=0)
    return replace(mesh, colors=colors if mesh.colors is None else colors * mesh.colors, materials=(Material(),))


def _with_plain_pictures(mesh: Mesh, path: Path) -> Mesh:
    """The mesh with pictures that show all of its colour, and that repeat, or clamp where OBJ has to say so."""
    materials = []
    for number, material in enumerate(mesh.materials):
        material = tinted(material)
        if mesh.uvs is not None and (texture := material.texture) is not None:
            uvs = mesh.uvs[mesh.faces[mesh.face_material == number]]
            inside = uvs.min() >= -1e-6 and uvs.max() <= 1 + 1e-6
            wrap: Wrap = "repeat" if inside else texture.wrap_u
            sayable = ("repeat", "clamp") if path.suffix.lower() == ".obj" else ("repeat",)
            if wrap not in sayable or not (inside or wrap == texture.wrap_v):
                raise OutputRefused(f"{path.name}: {path.suffix} cannot say how its texture wraps.", _GLB_HINT)
            material = replace(material, texture=Texture(texture.pixels, wrap, wrap))
        materials.append(material)
    return replace(mesh, materials=tuple(materials))


def _check_name(path: Path) -> None:
    """Raise OutputRefused for a name that would be read as something else where the mesh names its pictures."""
    stem = path.stem
    if not stem.isprintable() or stem != stem.strip(' "') or stem.startswith("-") or any(c in stem for c in "\\#"):
        raise OutputRefused(f"{path.name!r} cannot be the name of a mesh with pictures.", "Use letters and digits.")


def _put(path: Path, data: bytes) -> None:
    """Write a temporary sibling, then rename it."""
    temporary = path.with_name(f".mv3d-{uuid.uuid4().hex[:12]}")
    try:
        temporary.write_bytes(data)
        temporary.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise
