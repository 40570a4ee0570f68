"""A written .glb against the text of glTF 2.0: container, alignment, accessors, materials, what Blender makes of it."""

import io
import json
import struct
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from mv3d_cli.formats.meshes import write_mesh
from mv3d_cli.scene.conventions import Y_UP_FROM_WORLD
from mv3d_cli.scene.mesh import Material, Mesh, Texture, transform

DTYPES = {5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
TOP = {"asset", "scene", "scenes", "nodes", "meshes", "materials", "textures", "samplers", "images"}


def opened(path) -> tuple[dict, bytes]:
    """The JSON and binary chunks, after sections 4.3 and 4.4 (GLB) of the specification."""
    data = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON"
    assert size % 4 == 0
    text = data[20 : 20 + size]
    assert text.endswith((b"}", b"} ", b"}  ", b"}   ")), "padded with spaces"
    binary_size, kind = struct.unpack_from("<I4s", data, 20 + size)
    assert kind == b"BIN\0"
    binary = data[28 + size :]
    assert len(binary) == binary_size
    assert binary_size % 4 == 0
    return json.loads(text), binary


def view_bytes(content: dict, binary: bytes, index: int) -> bytes:
    view = content["bufferViews"][index]
    return binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]


def elements(content: dict, binary: bytes, index: int) -> np.ndarray:
    accessor = content["accessors"][index]
    values = np.frombuffer(view_bytes(content, binary, accessor["bufferView"]), DTYPES[accessor["componentType"]])
    return values.reshape(accessor["count"], WIDTHS[accessor["type"]])


@pytest.fixture
def patchwork(samples, tmp_path) -> tuple[Mesh, dict, bytes]:
    mesh = replace(samples.patchwork(), colors=samples.globe(colors=True).colors)
    write_mesh(tmp_path / "a.glb", mesh, scale=0.08, unit="metre")
    return mesh, *opened(tmp_path / "a.glb")


def test_the_document_holds_no_more_than_the_specification(patchwork):
    _, content, binary = patchwork
    assert set(content) == TOP | {"accessors", "bufferViews", "buffers"}
    assert content["buffers"] == [{"byteLength": len(binary)}]
    assert content["asset"]["version"] == "2.0"
    assert content["asset"]["extras"] == {"unit": "metre", "scale": 0.08, "up": "+Y"}
    assert content["nodes"][0]["extras"] == content["asset"]["extras"]
    assert content["scenes"][content["scene"]]["nodes"] == [0]


def test_views_lie_one_after_another_and_aligned(patchwork):
    _, content, binary = patchwork
    end = 0
    for view in content["bufferViews"]:
        assert view["byteOffset"] % 4 == 0
        assert end <= view["byteOffset"] < end + 4
        end = view["byteOffset"] + view["byteLength"]
        assert "byteStride" not in view
    assert end <= len(binary) < end + 4
    pictures = {image["bufferView"] for image in content["images"]}
    targets = {index: view.get("target") for index, view in enumerate(content["bufferViews"])}
    assert {targets[index] for index in pictures} == {None}
    attributes = {index for p in content["meshes"][0]["primitives"] for index in p["attributes"].values()}
    for index, accessor in enumerate(content["accessors"]):
        assert targets[accessor["bufferView"]] == (34962 if index in attributes else 34963)


def test_primitives_are_the_mesh(patchwork):
    mesh, content, binary = patchwork
    stored = transform(mesh, Y_UP_FROM_WORLD @ np.diag([0.08, 0.08, 0.08, 1]))
    kinds = {
        "POSITION": (5126, "VEC3"),
        "NORMAL": (5126, "VEC3"),
        "TEXCOORD_0": (5126, "VEC2"),
        "COLOR_0": (5126, "VEC4"),
    }
    for number, primitive in zip((0, 1, 3, 4), content["meshes"][0]["primitives"], strict=True):
        textured = mesh.materials[number].texture is not None
        assert set(primitive["attributes"]) == {"POSITION", "NORMAL", "COLOR_0"} | (
            {"TEXCOORD_0"} if textured else set()
        )
        found = {name: elements(content, binary, i) for name, i in primitive["attributes"].items()}
        about = {name: content["accessors"][i] for name, i in primitive["attributes"].items()}
        for name in kinds.keys() & about.keys():
            assert (about[name]["componentType"], about[name]["type"]) == kinds[name]
        assert len({len(values) for values in found.values()}) == 1
        assert about["POSITION"]["min"] == found["POSITION"].min(axis=0).tolist()
        assert about["POSITION"]["max"] == found["POSITION"].max(axis=0).tolist()
        assert np.allclose(np.linalg.norm(found["NORMAL"], axis=1), 1, atol=1e-5)
        corners = elements(content, binary, primitive["indices"]).reshape(-1, 3).astype(int)
        assert np.array_equal(np.unique(corners), np.arange(len(found["POSITION"]))), "every vertex is in use"
        faces = stored.faces[mesh.face_material == number]
        assert np.allclose(found["POSITION"][corners], stored.vertices[faces], atol=1e-6)
        assert np.allclose(found["NORMAL"][corners], stored.normals[faces], atol=1e-6)
        assert np.array_equal(found["COLOR_0"][corners], mesh.colors[faces])
        if textured:
            assert np.array_equal(found["TEXCOORD_0"][corners], mesh.uvs[faces])


