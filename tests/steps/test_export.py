"""The export step: what its key depends on, sizes and axes, looks, and fits found from what was made of them."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh

from mv3d_cli.errors import BadMesh, OutputRefused, UsageError
from mv3d_cli.formats.meshes import MeshFile, read_mesh, write_mesh
from mv3d_cli.meshes.surface import mesh_of
from mv3d_cli.scene.conventions import linear_from_srgb
from mv3d_cli.scene.mesh import Material, Mesh, Texture
from mv3d_cli.steps import fit_sdf, render
from mv3d_cli.steps.export import Config, main_file, run
from mv3d_cli.steps.settings import Warned, settings_of
from mv3d_cli.store import Artifact, deliver, maker_of

OTHER: dict[str, Any] = {
    "faces": 300,
    "texture": 64,
    "vertex_colors": True,
    "resolution": 64,
    "height_mm": 80.0,
    "up": "z",
    "input_up": "z",
}
"""Another value of each setting that the key depends on."""

SUFFIXES = (".glb", ".obj", ".ply", ".stl")


@pytest.fixture
def globe(tmp_path: Path) -> Path:
    """A textured ball, 0.5 x 0.5 x 1.0, longest along its up axis, as OBJ."""
    ball = trimesh.creation.uv_sphere(0.25, count=(24, 24))
    ball.apply_scale((1, 1, 2))
    turn = np.arctan2(ball.vertices[:, 1], ball.vertices[:, 0]) / (2 * np.pi) + 0.5
    uvs = np.stack([turn, 0.5 - ball.vertices[:, 2]], axis=1).astype(np.float32)
    v = np.linspace(0, 255, 64)[:, None].repeat(64, axis=1)
    pixels = np.stack([v, 255 - v, np.full_like(v, 90), np.full_like(v, 255)], axis=-1).astype(np.uint8)
    bare = mesh_of(ball.vertices, ball.faces)
    mesh = Mesh(bare.vertices, bare.faces, bare.face_material, (Material(texture=Texture(pixels)),), uvs=uvs)
    write_mesh(tmp_path / "globe.obj", mesh)
    return tmp_path / "globe.obj"


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, Artifact]]:
    """A cache, and in it the fit of a small ball of many colours."""
    folder = tmp_path_factory.mktemp("fitted")
    ball = trimesh.creation.icosphere(subdivisions=2)
    ball.visual.vertex_colors = np.uint8(np.c_[(ball.vertices + 1) * 127, np.full(len(ball.vertices), 255)])
    ball.export(folder / "ball.glb")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MV3D_CACHE_DIR", str(folder / "cache"))
        views = render.run(render.Config(size=64, lighting="none"), [folder / "ball.glb"])
        config = fit_sdf.Config(steps=0, resolution=48, texture=64, faces=1000)
        yield folder / "cache", fit_sdf.run(config, [views.path])


def exported(config: Config, *inputs: Path, main: str | None = None) -> tuple[Mesh, list[str]]:
    """The mesh that was written, read as it lies (+Z up), and the warnings."""
    told: list[str] = []
    made = run(config, inputs, lambda event: told.append(event.text) if isinstance(event, Warned) else None, main)
    assert made.main is not None
    return read_mesh(MeshFile("a", made.main)), told


def extent(mesh: Mesh) -> np.ndarray:
    return np.ptp(mesh.vertices[mesh.faces].reshape(-1, 3), axis=0)


def test_every_setting_is_tried():
    assert {s.name for s in settings_of(Config)} == {*OTHER, "format"}


@pytest.mark.parametrize("name", OTHER)
def test_the_key_depends_on(globe, name):
    assert run(Config(**{name: OTHER[name]}), [globe]).key != run(Config(), [globe]).key


def test_the_key_depends_on_content_and_not_on_places(globe, tmp_path):
    key = run(Config(), [globe]).key
    shutil.copytree(globe.parent, tmp_path / "moved", ignore=shutil.ignore_patterns("moved"))
    assert run(Config(format="glb"), [tmp_path / "moved" / "globe.obj"]).key == key
    globe.with_suffix(".png").write_bytes(cv2.imencode(".png", np.zeros((4, 4, 3), np.uint8))[1].tobytes())
    assert run(Config(), [globe]).key != key
    assert run(Config(), [globe], main="mesh.ply").key != run(Config(), [globe], main="car.ply").key


@pytest.mark.parametrize(
    ("given", "output", "main"),
    [
        ("auto", None, "mesh.glb"),
        ("auto", "a/car.obj", "car.obj"),
        ("auto", "car.v2.PLY", "car.v2.ply"),
        ("auto", "car.stl", "mesh.stl"),  # nothing refers to it by name
        ("auto", "folder", "mesh.glb"),
        ("obj", "folder", "mesh.obj"),
        ("obj", None, "mesh.obj"),
        ("obj", "car.obj", "car.obj"),
    ],
)
def test_the_name_of_the_file(given, output, main):
    assert main_file(Config(format=given), None if output is None else Path(output)) == main


def test_a_suffix_that_we_do_not_write():
    with pytest.raises(OutputRefused, match=r"\.fbx") as caught:
        main_file(Config(), Path("car.fbx"))
    assert ".stl" in caught.value.hint


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_all_formats_hold_the_same_mesh(globe, suffix):
    before = read_mesh(MeshFile("a", globe))
    after, told = exported(Config(), globe, main=f"mesh{suffix}")
    assert np.allclose(after.vertices[after.faces], before.vertices[before.faces], atol=1e-6)
    assert ["colours" in text for text in told] == ([True] if suffix == ".stl" else [])
    if suffix != ".stl":
        textures = [mesh.materials[0].texture for mesh in (before, after)]
        assert textures[0] is not None
        assert textures[1] is not None
        assert np.array_equal(textures[0].pixels, textures[1].pixels)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_heights_are_in_metres_in_gltf_and_in_millimetres_elsewhere(globe, suffix):
    config = Config(height_mm=120)
    after, _ = exported(config, globe, main=f"mesh{suffix}")
    unit = 0.001 if suffix == ".glb" else 1
    assert extent(after) == pytest.approx(np.array([60, 60, 120]) * unit, rel=0.01)
    data = run(config, [globe], main=f"mesh{suffix}").main.read_bytes()  # type: ignore[union-attr]
    assert (b'"unit":"metre"' if suffix == ".glb" else b"unit: millimetre") in data


def test_the_height_is_along_the_up_axis(globe):
    lying, _ = exported(Config(height_mm=100, input_up="z"), globe)  # the file's y axis is its long one
    assert extent(lying) == pytest.approx([0.1, 0.2, 0.1], rel=0.01)
    turned, _ = exported(Config(up="z"), globe)  # glTF is read as +Y up
    assert extent(turned) == pytest.approx([0.5, 1, 0.5], rel=0.01)


def test_a_flat_mesh_has_no_height(tmp_path):
    (tmp_path / "flat.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 0 1\nf 1 2 3\n")
    with pytest.raises(BadMesh, match="height") as caught:
        run(Config(height_mm=10), [tmp_path / "flat.obj"])
    assert "--input-up" in caught.value.hint
    assert exported(Config(height_mm=10, input_up="z"), tmp_path / "flat.obj")[0].vertices.max() == pytest.approx(0.01)


def test_fewer_faces_keep_the_texture(globe, monkeypatch, tmp_path):
    config = Config(faces=200, texture=128)
    mesh, told = exported(config, globe)
    texture = mesh.materials[0].texture
    assert texture is not None
    assert (texture.pixels.shape, told) == ((128, 128, 4), [])
    assert 150 < len(mesh.faces) <= 200
    assert mesh.uvs is not None
    middles, uvs = mesh.vertices[mesh.faces].mean(axis=1), mesh.uvs[mesh.faces].mean(axis=1)
    seen = texture.pixels[tuple((uvs[:, ::-1] * 128).astype(int).T)].astype(float)
    assert np.abs(seen[:, 0] - 255 * (0.5 - middles[:, 2])).mean() < 6  # red falls along the height
    data = run(config, [globe]).main.read_bytes()  # type: ignore[union-attr]
    monkeypatch.setenv("MV3D_CACHE_DIR", str(tmp_path / "another"))
    assert run(config, [globe]).main.read_bytes() == data  # type: ignore[union-attr]


@pytest.mark.parametrize("faces", [0, 400])
def test_colours_at_the_vertices(globe, faces):
    mesh, _ = exported(Config(vertex_colors=True, faces=faces), globe, main="mesh.ply")
    assert mesh.colors is not None
    assert mesh.materials[0].texture is None
    away = np.abs(mesh.vertices[:, 2]) < 0.49  # from the poles, where the repeated picture's rims meet
    wanted = linear_from_srgb(0.5 - mesh.vertices[away, 2])
    assert np.abs(mesh.colors[away, 0] - wanted).max() < 0.02
    assert np.ptp(mesh.colors[:, 0]) > 0.9


def test_a_mesh_with_fewer_faces_is_left_as_it_is(globe):
    before, (after, told) = read_mesh(MeshFile("a", globe)), exported(Config(faces=100_000), globe)
    assert (len(after.faces), told) == (len(before.faces), [])


def test_transparency_that_is_lost_is_told(tmp_path):
    pixels = np.full((8, 8, 4), 100, np.uint8)
    bare = mesh_of(np.float32([[0, 0, 0], [1, 0, 0], [0, 0, 1]]), np.array([[0, 1, 2]]))
    material = Material(texture=Texture(pixels), alpha_mode="mask")
    mesh = Mesh(bare.vertices, bare.faces, bare.face_material, (material,), uvs=np.zeros((3, 2), np.float32))
    write_mesh(tmp_path / "a.glb", mesh)
    assert exported(Config(), tmp_path / "a.glb")[1] == []
    made, told = exported(Config(vertex_colors=True), tmp_path / "a.glb")
    assert ["transparent" in text for text in told] == [True]
    assert made.materials[0].alpha_mode == "opaque"


def test_what_a_ply_cannot_say_is_offered_as_vertex_colours(globe, tmp_path):
    before = read_mesh(MeshFile("a", globe))
    one, two = before.materials[0], Material(texture=Texture(np.zeros((2, 2, 4), np.uint8)))
    parts = (np.arange(len(before.faces)) % 2).astype(np.int32)
    write_mesh(tmp_path / "a.glb", Mesh(before.vertices, before.faces, parts, (one, two), uvs=before.uvs))
    with pytest.raises(OutputRefused) as caught:
        run(Config(format="ply"), [tmp_path / "a.glb"])
    assert "--vertex-colors" in caught.value.hint
    run(Config(format="ply", vertex_colors=True), [tmp_path / "a.glb"])


def test_one_mesh_is_wanted(globe, tmp_path):
    (tmp_path / "empty").mkdir()
    shutil.copy(globe, tmp_path / "second.obj")
    for inputs, word in [([globe, globe], "not 2"), ([tmp_path], "2 meshes")]:
        with pytest.raises(UsageError, match=word):
            run(Config(), inputs)


def test_a_fit_is_meshed_again(fitted):
    _, fit = fitted
    assert fit.main is not None
    mesh, told = exported(Config(faces=300, texture=64), fit.path)
    assert (len(mesh.faces) <= 300, told) == (True, [])
    assert np.linalg.norm(mesh.vertices, axis=1).mean() == pytest.approx(1, abs=0.04)
    assert run(Config(), [fit.path]).key == run(Config(), [fit.main]).key == run(Config(), [fit.path / "views"]).key
    finer, _ = exported(Config(), fit.path)
    assert len(finer.faces) > 1000
    coloured, _ = exported(Config(vertex_colors=True), fit.path, main="mesh.ply")
    assert coloured.colors is not None
    tall, _ = exported(Config(height_mm=50, resolution=40), fit.path, main="mesh.stl")
    assert extent(tall)[2] == pytest.approx(50, rel=1e-4)


def test_a_copy_of_a_fit_s_mesh_leads_to_the_fit(fitted, monkeypatch, tmp_path):
    cache, fit = fitted
    monkeypatch.setenv("MV3D_CACHE_DIR", str(cache))
    deliver(fit, tmp_path / "car.glb")
    assert run(Config(), [tmp_path / "car.glb"]).key == run(Config(), [fit.path]).key
    record = maker_of(run(Config(), [tmp_path / "car.glb"]).path)
    assert record is not None
    assert record["inputs"][0]["made_by"]["step"] == "fit-sdf"


def test_a_fit_that_is_gone_or_changed_leaves_its_mesh(fitted, monkeypatch, tmp_path):
    cache, fit = fitted
    assert fit.main is not None
    faces = len(read_mesh(MeshFile("a", fit.main)).faces)
    deliver(fit, tmp_path / "fit")
    deliver(fit, tmp_path / "car.glb")
    shutil.copytree(cache / "v1" / ".products", tmp_path / "other" / "v1" / ".products")
    monkeypatch.setenv("MV3D_CACHE_DIR", str(tmp_path / "other"))
    mesh, told = exported(Config(), tmp_path / "car.glb")
    assert len(mesh.faces) == faces
    assert ["not in the cache any more" in text for text in told] == [True]
    trimesh.creation.box().export(tmp_path / "fit" / "mesh.glb")
    for path in (tmp_path / "fit", tmp_path / "fit" / "mesh.glb"):
        mesh, told = exported(Config(), path)
        assert len(mesh.faces) == 12
        assert ["was changed" in text for text in told] == [True]
