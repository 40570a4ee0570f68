import base64
import contextlib
import io
import json
import math
import os
import random
import struct
from pathlib import Path

import DracoPy
import numpy as np
import pytest
from PIL import Image

from mv3d_cli.errors import BadMesh, InputError
from mv3d_cli.formats.gltf.container import read_document
from mv3d_cli.formats.gltf.scene import scene_mesh
from mv3d_cli.formats.meshes import MeshFile, MeshWarning, mesh_sources, read_mesh
from mv3d_cli.formats.textures import GREY
from mv3d_cli.scene.conventions import Y_UP_FROM_WORLD
from mv3d_cli.scene.mesh import Mesh, face_normals, transform

SHARED = Path(os.environ.get("MV3D_SHARED", Path(__file__).resolve().parents[3] / "shared"))
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

    def mesh(self, indices=QUAD_FACES, *, node=None, primitive=None, **attributes) -> "Builder":
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
            image = {"bufferView": self.view(png()), "mimeType": "image/png"}
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


def glb(content: dict, data: bytes) -> bytes:
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    data += b"\0" * (-len(data) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(data), 0x004E4942) + data
    return struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks


def png(color=(200, 100, 50, 255), kind="PNG") -> bytes:
    stream = io.BytesIO()
    Image.new("RGBA", (3, 2), color).save(stream, kind, lossless=True)
    return stream.getvalue()


def triangles(mesh: Mesh) -> list:
    """Faces as corner positions, each from its smallest corner on: order and indices do not matter, sides do."""
    faces = []
    for face in mesh.faces:
        corners = [tuple(np.round(mesh.vertices[i].astype(float), 5) + 0.0) for i in face]
        first = corners.index(min(corners))
        faces.append(tuple(corners[first:] + corners[:first]))
    return sorted(faces)


