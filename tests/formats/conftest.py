"""glTF written by hand, for tests that must not trust another writer, and meshes to write."""

import io
import json
import struct
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mv3d_cli.formats.meshes import MeshFile, read_mesh
from mv3d_cli.scene.conventions import Y_UP_FROM_WORLD
from mv3d_cli.scene.mesh import Material, Mesh, Texture, transform

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


def smooth_picture(size: int = 128) -> np.ndarray:
    """Slow waves, different along u and v, opaque [size, size, 4]."""
    v, u = np.mgrid[0:size, 0:size] / size
    waves = np.stack([np.sin(6.3 * u), np.cos(5 * v), np.sin(6.3 * u + 3 * v), np.ones_like(u)], axis=-1)
    return (150 + np.array([90, 70, 50, 105]) * waves).round().astype(np.uint8)


def globe(material: Material | None = None, normals: bool = True, colors: bool = False) -> Mesh:
    """A squashed sphere with a seam, unlike itself along each axis, wholly in u, v from 0 to 1."""
    rows, columns = 24, 36
    v, u = np.mgrid[0 : rows + 1, 0 : columns + 1] / np.array([rows, columns])[:, None, None]
    polar, turn = np.pi * v, 2 * np.pi * u
    directions = np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)], axis=-1)
    points = directions * (0.5, 0.3, 0.4) + (0.1, 0.2, 0.3)
    at = np.arange((rows + 1) * (columns + 1)).reshape(rows + 1, columns + 1)
    upper = np.stack([at[:-1, :-1], at[1:, :-1], at[1:, 1:]], axis=-1)[1:-1].reshape(-1, 3)
    lower = np.stack([at[:-1, :-1], at[1:, 1:], at[:-1, 1:]], axis=-1)[1:-1].reshape(-1, 3)
    faces = np.concatenate([upper, lower]).astype(np.int32)
    slopes = directions / (0.5, 0.3, 0.4)
    slopes /= np.linalg.norm(slopes, axis=-1, keepdims=True)
    rgba = np.concatenate([0.5 + 0.5 * directions, np.ones_like(directions[..., :1])], axis=-1)
    return Mesh(
        points.reshape(-1, 3).astype(np.float32),
        faces,
        np.zeros(len(faces), np.int32),
        (material or Material(),),
        slopes.reshape(-1, 3).astype(np.float32) if normals else None,
        np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float32) if material and material.texture else None,
        rgba.reshape(-1, 4).astype(np.float32) if colors else None,
    )


def patchwork() -> Mesh:
    """A globe whose faces take turns among materials that no simple format has together, in no order."""
    picture, holed = smooth_picture(), smooth_picture(32)
    holed[8:24, 8:24, 3] = 40
    materials = (
        Material(texture=Texture(picture), name="paint"),
        Material(base_color=(0.8, 0.2, 0.1, 1.0), roughness=0.4, metallic=0.25, name="red paint"),
        Material(),  # of no face
        Material(texture=Texture(picture), base_color=(0.5, 0.9, 0.3, 1.0), name="paint"),
        Material(texture=Texture(holed), alpha_mode="mask", alpha_cutoff=0.5, name="lace"),
    )
    mesh = globe(materials[0])
    return replace(mesh, materials=materials, face_material=np.array([4, 1, 0, 3], np.int32)[mesh.faces[:, 0] % 4])


@dataclass(frozen=True)
class Samples:
    """Meshes to write."""

    smooth_picture = staticmethod(smooth_picture)
    globe = staticmethod(globe)
    patchwork = staticmethod(patchwork)


@pytest.fixture(scope="session")
def samples() -> Samples:
    """Meshes to write: samples.globe(material, normals, colors), samples.patchwork(), samples.smooth_picture()."""
    return Samples()
