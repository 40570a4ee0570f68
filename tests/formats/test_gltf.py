import base64
import math
import os
from pathlib import Path
from typing import Any

import DracoPy
import numpy as np
import pytest

from mv3d_cli.errors import BadMesh
from mv3d_cli.formats.gltf.container import read_document
from mv3d_cli.formats.gltf.scene import scene_mesh
from mv3d_cli.formats.meshes import MeshFile, MeshWarning, mesh_sources, read_mesh
from mv3d_cli.formats.textures import GREY
from mv3d_cli.scene.mesh import Mesh, face_normals

SHARED = Path(os.environ.get("MV3D_SHARED", Path(__file__).resolve().parents[3] / "shared"))
QUAD = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
QUAD_FACES = np.array([0, 1, 2, 0, 2, 3], np.uint16)
QUAD_UVS = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)


def area(mesh: Mesh) -> float:
    a, b, c = (mesh.vertices[mesh.faces[:, i]].astype(float) for i in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


@pytest.mark.parametrize("name", ["a.glb", "a.gltf"])
def test_a_quad_is_turned_into_the_world(Builder, tmp_path, name):
    mesh = read_mesh(Builder().mesh().save(tmp_path, name))
    assert np.array_equal(mesh.vertices, QUAD[:, [0, 2, 1]] * (1, -1, 1))
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert mesh.normals is None
    assert mesh.uvs is None
    assert mesh.colors is None
    assert np.array_equal(read_mesh(MeshFile("a", tmp_path / name), up="z").vertices, QUAD)


def test_indices_may_be_left_out(Builder, tmp_path):
    mesh = Builder().mesh(None, POSITION=QUAD[[0, 1, 2]]).read(tmp_path)
    assert mesh.faces.tolist() == [[0, 1, 2]]


@pytest.mark.parametrize(("mode", "order"), [(5, [0, 1, 3, 2]), (6, [0, 1, 2, 3])])
def test_strips_and_fans(Builder, tmp_path, mode, order):
    mesh = Builder().mesh(np.array(order, np.uint8), primitive={"mode": mode}).read(tmp_path)
    assert area(mesh) == pytest.approx(1)
    assert np.allclose(face_normals(mesh), (0, 0, 1)), "both faces look at +z"


def test_a_long_strip_keeps_its_side(Builder, tmp_path):
    points = np.array([[i // 2, i % 2, 0] for i in range(11)], np.float32)[:, [0, 1, 2]]
    mesh = Builder().mesh(None, POSITION=points, primitive={"mode": 5}).read(tmp_path)
    assert len(mesh.faces) == 9
    normals = face_normals(mesh)
    assert np.allclose(normals, normals[0])


@pytest.mark.parametrize("mode", [0, 1, 2, 3])
def test_points_and_lines_have_no_surface(Builder, tmp_path, mode):
    with pytest.raises(BadMesh, match="no face"):
        Builder().mesh(primitive={"mode": mode}).read(tmp_path)


def test_nodes_are_composed(Builder, tmp_path):
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


def test_only_the_default_scene_is_read(Builder, tmp_path):
    builder = Builder().mesh().mesh(node={"translation": [9, 0, 0]})
    builder.json |= {"scenes": [{"nodes": [0]}, {"nodes": [1]}], "scene": 1}
    assert builder.read(tmp_path).vertices[:, 0].min() == 9


def test_a_mesh_may_stand_in_two_places(Builder, tmp_path):
    builder = Builder().mesh()
    builder.json["nodes"].append({"mesh": 0, "translation": [0, 0, 1]})
    mesh = builder.read(tmp_path)
    assert len(mesh.faces) == 4
    assert area(mesh) == pytest.approx(2)
    assert len(mesh.materials) == 1


def test_mirrored_nodes_keep_faces_and_normals_outwards(Builder, tmp_path):
    normals = np.tile(np.array([[0, 0, 1]], np.float32), (4, 1))
    mesh = Builder().mesh(NORMAL=normals, node={"scale": [-1, 1, 3]}).read(tmp_path)
    assert np.allclose(face_normals(mesh), (0, 0, 1))
    assert mesh.normals is not None
    assert np.allclose(mesh.normals, (0, 0, 1))


@pytest.mark.parametrize(("code", "wrap"), [(33071, "clamp"), (33648, "mirror"), (10497, "repeat"), (None, "repeat")])
def test_wrapping(Builder, tmp_path, code, wrap):
    builder = Builder().mesh(TEXCOORD_0=QUAD_UVS, primitive={"material": 0})
    builder.textured(sampler={"wrapT": code} if code else {})
    (material,) = builder.read(tmp_path).materials
    assert material.texture is not None
    assert material.texture.wrap_v == wrap
    assert material.texture.wrap_u == "repeat"
    assert material.texture.pixels.shape == (2, 3, 4)
    assert (material.texture.pixels == (200, 100, 50, 255)).all()


def test_texture_transforms_are_baked(Builder, tmp_path):
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


def test_materials(Builder, tmp_path):
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


def test_vertex_colours_are_linear_and_may_be_bytes(Builder, tmp_path):
    colors = np.array([[0, 255, 51, 0]] * 4, np.uint8)
    builder = Builder()
    builder.mesh(COLOR_0=builder.accessor(colors, normalized=True))
    builder.mesh(COLOR_0=np.full((4, 3), 0.25, np.float32)).mesh()
    mesh = builder.read(tmp_path)
    assert mesh.colors is not None
    assert np.allclose(mesh.colors[:4], (0, 1, 0.2, 0))
    assert np.allclose(mesh.colors[4:8], (0.25, 0.25, 0.25, 1))
    assert np.allclose(mesh.colors[8:], 1)


def test_quantised_positions_and_strides(Builder, tmp_path):
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
def test_sparse_accessors(Builder, tmp_path, based):
    builder = Builder()
    new = {"bufferView": builder.view(QUAD[1:].tobytes())}
    rows = {"bufferView": builder.view(np.array([1, 2, 3], np.uint8).tobytes()), "componentType": 5121}
    entry = {"componentType": 5126, "count": 4, "type": "VEC3"}
    if based:
        entry["bufferView"] = builder.view(np.zeros((4, 3), np.float32).tobytes())
    builder.json["accessors"].append({**entry, "sparse": {"count": 3, "indices": rows, "values": new}})
    assert np.array_equal(builder.mesh(POSITION=0).read(tmp_path).vertices, QUAD)


def test_missing_normals_beside_given_ones_are_flat(Builder, tmp_path):
    normals = np.tile(np.array([[1, 0, 0]], np.float32), (4, 1))
    mesh = Builder().mesh(NORMAL=normals).mesh().read(tmp_path)
    assert mesh.normals is not None
    assert np.allclose(mesh.normals[:4], (1, 0, 0))
    assert np.allclose(mesh.normals[4:], (0, 0, 1))
    assert area(mesh) == pytest.approx(2)


def test_draco(Builder, tmp_path):
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


def test_skins_stand_at_their_joints(Builder, tmp_path):
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
def test_pictures_from_addresses(Builder, tmp_path, how):
    builder = Builder().mesh(TEXCOORD_0=QUAD_UVS, primitive={"material": 0})
    uri = "data:image/png;base64," + base64.b64encode(Builder.png()).decode()
    if how == "file":
        (tmp_path / "deep").mkdir()
        (tmp_path / "deep" / "a é.png").write_bytes(Builder.png())
        uri = "deep/a%20%C3%A9.png"
    builder.textured(image={"uri": uri})
    if how == "webp":
        builder.json["images"] = [{"bufferView": builder.view(Builder.png(kind="WEBP"))}]
        builder.json["textures"] = [{"extensions": {"EXT_texture_webp": {"source": 0}}}]
    file = builder.save(tmp_path, "a.gltf")
    (material,) = read_mesh(file).materials
    assert material.texture is not None
    assert (material.texture.pixels == (200, 100, 50, 255)).all()
    others = [tmp_path / "deep" / "a é.png"] if how == "file" else []
    assert mesh_sources(file) == [file.path, tmp_path / "a b.bin", *others]


@pytest.mark.parametrize("content", [None, b"no picture"])
def test_a_picture_that_cannot_be_had_is_grey(Builder, tmp_path, content):
    if content:
        (tmp_path / "a.png").write_bytes(content)
    builder = Builder().mesh(TEXCOORD_0=QUAD_UVS, primitive={"material": 0}).textured(image={"uri": "a.png"})
    with pytest.warns(MeshWarning, match="grey"):
        (material,) = builder.read(tmp_path).materials
    assert material.base_color == (GREY, GREY, GREY, 1)
    assert material.texture is None


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
    parts: list[Any] = list(theirs.dump(concatenate=False))
    assert len(ours.faces) == sum(len(part.faces) for part in parts)
    corners = np.concatenate([part.vertices[part.faces].reshape(-1, 3) for part in parts])
    ours_corners = ours.vertices[ours.faces].reshape(-1, 3)
    assert np.allclose(np.sort(ours_corners, axis=0), np.sort(corners, axis=0), atol=1e-5)
    factors = [part.visual.material.baseColorFactor for part in parts]
    expected = {(255,) * 4 if factor is None else tuple(map(int, factor)) for factor in factors}
    found = {tuple(np.round(np.array(m.base_color) * 255).astype(int)) for m in ours.materials}
    assert found == expected
    uvs = [p.visual.uv[p.faces].reshape(-1, 2) for p in parts if p.visual.material.baseColorTexture is not None]
    if uvs and ours.uvs is not None:
        used = np.array([m.texture is not None for m in ours.materials])[ours.face_material]
        flipped = np.concatenate(uvs) * (1, -1) + (0, 1)
        mine = ours.uvs[ours.faces[used]].reshape(-1, 2)
        assert np.allclose(np.sort(mine, axis=0), np.sort(flipped, axis=0), atol=1e-5)