def test_materials(patchwork):
    mesh, content, binary = patchwork
    paint, red, tinted, lace = content["materials"]
    assert [primitive["material"] for primitive in content["meshes"][0]["primitives"]] == [0, 1, 2, 3]
    assert paint == {
        "name": "paint",
        "pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 1, "baseColorTexture": {"index": 0}},
        "doubleSided": True,
        "alphaMode": "OPAQUE",
    }
    factors = {"metallicFactor": 0.25, "roughnessFactor": 0.4, "baseColorFactor": [0.8, 0.2, 0.1, 1.0]}
    assert red["pbrMetallicRoughness"] == factors
    assert tinted["pbrMetallicRoughness"]["baseColorTexture"] == {"index": 0}, "the same picture is there once"
    assert (lace["alphaMode"], lace["alphaCutoff"]) == ("MASK", 0.5)
    assert content["textures"] == [{"sampler": 0, "source": 0}, {"sampler": 0, "source": 1}]
    assert content["samplers"] == [{"magFilter": 9729, "minFilter": 9987, "wrapS": 10497, "wrapT": 10497}]
    for image, wanted, mode in zip(
        content["images"], (mesh.materials[0], mesh.materials[4]), ("RGB", "RGBA"), strict=True
    ):
        assert image["mimeType"] == "image/png"
        picture = Image.open(io.BytesIO(view_bytes(content, binary, image["bufferView"])))
        assert (picture.format, picture.mode) == ("PNG", mode)
        assert np.array_equal(np.asarray(picture.convert("RGBA")), wanted.texture.pixels)


def test_a_plain_mesh_has_no_empty_lists(samples, tmp_path):
    write_mesh(tmp_path / "a.glb", samples.globe(normals=False))
    content, _ = opened(tmp_path / "a.glb")
    assert not {"textures", "samplers", "images"} & set(content)
    assert set(content["meshes"][0]["primitives"][0]["attributes"]) == {"POSITION"}
    assert "baseColorFactor" not in content["materials"][0]["pbrMetallicRoughness"]


@pytest.mark.parametrize(("count", "component"), [(65535, 5123), (65536, 5125)])
def test_indices_are_as_short_as_they_can_be(tmp_path, count, component):
    vertices = np.random.default_rng(0).random((count, 3), np.float32)
    faces = np.concatenate([np.arange(count), np.zeros(-count % 3)]).reshape(-1, 3).astype(np.int32)
    write_mesh(tmp_path / "a.glb", Mesh(vertices, faces, np.zeros(len(faces), np.int32), (Material(),)))
    content, binary = opened(tmp_path / "a.glb")
    indices = content["meshes"][0]["primitives"][0]["indices"]
    assert content["accessors"][indices]["componentType"] == component
    assert np.array_equal(elements(content, binary, indices).reshape(-1, 3), faces)


@pytest.mark.parametrize("wraps", [("clamp", "mirror"), ("repeat", "clamp")])
def test_wraps(samples, tmp_path, wraps):
    write_mesh(tmp_path / "a.glb", samples.globe(Material(texture=Texture(samples.smooth_picture(), *wraps))))
    codes = {"clamp": 33071, "mirror": 33648, "repeat": 10497}
    (sampler,) = opened(tmp_path / "a.glb")[0]["samplers"]
    assert (sampler["wrapS"], sampler["wrapT"]) == tuple(codes[wrap] for wrap in wraps)


IMPORT = """
import json, os, sys
import numpy as np
import bpy
operators = {"glb": bpy.ops.import_scene.gltf, "obj": bpy.ops.wm.obj_import,
             "ply": bpy.ops.wm.ply_import, "stl": bpy.ops.wm.stl_import}
found = {}
for path in sys.argv[1:]:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    operators[path[-3:]](filepath=path)
    (thing,) = [thing for thing in bpy.data.objects if thing.type == "MESH"]
    world = np.array(thing.matrix_world)
    data = thing.data
    points = np.array([v.co for v in data.vertices]) @ world[:3, :3].T + world[:3, 3]
    corners = [list(p.vertices) for p in data.polygons]
    uv = [list(x.vector) for x in data.uv_layers[0].uv] if data.uv_layers else []
    sizes = [list(image.size) for image in bpy.data.images if image.size[0]]
    names = [a.name for a in data.color_attributes]
    found[path[-3:]] = [points[np.array(corners)].tolist(), uv, sizes, names]
with open(sys.argv[1] + ".json", "w") as stream:
    json.dump(found, stream)
os._exit(0)  # Blender may crash while Python takes it down
"""


@pytest.mark.parametrize("look", ["textured", "coloured"])
def test_blender_sees_the_world_as_we_do(samples, tmp_path, look):
    """+Z up, front -Y, from every format without a setting; uv (v upwards), picture and colours with it."""
    pytest.importorskip("bpy")
    textured = look == "textured"
    mesh = samples.globe(Material(texture=Texture(samples.smooth_picture())) if textured else None, colors=not textured)
    paths = [write_mesh(tmp_path / f"a.{kind}", mesh)[0] for kind in ("glb", "obj", "ply", "stl")]
    command = [sys.executable, "-c", IMPORT, *map(str, paths)]
    subprocess.run(command, check=True, capture_output=True, timeout=120)
    found = json.loads((tmp_path / "a.glb.json").read_text())
    for kind, (points, uvs, sizes, colors) in found.items():
        assert np.allclose(points, mesh.vertices[mesh.faces], atol=1e-5), kind
        if textured and kind != "stl":
            v_up = mesh.uvs[mesh.faces] * (1, -1) + (0, 1)
            assert np.allclose(np.reshape(uvs, (-1, 3, 2)), v_up, atol=1e-5), kind
        assert bool(sizes) == (textured and kind in ("glb", "obj")), kind  # its PLY importer takes no pictures
        assert bool(colors) == (not textured and kind != "stl"), kind
