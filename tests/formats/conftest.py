"""glTF written by hand, for tests that must not trust another writer."""

import io
import json
import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mv3d_cli.formats.meshes import MeshFile, read_mesh
from mv3d_cli.scene.conventions import Y_UP_FROM_WORLD
from mv3d_cli.scene.mesh import Mesh, transform

CODES = {np.int8: 5120, np.uint8: 5121, np.int16: 5122, np.uint16: 5123, np.uint32: 5125, np.float32: 5126}
TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
QUAD = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
QUAD_FACES = np.array([0, 1, 2, 0, 2, 3], np.uint16)
QUAD_UVS = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)


class Builder:
    """Writes glTF by hand: JSON and one buffer."""

    def __init__(self):
        self.json = {"asset": {"version": "2.0"}, "bufferViews": [], "accessors": [], "meshes": [], "nodes": []}
        self.data = b""

    def view(self, content: bytes, **keys) -> int:
        self.data += b"\0" * (-len(self.data) % 4)
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(content), **keys}
        self.json["bufferViews"].append(view)
        self.data += content
        return len(self.json["bufferViews"]) - 1

    def accessor(self, array: np.ndarray, **keys) -> int:
        array = np.ascontiguousarray(array)
        width = 1 if array.ndim == 1 else array.shape[1]
        entry = {
            "bufferView": self.view(array.tobytes()),
            "componentType": CODES[array.dtype.type],
            "count": len(array),
            "type": TYPES[width],
        }
        self.json["accessors"].append({**entry, **keys})
        return len(self.json["accessors"]) - 1

    def mesh(self, indices: np.ndarray | None = QUAD_FACES, *, node=None, primitive=None, **attributes) -> "Builder":
        attributes = {"POSITION": QUAD, **attributes}
        numbers = {k: v if isinstance(v, int) else self.accessor(v) for k, v in attributes.items()}
        item = {"attributes": numbers, **(primitive or {})}
        if indices is not None:
            item["indices"] = self.accessor(indices)
        self.json["meshes"].append({"primitives": [item]})
        self.json["nodes"].append({"mesh": len(self.json["meshes"]) - 1, **(node or {})})
        return self

    def textured(self, *, sampler=None, info=None, image=None, **material) -> "Builder":
        if image is None:
            image = {"bufferView": self.view(self.png()), "mimeType": "image/png"}
        self.json["images"] = [image]
        self.json["textures"] = [{"source": 0}]
        if sampler:
            self.json["samplers"] = [sampler]
            self.json["textures"][0]["sampler"] = 0
        pbr = {"baseColorTexture": {"index": 0, **(info or {})}}
        self.json["materials"] = [{"pbrMetallicRoughness": pbr, **material}]
        return self

    def save(self, folder: Path, name: str = "a.glb") -> MeshFile:
        path = folder / name
        content = {**self.json, "buffers": [{"byteLength": len(self.data)}]}
        if name.endswith(".gltf"):
            content["buffers"][0]["uri"] = "a%20b.bin"
            (folder / "a b.bin").write_bytes(self.data)
            path.write_text(json.dumps(content))
        else:
            path.write_bytes(glb(content, self.data))
        return MeshFile("a", path)

    def read(self, folder: Path) -> Mesh:
        """The mesh in glTF's own axes."""
        return transform(read_mesh(self.save(folder)), Y_UP_FROM_WORLD)

    @staticmethod
    def png(color=(200, 100, 50, 255), kind="PNG") -> bytes:
        """A picture of 3x2 pixels of one colour."""
        stream = io.BytesIO()
        Image.new("RGBA", (3, 2), color).save(stream, kind, lossless=True)
        return stream.getvalue()


def glb(content: dict, data: bytes) -> bytes:
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    data += b"\0" * (-len(data) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(data), 0x004E4942) + data
    return struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks


@pytest.fixture(name="Builder")
def builder() -> type[Builder]:
    """What writes glTF."""
    return Builder