def area(mesh: Mesh) -> float:
    a, b, c = (mesh.vertices[mesh.faces[:, i]].astype(float) for i in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


@pytest.mark.parametrize("name", ["a.glb", "a.gltf"])
def test_a_quad_is_turned_into_the_world(tmp_path, name):
    mesh = read_mesh(Builder().mesh().save(tmp_path, name))
    assert np.array_equal(mesh.vertices, QUAD[:, [0, 2, 1]] * (1, -1, 1))
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert mesh.normals is None
    assert mesh.uvs is None
    assert mesh.colors is None
    assert np.array_equal(read_mesh(MeshFile("a", tmp_path / name), up="z").vertices, QUAD)


def test_indices_may_be_left_out(tmp_path):
    mesh = Builder().mesh(None, POSITION=QUAD[[0, 1, 2]]).read(tmp_path)
    assert mesh.faces.tolist() == [[0, 1, 2]]


@pytest.mark.parametrize(("mode", "order"), [(5, [0, 1, 3, 2]), (6, [0, 1, 2, 3])])
def test_strips_and_fans(tmp_path, mode, order):
    mesh = Builder().mesh(np.array(order, np.uint8), primitive={"mode": mode}).read(tmp_path)
    assert area(mesh) == pytest.approx(1)
    assert np.allclose(face_normals(mesh), (0, 0, 1)), "both faces look at +z"


def test_a_long_strip_keeps_its_side(tmp_path):
    points = np.array([[i // 2, i % 2, 0] for i in range(11)], np.float32)[:, [0, 1, 2]]
    mesh = Builder().mesh(None, POSITION=points, primitive={"mode": 5}).read(tmp_path)
    assert len(mesh.faces) == 9
    normals = face_normals(mesh)
    assert np.allclose(normals, normals[0])


@pytest.mark.parametrize("mode", [0, 1, 2, 3])
def test_points_and_lines_have_no_surface(tmp_path, mode):
    with pytest.raises(BadMesh, match="no face"):
        Builder().mesh(primitive={"mode": mode}).read(tmp_path)


def test_nodes_are_composed(tmp_path):
    builder = Builder().mesh(node={"translation": [0, 0, 5]})
    half = math.sqrt(0.5)
    builder.json["nodes"].append({"children": [0], "rotation": [0, 0, half, half], "scale": [2, 2, 2]})
    matrix = np.eye(4)
    matrix[:3, 3] = (10, 0, 0)
    builder.json["nodes"].append({"children": [1], "matrix": matrix.T.reshape(-1).tolist()})
    mesh = builder.read(tmp_path)
    # x -> y, y -> -x, doubled, then moved
    expected = np.stack([10 - 2 * QUAD[:, 1], 2 * QUAD[:, 0], 2 * (QUAD[:, 2] + 5)], axis=1)
    assert np.allclose(mesh.vertices, expected, atol=1e-6)


def test_only_the_default_scene_is_read(tmp_path):
    builder = Builder().mesh().mesh(node={"translation": [9, 0, 0]})
    builder.json |= {"scenes": [{"nodes": [0]}, {"nodes": [1]}], "scene": 1}
    assert builder.read(tmp_path).vertices[:, 0].min() == 9


def test_a_mesh_may_stand_in_two_places(tmp_path):
    builder = Builder().mesh()
    builder.json["nodes"].append({"mesh": 0, "translation": [0, 0, 1]})
    mesh = builder.read(tmp_path)
    assert len(mesh.faces) == 4
    assert area(mesh) == pytest.approx(2)
    assert len(mesh.materials) == 1


def test_mirrored_nodes_keep_faces_and_normals_outwards(tmp_path):
    normals = np.tile(np.array([[0, 0, 1]], np.float32), (4, 1))
    mesh = Builder().mesh(NORMAL=normals, node={"scale": [-1, 1, 3]}).read(tmp_path)
    assert np.allclose(face_normals(mesh), (0, 0, 1))
    assert mesh.normals is not None
    assert np.allclose(mesh.normals, (0, 0, 1))


@pytest.mark.parametrize(("code", "wrap"), [(33071, "clamp"), (33648, "mirror"), (10497, "repeat"), (None, "repeat")])
def test_wrapping(tmp_path, code, wrap):
    builder = Builder().mesh(TEXCOORD_0=QUAD_UVS, primitive={"material": 0})
    builder.textured(sampler={"wrapT": code} if code else {})
    (material,) = builder.read(tmp_path).materials
    assert material.texture is not None
    assert material.texture.wrap_v == wrap
    assert material.texture.wrap_u == "repeat"
    assert material.texture.pixels.shape == (2, 3, 4)
    assert (material.texture.pixels == (200, 100, 50, 255)).all()


def test_texture_transforms_are_baked(tmp_path):
    turn = {"offset": [0.1, 0.2], "rotation": 0.3, "scale": [2, 3], "texCoord": 1}
    info = {"texCoord": 0, "extensions": {"KHR_texture_transform": turn}}
    builder = Builder().mesh(TEXCOORD_0=QUAD_UVS * 9, TEXCOORD_1=QUAD_UVS, primitive={"material": 0})
    mesh = builder.textured(info=info).read(tmp_path)
    # Blender's mapping node does the same with v upwards: scale, turn counter-clockwise, move
    u, v = 2 * QUAD_UVS[:, 0], 3 * (1 - QUAD_UVS[:, 1])
    cos, sin = math.cos(0.3), math.sin(0.3)
    moved = (0.1 + 3 * sin, 1 - 0.2 - 3 * cos)
    expected = np.stack([cos * u - sin * v + moved[0], 1 - (sin * u + cos * v + moved[1])], axis=1)
    assert mesh.uvs is not None
    assert np.allclose(mesh.uvs, expected, atol=1e-6)


def test_materials(tmp_path):
    builder = Builder().mesh(primitive={"material": 0}).mesh(primitive={"material": 1}).mesh(primitive={"material": 2})
    builder.json["materials"] = [
        {
            "name": "red",
            "pbrMetallicRoughness": {"baseColorFactor": [0.5, 0, 0, 0.25], "roughnessFactor": 0.5},
            **{"alphaMode": "MASK", "alphaCutoff": 0.75},
        },
        {"extensions": {"KHR_materials_pbrSpecularGlossiness": {"diffuseFactor": [0, 1, 0, 1], "glossinessFactor": 0}}},
        {"extensions": {"KHR_materials_unlit": {}}, "alphaMode": "BLEND"},
    ]
    builder.json["extensionsRequired"] = ["KHR_materials_pbrSpecularGlossiness", "KHR_materials_unlit"]
    mesh = builder.read(tmp_path)
    red, green, plain = mesh.materials
    assert mesh.face_material.tolist() == [0, 0, 1, 1, 2, 2]
    assert (red.name, red.base_color, red.roughness, red.metallic) == ("red", (0.5, 0, 0, 0.25), 0.5, 1)
    assert (red.alpha_mode, red.alpha_cutoff) == ("mask", 0.75)
    assert (green.base_color, green.roughness, green.metallic) == ((0, 1, 0, 1), 1, 0)
    assert (plain.base_color, plain.alpha_mode) == ((1, 1, 1, 1), "blend")


def test_vertex_colours_are_linear_and_may_be_bytes(tmp_path):
    colors = np.array([[0, 255, 51, 0]] * 4, np.uint8)
    builder = Builder()
    builder.mesh(COLOR_0=builder.accessor(colors, normalized=True))
    builder.mesh(COLOR_0=np.full((4, 3), 0.25, np.float32)).mesh()
    mesh = builder.read(tmp_path)
    assert mesh.colors is not None
    assert np.allclose(mesh.colors[:4], (0, 1, 0.2, 0))
    assert np.allclose(mesh.colors[4:8], (0.25, 0.25, 0.25, 1))
    assert np.allclose(mesh.colors[8:], 1)


def test_quantised_positions_and_strides(tmp_path):
    builder = Builder()
    rows = np.zeros((4, 4), np.int16)
    rows[:, :3] = QUAD * 1000
    view = builder.view(rows.tobytes(), byteStride=8)
    builder.json["accessors"].append({"bufferView": view, "componentType": 5122, "count": 4, "type": "VEC3"})
    normals = builder.accessor(np.tile(np.array([[0, 0, 127, 0]], np.int8), (4, 1)), normalized=True, type="VEC3")
    builder.json["bufferViews"][-1]["byteStride"] = 4
    builder.json["extensionsRequired"] = ["KHR_mesh_quantization"]
    builder.mesh(POSITION=0, NORMAL=normals, node={"scale": [0.001] * 3})
    mesh = builder.read(tmp_path)
    assert np.allclose(mesh.vertices, QUAD)
    assert mesh.normals is not None
    assert np.allclose(mesh.normals, (0, 0, 1))


@pytest.mark.parametrize("based", [True, False])
def test_sparse_accessors(tmp_path, based):
    builder = Builder()
    new = {"bufferView": builder.view(QUAD[1:].tobytes())}
    rows = {"bufferView": builder.view(np.array([1, 2, 3], np.uint8).tobytes()), "componentType": 5121}
    entry = {"componentType": 5126, "count": 4, "type": "VEC3"}
    if based:
        entry["bufferView"] = builder.view(np.zeros((4, 3), np.float32).tobytes())
    builder.json["accessors"].append({**entry, "sparse": {"count": 3, "indices": rows, "values": new}})
    assert np.array_equal(builder.mesh(POSITION=0).read(tmp_path).vertices, QUAD)


def test_missing_normals_beside_given_ones_are_flat(tmp_path):
    normals = np.tile(np.array([[1, 0, 0]], np.float32), (4, 1))
    mesh = Builder().mesh(NORMAL=normals).mesh().read(tmp_path)
    assert mesh.normals is not None
    assert np.allclose(mesh.normals[:4], (1, 0, 0))
    assert np.allclose(mesh.normals[4:], (0, 0, 1))
    assert area(mesh) == pytest.approx(2)


def test_draco(tmp_path):
    rng = np.random.default_rng(0)
    points, uvs = rng.random((50, 3)), rng.random((50, 2))
    faces = rng.permutation(48).reshape(-1, 3).astype(np.uint32)
    data = DracoPy.encode(points, faces, tex_coord=uvs, quantization_bits=20, preserve_order=True)
    ids = {a["attribute_type"]: a["unique_id"] for a in DracoPy.decode(data).attributes}
    builder = Builder()
    extension = {"bufferView": builder.view(data), "attributes": {"POSITION": ids[0], "TEXCOORD_0": ids[3]}}
    entry = {"componentType": 5126, "count": 50}
    builder.json["accessors"] += [{**entry, "type": "VEC3"}, {**entry, "type": "VEC2"}]
    primitive = {"extensions": {"KHR_draco_mesh_compression": extension}, "material": 0}
    builder.mesh(None, POSITION=0, TEXCOORD_0=1, primitive=primitive).textured()
    builder.json["extensionsRequired"] = ["KHR_draco_mesh_compression"]
    mesh = builder.read(tmp_path)
    assert mesh.uvs is not None
    corners, expected = mesh.vertices[mesh.faces], points[faces]
    assert len(corners) == len(faces)
    order, expected_order = (np.argsort(c.mean(axis=1)[:, 0]) for c in (corners, expected))
    assert np.allclose(corners[order].mean(axis=1), expected[expected_order].mean(axis=1), atol=1e-4)
    lengths = mesh.uvs[mesh.faces][order].mean(axis=1)
    assert np.allclose(lengths, uvs[faces][expected_order].mean(axis=1), atol=1e-3)
    truncated = Builder()
    extension["bufferView"] = truncated.view(data[:60])
    truncated.json["accessors"] += builder.json["accessors"][:2]
    with pytest.raises(BadMesh, match="Draco"):
        truncated.mesh(None, POSITION=0, primitive=primitive).textured().read(tmp_path)


def test_skins_stand_at_their_joints(tmp_path):
    bind = np.eye(4, dtype=np.float32)
    bind[:3, 3] = (0, 0, -1)
    builder = Builder()
    joints, weights = np.zeros((4, 4), np.uint8), np.tile(np.array([[1, 0, 0, 0]], np.float32), (4, 1))
    builder.mesh(JOINTS_0=joints, WEIGHTS_0=weights, node={"skin": 0, "translation": [99, 0, 0]})
    builder.json["nodes"].append({"translation": [0, 0, 3], "scale": [2, 2, 2]})
    inverse = builder.accessor(bind.T.reshape(1, 16))
    builder.json["skins"] = [{"joints": [1], "inverseBindMatrices": inverse}]
    mesh = builder.read(tmp_path)
    assert np.allclose(mesh.vertices, QUAD * 2 + (0, 0, 1))


@pytest.mark.parametrize("how", ["data", "file", "webp"])
def test_pictures_from_addresses(tmp_path, how):
    builder = Builder().mesh(TEXCOORD_0=QUAD_UVS, primitive={"material": 0})
    uri = "data:image/png;base64," + base64.b64encode(png()).decode()
    if how == "file":
        (tmp_path / "deep").mkdir()
        (tmp_path / "deep" / "a é.png").write_bytes(png())
        uri = "deep/a%20%C3%A9.png"
    builder.textured(image={"uri": uri})
    if how == "webp":
        builder.json["images"] = [{"bufferView": builder.view(png(kind="WEBP"))}]
        builder.json["textures"] = [{"extensions": {"EXT_texture_webp": {"source": 0}}}]
    file = builder.save(tmp_path, "a.gltf")
    (material,) = read_mesh(file).materials
    assert material.texture is not None
    assert (material.texture.pixels == (200, 100, 50, 255)).all()
    others = [tmp_path / "deep" / "a é.png"] if how == "file" else []
    assert mesh_sources(file) == [file.path, tmp_path / "a b.bin", *others]


@pytest.mark.parametrize("content", [None, b"no picture"])
def test_a_picture_that_cannot_be_had_is_grey(tmp_path, content):
    if content:
        (tmp_path / "a.png").write_bytes(content)
    builder = Builder().mesh(TEXCOORD_0=QUAD_UVS, primitive={"material": 0}).textured(image={"uri": "a.png"})
    with pytest.warns(MeshWarning, match="grey"):
        (material,) = builder.read(tmp_path).materials
    assert material.base_color == (GREY, GREY, GREY, 1)
    assert material.texture is None


OUTSIDE = ["../a.png", "..%2Fa.png", "/etc/passwd", "file:///etc/passwd", "https://example.org/a.png", "..\\a.png"]


@pytest.mark.parametrize("uri", [*OUTSIDE, "C:\\a.png", "link.png", "folder/../../a.png"])
def test_addresses_outside_the_folder_are_refused(tmp_path, uri):
    (tmp_path / "mesh").mkdir()
    (tmp_path / "a.png").write_bytes(png())
    (tmp_path / "mesh" / "link.png").symlink_to(tmp_path / "a.png")
    builder = Builder().mesh(TEXCOORD_0=QUAD_UVS, primitive={"material": 0}).textured(image={"uri": uri})
    file = builder.save(tmp_path / "mesh")
    for verb in (read_mesh, mesh_sources):
        with pytest.raises(BadMesh, match="outside its folder"):
            verb(file)
    content = json.loads(json.dumps(builder.json)) | {"buffers": [{"byteLength": 9, "uri": uri}]}
    file.path.with_suffix(".gltf").write_text(json.dumps(content))
    with pytest.raises(BadMesh, match="outside its folder"):
        read_mesh(MeshFile("a", file.path.with_suffix(".gltf")))


def changed(**changes):
    def change(builder: Builder) -> None:
        builder.json |= changes

    return change


def in_accessor(**changes):
    return lambda builder: builder.json["accessors"][0].update(changes)


BAD = {
    "huge accessor": (in_accessor(count=10**15), "truncated"),
    "huge sparse": (lambda b: b.json["accessors"].__setitem__(0, {**HUGE, "type": "VEC3"}), "declares"),
    "negative count": (in_accessor(count=-4), "reach beyond"),
    "negative offset": (in_accessor(byteOffset=-4), "reach beyond"),
    "unknown type": (in_accessor(type="MAT7"), "unknown type"),
    "two numbers": (in_accessor(type="VEC2"), "POSITION"),
    "no view": (in_accessor(bufferView=77), r"bufferViews\[77\]"),
    "negative index": (in_accessor(bufferView=-1), r"bufferViews\[-1\]"),
    "text count": (in_accessor(count="4"), "malformed"),
    "beyond buffer": (lambda b: b.json["bufferViews"][0].update(byteLength=10**9), "beyond its buffer"),
    "cycle": (lambda b: b.json["nodes"][0].update(children=[0]), "cycle|no face"),
    "long cycle": (changed(nodes=[{"children": [1]}, {"children": [0], "mesh": 0}], scenes=[{"nodes": [0]}]), "cycle"),
    "two parents": (changed(nodes=[{"children": [1, 1]}, {"mesh": 0}], scenes=[{"nodes": [0]}]), "cycle"),
    "no node": (changed(scenes=[{"nodes": [5]}]), r"nodes\[5\]"),
    "no scene": (changed(scenes=[{"nodes": [0]}], scene=4), r"scenes\[4\]"),
    "empty": (changed(nodes=[]), "no face"),
    "basisu": (changed(extensionsRequired=["KHR_texture_basisu"]), "KHR_texture_basisu"),
    "meshopt": (changed(extensionsRequired=["EXT_meshopt_compression"]), "EXT_meshopt_compression"),
    "version 1": (changed(asset={"version": "1.0"}), "version 1.0"),
    "no asset": (changed(asset=None), "not glTF"),
    "nodes a number": (changed(nodes=3), "malformed|nodes"),
    "bad matrix": (lambda b: b.json["nodes"][0].update(matrix=[1, 2]), "16 numbers"),
    "nan matrix": (lambda b: b.json["nodes"][0].update(translation=[float("nan"), 0, 0]), "not finite"),
    "flat": (lambda b: b.json["nodes"][0].update(scale=[0, 0, 0]), "area"),
}
HUGE = {"componentType": 5126, "count": 10**10}


@pytest.mark.parametrize("case", BAD)
def test_malformed_files_say_what_is_wrong(tmp_path, case):
    change, message = BAD[case]
    builder = Builder().mesh()
    change(builder)
    with pytest.raises(BadMesh, match=message) as caught:
        builder.read(tmp_path)
    assert "a.glb" in str(caught.value)
    assert caught.value.hint


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_vertices_must_be_finite(tmp_path, value):
    with pytest.raises(BadMesh, match="not finite"):
        Builder().mesh(POSITION=np.where(QUAD > 0.5, value, QUAD).astype(np.float32)).read(tmp_path)


def test_a_face_must_have_its_vertices(tmp_path):
    with pytest.raises(BadMesh, match="vertex 4 of 4"):
        Builder().mesh(np.array([0, 1, 4], np.uint8)).read(tmp_path)


def test_faces_without_area_are_dropped(tmp_path):
    mesh = Builder().mesh(np.array([0, 1, 2, 0, 0, 1, 3, 3, 3], np.uint8)).read(tmp_path)
    assert mesh.faces.tolist() == [[0, 1, 2]]
    with pytest.raises(BadMesh, match="area"):
        Builder().mesh(np.array([0, 0, 1], np.uint8)).read(tmp_path)


def test_normals_that_are_no_directions_become_the_faces(tmp_path):
    normals = np.array([[0, 0, 0], [np.nan, 0, 0], [0, 0, 2], [1, 0, 0]], np.float32)
    mesh = Builder().mesh(NORMAL=normals).read(tmp_path)
    assert mesh.normals is not None
    assert np.allclose(mesh.normals, [[0, 0, 1], [0, 0, 1], [0, 0, 1], [1, 0, 0]])


def test_any_truncation_is_an_error_of_the_file(tmp_path):
    file = Builder().mesh(TEXCOORD_0=QUAD_UVS, primitive={"material": 0}).textured().save(tmp_path)
    whole = file.path.read_bytes()
    for length in range(0, len(whole) - 1, 29):
        file.path.write_bytes(whole[:length])
        with pytest.raises(BadMesh):
            read_mesh(file)


@pytest.mark.filterwarnings("ignore::mv3d_cli.formats.textures.MeshWarning")
def test_flipped_bytes_never_escape_as_another_error(tmp_path):
    file = Builder().mesh(TEXCOORD_0=QUAD_UVS, primitive={"material": 0}).textured().save(tmp_path)
    whole = file.path.read_bytes()
    rng = random.Random(0)
    for _ in range(300):
        damaged = bytearray(whole)
        for _ in range(3):
            damaged[rng.randrange(len(damaged))] = rng.randrange(256)
        file.path.write_bytes(damaged)
        with contextlib.suppress(InputError):
            read_mesh(file)


def some_objects() -> list[Path]:
    found = sorted((SHARED / "objects").glob("*.glb"))
    return found[:: max(1, len(found) // 12)]


@pytest.mark.parametrize("path", some_objects() or [None], ids=lambda path: path.stem if path else "none")
def test_trimesh_agrees(path):
    if path is None:
        pytest.skip(f"needs meshes in {SHARED / 'objects'}")
    import trimesh

    ours = scene_mesh(read_document(path))
    theirs = trimesh.load_scene(path, process=False)
    parts = theirs.dump(concatenate=False)
    assert len(ours.faces) == sum(len(part.faces) for part in parts)
    corners = np.concatenate([part.vertices[part.faces].reshape(-1, 3) for part in parts])
    ours_corners = ours.vertices[ours.faces].reshape(-1, 3)
    assert np.allclose(np.sort(ours_corners, axis=0), np.sort(corners, axis=0), atol=1e-5)
    factors = [part.visual.material.baseColorFactor for part in parts]
    expected = {tuple(255 if factor is None else factor for factor in (f,)) if f is None else tuple(f) for f in factors}
    found = {tuple(np.round(np.array(m.base_color) * 255).astype(int)) for m in ours.materials}
    assert found == {(255,) * 4 if e == (255,) else tuple(map(int, e)) for e in expected}
    uvs = [p.visual.uv[p.faces].reshape(-1, 2) for p in parts if p.visual.material.baseColorTexture is not None]
    if uvs and ours.uvs is not None:
        used = np.array([m.texture is not None for m in ours.materials])[ours.face_material]
        flipped = np.concatenate(uvs) * (1, -1) + (0, 1)
        mine = ours.uvs[ours.faces[used]].reshape(-1, 2)
        assert np.allclose(np.sort(mine, axis=0), np.sort(flipped, axis=0), atol=1e-5)
