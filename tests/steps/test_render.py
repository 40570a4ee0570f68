"""The render step: what its key depends on, the names of its objects, and where it puts a mesh."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from mv3d_cli.errors import UsageError
from mv3d_cli.formats.meshes import read_mesh
from mv3d_cli.formats.views_folder import read_views
from mv3d_cli.steps.render import Config, run
from mv3d_cli.steps.render.objects import work_of
from mv3d_cli.steps.settings import Runtime, Warned, settings_of

TINY = Config(size=16, lighting="none", views=("front",))
OTHER: dict[str, Any] = {
    "size": 24,
    "views": ("front", "top"),
    "lighting": "studio",
    "rotations": 1,
    "tilt": 10.0,
    "seed": 1,
    "procedural": 1,
    "up": "z",
    "samples": 8,
    "jobs": 1,
    "workers": "ray",
}
"""Another value of each setting that the key may depend on; `cameras` is an input and `engine` needs Blender."""


@pytest.fixture
def horse(tmp_path: Path) -> Path:
    """A lopsided mesh, far from the origin."""
    parts = [trimesh.creation.box((1, 2, 3)), trimesh.creation.icosphere(subdivisions=1, radius=0.8)]
    parts[1].apply_translation((2, 1, 0.5))
    mesh = trimesh.util.concatenate(parts)
    mesh.apply_translation((50, -20, 7))
    mesh.export(tmp_path / "horse.ply")
    return tmp_path / "horse.ply"


def keys(config: Config, *inputs: Path) -> str:
    return run(config, inputs).key


def test_every_setting_is_tried():
    assert {s.name for s in settings_of(Config)} == {*OTHER, "cameras", "engine", "device"}


@pytest.mark.parametrize("name", OTHER)
def test_the_key_changes_with_what_changes_the_bytes(horse, name):
    (setting,) = (s for s in settings_of(Config) if s.name == name)
    same = keys(TINY, horse) == keys(replace(TINY, **{name: OTHER[name]}), horse)
    assert same == (setting.mark(Runtime) is not None)


def test_the_key_depends_on_content_and_not_on_place(horse, tmp_path):
    first = keys(TINY, horse)
    (tmp_path / "away").mkdir()
    copy = Path(shutil.copy(horse, tmp_path / "away"))
    assert keys(TINY, copy) == first
    changed = trimesh.load(horse)
    changed.apply_scale((1, 1, 2))
    changed.export(copy)
    assert keys(TINY, copy) != first


def test_one_mesh_and_a_data_set_of_it_have_keys_of_their_own(horse):
    one, several = run(TINY, [horse]), run(TINY, [horse.parent])
    assert one.key != several.key
    assert (one.path / "transforms.json").is_file()
    assert (several.path / "horse" / "transforms.json").is_file()


def test_a_folder_that_begins_like_a_scanned_object_loses_no_mesh(horse, tmp_path):
    (tmp_path / "set" / "meshes").mkdir(parents=True)
    (tmp_path / "set/meshes/model.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    shutil.copy(horse, tmp_path / "set/z.ply")
    index = json.loads((run(TINY, [tmp_path / "set"]).path / "index.json").read_text())
    assert len(index["objects"]) == 2


def test_a_texture_belongs_to_the_key(tmp_path):
    (tmp_path / "a.obj").write_text("mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl m\nf 1 2 3\n")
    (tmp_path / "a.mtl").write_text("newmtl m\nKd 1 0 0\n")
    first = keys(TINY, tmp_path / "a.obj")
    (tmp_path / "a.mtl").write_text("newmtl m\nKd 0 1 0\n")
    assert keys(TINY, tmp_path / "a.obj") != first


def test_names_are_unique(horse, tmp_path):
    for name in ("a/horse.ply", "b/HORSE.ply", "sheet.png.ply", "procedural_000000.ply"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        shutil.copy(horse, tmp_path / name)
    paths = [horse, tmp_path / "a/horse.ply", tmp_path / "b/HORSE.ply", tmp_path / "sheet.png.ply"]
    work = work_of(Config(procedural=2), [*paths, tmp_path / "procedural_000000.ply"])
    names = [item.name for item in work]
    assert names[:3] == ["horse", "horse_2", "HORSE_3"]
    assert names[3:] == ["sheet.png_2", "procedural_000000", "procedural_000000_2", "procedural_000001"]
    assert [item.source is None for item in work] == [False] * 5 + [True] * 2


def test_procedural_objects_come_from_the_seed():
    first, again, other = (work_of(Config(procedural=3, seed=seed), []) for seed in (0, 0, 1))
    assert first == again
    assert not {item.digest for item in first} & {item.digest for item in other}
    with pytest.raises(UsageError):
        work_of(Config(), [])


@pytest.mark.parametrize("rotations", [0, 2])
def test_world_from_mesh_brings_the_mesh_into_the_unit_sphere(horse, rotations):
    folder = run(replace(TINY, rotations=rotations, jobs=1), [horse]).path
    records = [json.loads(path.read_text()) for path in folder.rglob("object.json")]
    assert len(records) == max(rotations, 1)
    for record in records:
        world_from_mesh = np.array(record["world_from_mesh"])
        mesh = trimesh.load(horse, process=False)
        mesh.apply_transform(world_from_mesh)
        assert np.linalg.norm(mesh.vertices, axis=1).max() == pytest.approx(1, abs=1e-5)
        assert np.abs(mesh.bounds.mean(axis=0)).max() < 1e-5
        linear = world_from_mesh[:3, :3]
        assert np.allclose(linear @ linear.T, record["scale"] ** 2 * np.eye(3), atol=1e-9)
        assert np.linalg.det(linear) > 0
        assert record["faces"] == len(mesh.faces)


def test_depth_is_where_trimesh_says(horse):
    """Rays through the pixel centres of the front view, cast by trimesh at the mesh where object.json puts it."""
    folder = run(TINY, [horse]).path
    mesh = trimesh.load(horse)
    mesh.apply_transform(np.array(json.loads((folder / "object.json").read_text())["world_from_mesh"]))
    depth = read_views(folder).frames[0].depth
    assert depth is not None
    rows, columns = np.indices(depth.shape).reshape(2, -1)
    x, z = (columns + 0.5) / 8 - 1, 1 - (rows + 0.5) / 8
    origins = np.stack([x, np.full_like(x, -2), z], axis=1)
    places, rays, _ = mesh.ray.intersects_location(origins, np.tile([0.0, 1.0, 0.0], (len(x), 1)), multiple_hits=False)
    expected = np.zeros(len(x))
    expected[rays] = places[:, 1] + 2
    assert np.abs(depth.reshape(-1) - expected).max() < 1e-4


def test_glb_is_turned_up(tmp_path):
    """The axes in a glTF file: +Y up, +Z to the viewer; in ours +Z up, -Y to the viewer."""
    mesh = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    mesh.export(tmp_path / "a.glb")
    (item,) = work_of(Config(), [tmp_path / "a.glb"])
    assert item.file is not None
    assert np.allclose(read_mesh(item.file).vertices.max(axis=0) - read_mesh(item.file).vertices.min(axis=0), [1, 3, 2])
    assert read_mesh(item.file).vertices[:, 2].max() == pytest.approx(2)
    assert read_mesh(item.file).vertices[:, 1].min() == pytest.approx(-3)


def test_it_tells_of_failures_and_progress(horse):
    (horse.parent / "bad.ply").write_bytes(b"ply")
    told: list[Any] = []
    run(replace(TINY, jobs=1), [horse.parent], told.append)
    assert [(event.done, event.total) for event in told if not isinstance(event, Warned)] == [(1, 2), (2, 2)]
    assert ["failed" in event.text for event in told if isinstance(event, Warned)] == [True]


def test_results_are_the_same_again(horse, tmp_path, monkeypatch):
    config = replace(TINY, lighting="random", procedural=1, jobs=1)
    first = run(config, [horse]).digest
    monkeypatch.setenv("MV3D_CACHE_DIR", str(tmp_path / "another"))
    assert run(config, [horse]).digest == first
