"""A mesh as a .glb: one node, one primitive per material, no extension; every picture inside it as PNG."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Shaped

from mv3d_cli.formats.gltf.container import BINARY_CHUNK, JSON_CHUNK
from mv3d_cli.formats.images import png_bytes
from mv3d_cli.formats.textures import stored_pictures
from mv3d_cli.scene.mesh import Material, Mesh

_VERTEX_DATA, _INDICES = 34962, 34963
_LINEAR, _LINEAR_MIPMAP_LINEAR = 9729, 9987
_WRAPS = {"clamp": 33071, "mirror": 33648, "repeat": 10497}
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
_COMPONENTS = {np.dtype(np.uint16): 5123, np.dtype(np.uint32): 5125, np.dtype(np.float32): 5126}


@dataclass
class _Content:
    """The lists of a document as they grow; `blocks` are the binary chunk, each a multiple of 4 bytes."""

    blocks: list[bytes] = field(default_factory=list)
    size: int = 0
    views: list[dict[str, Any]] = field(default_factory=list)
    accessors: list[dict[str, Any]] = field(default_factory=list)
    samplers: list[dict[str, Any]] = field(default_factory=list)
    textures: list[dict[str, Any]] = field(default_factory=list)


def glb_bytes(mesh: Mesh, extras: dict[str, Any]) -> bytes:
    """A mesh in glTF's axes, whose vertices have one material each and whose faces are sorted by material.

    `extras` are said of the asset and of the node, because importers keep one or the other.
    """
    content = _Content()
    primitives = [_primitive(content, mesh, index) for index in range(len(mesh.materials))]
    pictures, chosen = stored_pictures(mesh.materials)
    images = [{"bufferView": _view(content, png_bytes(pixels)), "mimeType": "image/png"} for pixels in pictures]
    materials = [_material(content, *pair) for pair in zip(mesh.materials, chosen, strict=True)]
    document = {
        "asset": {"version": "2.0", "generator": "mv3d", "extras": extras},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "object", "extras": extras}],
        "meshes": [{"primitives": primitives, "name": "object"}],
        "materials": materials,
        "textures": content.textures,
        "samplers": content.samplers,
        "images": images,
        "accessors": content.accessors,
        "bufferViews": content.views,
        "buffers": [{"byteLength": content.size}],
    }
    present = {key: value for key, value in document.items() if value != []}  # an empty list is not glTF
    text = json.dumps(present, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    chunks = [struct.pack("<II", len(text), JSON_CHUNK), text, struct.pack("<II", content.size, BINARY_CHUNK)]
    length = 12 + sum(map(len, chunks)) + content.size
    return b"".join([struct.pack("<4sII", b"glTF", 2, length), *chunks, *content.blocks])


def _primitive(content: _Content, mesh: Mesh, index: int) -> dict[str, Any]:
    """The faces of material `index`, with their own vertices."""
    start, end = np.searchsorted(mesh.face_material, [index, index + 1])
    faces = mesh.faces[start:end]
    first, last = int(faces.min()), int(faces.max())
    own = slice(first, last + 1)
    vertices = mesh.vertices[own]
    low, high = vertices.min(axis=0).tolist(), vertices.max(axis=0).tolist()
    attributes = {"POSITION": _accessor(content, vertices, _VERTEX_DATA, min=low, max=high)}
    if mesh.normals is not None:
        attributes["NORMAL"] = _accessor(content, mesh.normals[own], _VERTEX_DATA)
    if mesh.uvs is not None and mesh.materials[index].texture is not None:
        attributes["TEXCOORD_0"] = _accessor(content, mesh.uvs[own], _VERTEX_DATA)
    if mesh.colors is not None:
        # not as integers: 8 bits of linear light are too few, and trimesh misreads 16
        attributes["COLOR_0"] = _accessor(content, mesh.colors[own].clip(0, 1), _VERTEX_DATA)
    # the largest index of a type restarts the primitive
    corners = (faces - first).reshape(-1).astype(np.uint16 if last - first < 65535 else np.uint32)
    return {"attributes": attributes, "indices": _accessor(content, corners, _INDICES), "material": index}


def _accessor(content: _Content, values: Shaped[np.ndarray, "count *width"], target: int, **keys: Any) -> int:
    content.accessors.append(
        {
            "bufferView": _view(content, np.ascontiguousarray(values).tobytes(), target=target),
            "componentType": _COMPONENTS[values.dtype],
            "count": len(values),
            "type": _TYPES[1 if values.ndim == 1 else values.shape[1]],
            **keys,
        }
    )
    return len(content.accessors) - 1


def _view(content: _Content, data: bytes, **keys: Any) -> int:
    content.views.append({"buffer": 0, "byteOffset": content.size, "byteLength": len(data), **keys})
    content.blocks.append(data + b"\0" * (-len(data) % 4))
    content.size += len(content.blocks[-1])
    return len(content.views) - 1


def _material(content: _Content, material: Material, image: int | None) -> dict[str, Any]:
    surface: dict[str, Any] = {"metallicFactor": material.metallic, "roughnessFactor": material.roughness}
    if material.base_color != (1, 1, 1, 1):
        surface["baseColorFactor"] = [min(max(value, 0.0), 1.0) for value in material.base_color]
    if material.texture is not None:
        wraps = {"wrapS": _WRAPS[material.texture.wrap_u], "wrapT": _WRAPS[material.texture.wrap_v]}
        sampler = _place(content.samplers, {"magFilter": _LINEAR, "minFilter": _LINEAR_MIPMAP_LINEAR, **wraps})
        surface["baseColorTexture"] = {"index": _place(content.textures, {"sampler": sampler, "source": image})}
    said = {"name": material.name} if material.name else {}
    said |= {"pbrMetallicRoughness": surface, "doubleSided": True, "alphaMode": material.alpha_mode.upper()}
    return said | ({"alphaCutoff": material.alpha_cutoff} if material.alpha_mode == "mask" else {})


def _place(items: list[dict[str, Any]], item: dict[str, Any]) -> int:
    """Where the item is in the list, put there if it is new."""
    if item not in items:
        items.append(item)
    return items.index(item)
