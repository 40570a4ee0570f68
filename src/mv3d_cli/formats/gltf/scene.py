"""Scenes: nodes place meshes; skeletons stand in their rest pose; morph targets are left out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from mv3d_cli.formats.gltf.accessors import floats
from mv3d_cli.formats.gltf.container import Document, uri_path
from mv3d_cli.formats.gltf.materials import image_paths, surface
from mv3d_cli.formats.gltf.primitives import Primitive, primitive, unwelded_flat
from mv3d_cli.formats.textures import TextureFiles
from mv3d_cli.scene.mesh import Material, Mesh, transform

MAX_FACES = 50_000_000
"""A few kilobytes of nodes can ask for any number of copies of a mesh."""


def scene_mesh(document: Document) -> Mesh:
    """The default scene as one mesh in glTF's axes (+Y up); without a face if there is nothing in it.

    Raises BadMesh.
    """
    worlds = world_from_nodes(document)
    loader = _Loader(document)
    parts: list[Mesh] = []
    faces = 0
    for index, world_from_node in worlds.items():
        node = document.item("nodes", index)
        if "mesh" not in node:
            continue
        for slot, part in loader.primitives(node["mesh"]):
            faces += len(part.mesh.faces)
            if faces > MAX_FACES:
                raise document.bad(f"it has more than {MAX_FACES // 10**6} million faces", "Simplify it first.")
            if "skin" in node and part.joints is not None:
                placed = _posed(document, part, _joint_transforms(document, node["skin"], worlds))
            else:
                placed = transform(part.mesh, world_from_node)
            parts.append(_with_material(placed, slot))
    return merged(parts, tuple(loader.materials))


def document_sources(document: Document) -> list[Path]:
    """The files beside it that a document reads and that are there. Raises BadMesh for one outside its folder."""
    uris = [buffer["uri"] for buffer in document.json.get("buffers", []) if "uri" in buffer]
    buffers = [uri_path(document, uri) for uri in uris if not uri.startswith("data:")]
    return [path for path in (*buffers, *image_paths(document)) if path.is_file()]


def world_from_nodes(document: Document) -> dict[int, Float[np.ndarray, "4 4"]]:
    """Where each node of the default scene stands, in the scene's order.

    Raises BadMesh where nodes form anything but trees.
    """
    worlds: dict[int, Float[np.ndarray, "4 4"]] = {}
    waiting = [(index, np.eye(4)) for index in reversed(_roots(document))]
    while waiting:
        index, world_from_parent = waiting.pop()
        node = document.item("nodes", index)
        if index in worlds:
            raise document.bad(f"its nodes form a cycle, or node {index} has two parents")
        worlds[index] = world_from_parent @ _local(document, node)
        waiting += [(child, worlds[index]) for child in reversed(node.get("children", []))]
    return worlds


def merged(parts: list[Mesh], materials: tuple[Material, ...]) -> Mesh:
    """One mesh of many; where only some have an attribute, the others get its neutral value."""
    if any(part.normals is not None for part in parts):
        parts = [unwelded_flat(part) if part.normals is None else part for part in parts]
    sizes = [len(part.vertices) for part in parts]
    starts = np.cumsum([0, *sizes])[:-1].astype(np.int32)

    def joined(name: str, neutral: tuple[float, ...]) -> Float32[np.ndarray, "vertices _"] | None:
        arrays = [getattr(part, name) for part in parts]
        if all(array is None for array in arrays):
            return None
        blank = np.array(neutral, np.float32)
        filled = [np.tile(blank, (n, 1)) if a is None else a for a, n in zip(arrays, sizes, strict=True)]
        return np.concatenate(filled)

    nothing = np.zeros((0, 3), np.float32)
    faces = [part.faces + start for part, start in zip(parts, starts, strict=True)]
    return Mesh(
        vertices=np.concatenate([nothing, *(part.vertices for part in parts)]),
        faces=np.concatenate([nothing.astype(np.int32), *faces]),
        face_material=np.concatenate([np.zeros(0, np.int32), *(part.face_material for part in parts)]),
        materials=materials,
        normals=joined("normals", (0.0, 0.0, 0.0)),
        uvs=joined("uvs", (0.0, 0.0)),
        colors=joined("colors", (1.0, 1.0, 1.0, 1.0)),
    )


class _Loader:
    """Reads each mesh and each material of a document once, and numbers the materials as they come."""

    def __init__(self, document: Document):
        self.document = document
        self.files = TextureFiles(document.path)
        self.surfaces: dict[Any, Any] = {}
        self.slots: dict[Any, int] = {}
        self.materials: list[Material] = []
        self.meshes: dict[int, list[tuple[int, Primitive]]] = {}

    def primitives(self, index: int) -> list[tuple[int, Primitive]]:
        """The (material's number, primitive) pairs of a mesh."""
        if index not in self.meshes:
            items = self.document.item("meshes", index)["primitives"]
            read = [(self._slot(item), primitive(self.document, item, self._surface(item))) for item in items]
            self.meshes[index] = [(slot, part) for slot, part in read if part is not None]
        return self.meshes[index]

    def _surface(self, item: dict[str, Any]):
        return self.surfaces[item.get("material")]

    def _slot(self, item: dict[str, Any]) -> int:
        key = item.get("material")
        if key not in self.surfaces:
            self.surfaces[key] = surface(self.document, key, self.files)
            self.slots[key] = len(self.materials)
            self.materials.append(self.surfaces[key].material)
        return self.slots[key]


def _with_material(mesh: Mesh, slot: int) -> Mesh:
    numbers = np.full(len(mesh.faces), slot, np.int32)
    return Mesh(mesh.vertices, mesh.faces, numbers, mesh.materials, mesh.normals, mesh.uvs, mesh.colors)


def _roots(document: Document) -> list[int]:
    scenes = document.json.get("scenes")
    if scenes:
        return document.item("scenes", document.json.get("scene", 0)).get("nodes", [])
    nodes = document.json.get("nodes", [])
    children = {child for node in nodes for child in node.get("children", [])}
    return [index for index in range(len(nodes)) if index not in children]


def _local(document: Document, node: dict[str, Any]) -> Float[np.ndarray, "4 4"]:
    """parent_from_node: a column-major matrix, or translation * rotation * scale."""
    if "matrix" in node:
        matrix = np.array(node["matrix"], np.float64)
        if matrix.shape != (16,):
            raise document.bad("a node's matrix does not hold 16 numbers")
        return matrix.reshape(4, 4).T
    x, y, z, w = np.array(node.get("rotation", (0, 0, 0, 1)), np.float64)
    s = 2 / max(x * x + y * y + z * z + w * w, 1e-300)
    rotation = np.array(
        [
            [1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)],
            [s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)],
            [s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)],
        ]
    )
    local = np.eye(4)
    local[:3, :3] = rotation * np.array(node.get("scale", (1, 1, 1)), np.float64)
    local[:3, 3] = node.get("translation", (0, 0, 0))
    return local


