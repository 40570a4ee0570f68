"""What is refused, and how: addresses outside the folder, malformed, truncated and damaged files."""

import contextlib
import json
import random

import numpy as np
import pytest

from mv3d_cli.errors import BadMesh, InputError
from mv3d_cli.formats.meshes import MeshFile, mesh_sources, read_mesh

QUAD = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
QUAD_UVS = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)


OUTSIDE = ["../a.png", "..%2Fa.png", "/etc/passwd", "file:///etc/passwd", "https://example.org/a.png", "..\\a.png"]


@pytest.mark.parametrize("uri", [*OUTSIDE, "C:\\a.png", "link.png", "folder/../../a.png"])
def test_addresses_outside_the_folder_are_refused(Builder, tmp_path, uri):
    (tmp_path / "mesh").mkdir()
    (tmp_path / "a.png").write_bytes(Builder.png())
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
    def change(builder) -> None:
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
def test_malformed_files_say_what_is_wrong(Builder, tmp_path, case):
    change, message = BAD[case]
    builder = Builder().mesh()
    change(builder)
    with pytest.raises(BadMesh, match=message) as caught:
        builder.read(tmp_path)
    assert "a.glb" in str(caught.value)
    assert caught.value.hint


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_vertices_must_be_finite(Builder, tmp_path, value):
    with pytest.raises(BadMesh, match="not finite"):
        Builder().mesh(POSITION=np.where(QUAD > 0.5, value, QUAD).astype(np.float32)).read(tmp_path)


def test_a_face_must_have_its_vertices(Builder, tmp_path):
    with pytest.raises(BadMesh, match="vertex 4 of 4"):
        Builder().mesh(np.array([0, 1, 4], np.uint8)).read(tmp_path)


def test_faces_without_area_are_dropped(Builder, tmp_path):
    mesh = Builder().mesh(np.array([0, 1, 2, 0, 0, 1, 3, 3, 3], np.uint8)).read(tmp_path)
    assert mesh.faces.tolist() == [[0, 1, 2]]
    with pytest.raises(BadMesh, match="area"):
        Builder().mesh(np.array([0, 0, 1], np.uint8)).read(tmp_path)


def test_normals_that_are_no_directions_become_the_faces(Builder, tmp_path):
    normals = np.array([[0, 0, 0], [np.nan, 0, 0], [0, 0, 2], [1, 0, 0]], np.float32)
    mesh = Builder().mesh(NORMAL=normals).read(tmp_path)
    assert mesh.normals is not None
    assert np.allclose(mesh.normals, [[0, 0, 1], [0, 0, 1], [0, 0, 1], [1, 0, 0]])


def test_any_truncation_is_an_error_of_the_file(Builder, tmp_path):
    file = Builder().mesh(TEXCOORD_0=QUAD_UVS, primitive={"material": 0}).textured().save(tmp_path)
    whole = file.path.read_bytes()
    for length in range(0, len(whole) - 1, 29):
        file.path.write_bytes(whole[:length])
        with pytest.raises(BadMesh):
            read_mesh(file)


@pytest.mark.filterwarnings("ignore::mv3d_cli.formats.textures.MeshWarning")
def test_flipped_bytes_never_escape_as_another_error(Builder, tmp_path):
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
