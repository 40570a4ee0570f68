"""Primitives: the triangles of one material, in their node's axes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float32, Int64, Shaped

from mv3d_cli.formats.gltf.accessors import elements, floats, indices, normalised
from mv3d_cli.formats.gltf.container import Document, view_bytes
from mv3d_cli.formats.gltf.materials import Surface, transformed
from mv3d_cli.scene.mesh import Mesh

_TRIANGLES, _STRIP, _FAN = 4, 5, 6


@dataclass(frozen=True)
class Primitive:
    """A mesh of one material and, where a skeleton moves it, the joints and weights of its vertices."""

    mesh: Mesh
    joints: Int64[np.ndarray, "vertices influences"] | None = None
    weights: Float32[np.ndarray, "vertices influences"] | None = None


def primitive(document: Document, item: dict[str, Any], surface: Surface) -> Primitive | None:
    """One primitive, its faces' material numbered 0; None for points and lines. Raises BadMesh."""
    mode = item.get("mode", _TRIANGLES)
    if mode not in (_TRIANGLES, _STRIP, _FAN) or "POSITION" not in item["attributes"]:
        return None
    attributes, corners = _attributes(document, item)
    positions = attributes["POSITION"]
    count = len(positions)
    if not np.isfinite(positions).all():
        raise document.bad("it has vertices that are not finite")
    faces = _triangles(mode, np.arange(count) if corners is None else corners)
    if faces.size and (faces.max() >= count or faces.min() < 0):
        raise document.bad(f"a face refers to vertex {faces.max()} of {count}")
    for name, width in (("POSITION", 3), ("NORMAL", 3), *((f"TEXCOORD_{i}", 2) for i in range(8))):
        if name in attributes and attributes[name].shape != (count, width):
            raise document.bad(f"{name} does not hold {width} numbers for each of {count} vertices")
    uvs = attributes.get(f"TEXCOORD_{surface.texcoord}") if surface.material.texture else None
    mesh = Mesh(
        vertices=positions,
        faces=faces.astype(np.int32),
        face_material=np.zeros(len(faces), np.int32),
        materials=(surface.material,),
        normals=attributes.get("NORMAL"),
        uvs=None if uvs is None else transformed(uvs, surface.uv_from_texcoord),
        colors=_rgba(attributes.get("COLOR_0"), document, count),
    )
    return Primitive(mesh, *_influences(document, item, attributes))


def unwelded_flat(mesh: Mesh) -> Mesh:
    """The mesh with three vertices per face and the faces' normals, which glTF asks for where it has none."""
    corners = mesh.faces.reshape(-1)
    vertices = mesh.vertices[corners]
    a, b, c = vertices[0::3], vertices[1::3], vertices[2::3]
    cross = np.cross(b - a, c - a)
    unit = cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), np.float32(1e-38))
    return Mesh(
        vertices=vertices,
        faces=np.arange(len(corners), dtype=np.int32).reshape(-1, 3),
        face_material=mesh.face_material,
        materials=mesh.materials,
        normals=np.repeat(unit, 3, axis=0).astype(np.float32),
        uvs=None if mesh.uvs is None else mesh.uvs[corners],
        colors=None if mesh.colors is None else mesh.colors[corners],
    )


def _attributes(
    document: Document, item: dict[str, Any]
) -> tuple[dict[str, Float32[np.ndarray, "_ _"]], Int64[np.ndarray, "corners"] | None]:
    """The attributes as numbers, and the indices of the corners, if there are any."""
    compressed = item.get("extensions", {}).get("KHR_draco_mesh_compression")
    if compressed is None:
        attributes = {name: floats(document, index) for name, index in item["attributes"].items() if _used(name)}
        return attributes, indices(document, item["indices"]) if "indices" in item else None
    import DracoPy

    try:
        decoded = DracoPy.decode(bytes(view_bytes(document, compressed["bufferView"])))
        faces = np.asarray(decoded.faces).reshape(-1).astype(np.int64)
        held = {name: decoded.get_attribute_by_unique_id(i) for name, i in compressed["attributes"].items()}
    except (DracoPy.FileTypeException, AttributeError, ValueError) as error:
        raise document.bad(f"its Draco data cannot be decoded: {error}") from error
    attributes = {}
    for name, index in item["attributes"].items():
        if _used(name) and (attribute := held.get(name)):
            scaled = bool(document.item("accessors", index).get("normalized"))
            attributes[name] = normalised(np.asarray(attribute["data"]), scaled)
    if "POSITION" not in attributes:
        raise document.bad("its Draco data holds no positions")
    return attributes, faces


def _used(name: str) -> bool:
    return name in ("POSITION", "NORMAL", "COLOR_0") or name.startswith("TEXCOORD_")


def _triangles(mode: int, corners: Int64[np.ndarray, "corners"]) -> Int64[np.ndarray, "faces 3"]:
    """Three corners per face, from a list, a strip (every other face is turned) or a fan."""
    if mode == _TRIANGLES:
        return corners[: len(corners) // 3 * 3].reshape(-1, 3)
    first = np.arange(max(len(corners) - 2, 0))
    if mode == _FAN:
        return corners[np.stack([first + 1, first + 2, np.zeros_like(first)], axis=1)]
    odd = first % 2
    return corners[np.stack([first, first + 1 + odd, first + 2 - odd], axis=1)]


def _rgba(
    colors: Float32[np.ndarray, "vertices channels"] | None, document: Document, count: int
) -> Float32[np.ndarray, "vertices 4"] | None:
    if colors is None:
        return None
    if colors.shape not in ((count, 3), (count, 4)):
        raise document.bad("COLOR_0 is neither RGB nor RGBA for each vertex")
    rgba = np.ones((count, 4), np.float32)
    rgba[:, : colors.shape[1]] = colors.clip(0, 1)
    return rgba


def _influences(
    document: Document, item: dict[str, Any], attributes: dict[str, Shaped[np.ndarray, "_ _"]]
) -> tuple[Int64[np.ndarray, "vertices influences"] | None, Float32[np.ndarray, "vertices influences"] | None]:
    """The joints that move each vertex, and their weights, which sum to 1."""
    names = item["attributes"]
    sets = [i for i in range(4) if f"JOINTS_{i}" in names and f"WEIGHTS_{i}" in names]
    if not sets or "KHR_draco_mesh_compression" in item.get("extensions", {}):
        return None, None
    joints = np.concatenate([elements(document, names[f"JOINTS_{i}"]).astype(np.int64) for i in sets], axis=1)
    weights = np.concatenate([floats(document, names[f"WEIGHTS_{i}"]) for i in sets], axis=1)
    if joints.shape != weights.shape or len(joints) != len(attributes["POSITION"]):
        raise document.bad("JOINTS and WEIGHTS do not match its vertices")
    return joints, weights / np.maximum(weights.sum(axis=1, keepdims=True), 1e-12).astype(np.float32)