def _joint_transforms(
    document: Document, skin: int, worlds: dict[int, Float[np.ndarray, "4 4"]]
) -> Float[np.ndarray, "joints 4 4"]:
    """world_from_bind of a skin's joints, where its nodes stand at rest."""
    item = document.item("skins", skin)
    stands = np.stack([worlds.get(joint, np.eye(4)) for joint in item["joints"]])
    if "inverseBindMatrices" not in item:
        return stands
    inverse_bind = floats(document, item["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
    return stands @ inverse_bind[: len(stands)]


def _posed(document: Document, part: Primitive, joints: Float[np.ndarray, "joints 4 4"]) -> Mesh:
    """Linear blend skinning: a skinned mesh stands where its joints do, wherever its own node is."""
    assert part.joints is not None
    assert part.weights is not None
    mesh = part.mesh
    if part.joints.size and part.joints.max() >= len(joints):
        raise document.bad(f"a vertex is moved by joint {part.joints.max()} of {len(joints)}")
    vertices, normals = np.zeros_like(mesh.vertices), None
    if mesh.normals is not None:
        normals = np.zeros_like(mesh.normals)
    for influence in range(part.joints.shape[1]):
        chosen = joints[part.joints[:, influence], :3].astype(np.float32)
        weight = part.weights[:, influence, None]
        moved = np.einsum("vij,vj->vi", chosen[:, :, :3], mesh.vertices) + chosen[:, :, 3]
        vertices += weight * moved
        if normals is not None and mesh.normals is not None:
            normals += weight * np.einsum("vij,vj->vi", chosen[:, :, :3], mesh.normals)
    return Mesh(vertices, mesh.faces, mesh.face_material, mesh.materials, normals, mesh.uvs, mesh.colors)
