"""`mv3d export` as a user runs it."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from mv3d_cli.capture.rendering import render
from mv3d_cli.formats.cameras import load_cameras, select
from mv3d_cli.formats.meshes import MeshFile, read_mesh
from mv3d_cli.scene.mesh import transform, unit_sphere_from_mesh

SUFFIXES = (".glb", ".obj", ".ply", ".stl")
OURS = {".glb": [], ".obj": ["mtl", "png"], ".ply": ["png"], ".stl": []}


@pytest.fixture
def car(tmp_path: Path) -> Path:
    """A textured box in a folder of its own."""
    box = trimesh.creation.box((1, 2, 3))
    box = trimesh.Trimesh(box.vertices[box.faces].reshape(-1, 3), np.arange(36).reshape(-1, 3), process=False)
    picture = Image.fromarray(np.random.default_rng(0).integers(0, 255, (16, 16, 3), np.uint8))
    box.visual = trimesh.visual.TextureVisuals(uv=np.random.default_rng(1).random((36, 2)), image=picture)
    folder = tmp_path / "in"
    folder.mkdir()
    box.export(folder / "car.glb")
    return folder / "car.glb"


def drawn(mesh: Path) -> np.ndarray:
    read = read_mesh(MeshFile("a", mesh), "y")
    cameras = select(load_cameras(None), ("front_right",))
    return render(transform(read, unit_sphere_from_mesh(read)), cameras, 64, None).frames[0].color.astype(float)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_every_format_with_all_of_its_files(mv3d, car, tmp_path, suffix):
    output = tmp_path / "out" / f"auto{suffix}"
    ran = mv3d("export", car, "-o", output, "--up", "y")
    assert ran.path == output
    assert sorted(os.listdir(output.parent)) == sorted([output.name, *(f"auto.{end}" for end in OURS[suffix])])
    if suffix == ".stl":
        assert ran.stderr.count("\n") == ran.stderr.count("warning: ") == 1
        assert "no colours" in ran.stderr
    else:
        assert ran.stderr == ""
        assert np.abs(drawn(output) - drawn(car)).max() <= 1
    again = mv3d("export", car, "-o", output, "--up", "y")
    assert (again.path, again.stderr) == (output, "")


def test_pipes_chains_and_is_kept(mv3d, car, tmp_path):
    first = mv3d("export", "-", stdin=f"{car}\n").path
    assert (first / "mesh.glb").is_file()
    assert mv3d("export", car).path == first
    assert mv3d("export", "-", "-o", tmp_path / "a.ply", stdin=f"{first}\n").path == tmp_path / "a.ply"
    manifest = json.loads(mv3d("export", car, "--format", "obj", "--height-mm", 30, "--json").stdout)
    assert (manifest["main"], manifest["config"]["height_mm"]) == ("mesh.obj", 30)
    assert set(manifest["files"]) == {"mesh.obj", "mesh.mtl", "mesh.png"}
    assert "export" in mv3d("cache", "why", tmp_path / "a.ply").stdout


def test_a_folder_is_the_whole_result(mv3d, car, tmp_path):
    made = mv3d("export", car, "-o", tmp_path / "folder", "--format", "obj").path
    assert sorted(os.listdir(made)) == ["artifact.json", "mesh.mtl", "mesh.obj", "mesh.png"]


def test_heights(mv3d, car, tmp_path):
    made = mv3d("export", car, "-o", tmp_path / "a.stl", "--height-mm", 60).path
    vertices = read_mesh(MeshFile("a", made)).vertices
    assert np.ptp(vertices, axis=0) == pytest.approx([30, 90, 60])


def folder_of_meshes(folder: Path) -> Path:
    trimesh.creation.box().export(folder / "a.glb")
    trimesh.creation.box().export(folder / "b.glb")
    return folder


def truncated(folder: Path) -> Path:
    trimesh.creation.box().export(folder / "cut.glb")
    (folder / "cut.glb").write_bytes((folder / "cut.glb").read_bytes()[:-200])
    return folder / "cut.glb"


def not_a_mesh(folder: Path) -> Path:
    (folder / "words.txt").write_text("not a mesh")
    return folder / "words.txt"


def not_gltf(folder: Path) -> Path:
    (folder / "noise.glb").write_bytes(bytes(range(256)) * 4)
    return folder / "noise.glb"


def empty_file(folder: Path) -> Path:
    (folder / "empty.stl").write_bytes(b"")
    return folder / "empty.stl"


def no_faces(folder: Path) -> Path:
    trimesh.PointCloud(np.eye(3)).export(folder / "points.ply")
    return folder / "points.ply"


def nothing(folder: Path) -> Path:
    return folder / "none.glb"


def no_mesh_in_it(folder: Path) -> Path:
    return folder


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (truncated, "truncated"),
        (not_a_mesh, "words.txt"),
        (not_gltf, "noise.glb"),
        (empty_file, "empty.stl"),
        (no_faces, "face"),
        (nothing, "no file or folder"),
        (no_mesh_in_it, "no mesh"),
        (folder_of_meshes, "2 meshes"),
    ],
)
def test_inputs_that_cannot_be_exported(refused, tmp_path, cache_folder, make, word):
    (tmp_path / "in").mkdir()
    ran = refused("export", make(tmp_path / "in"), "-o", tmp_path / "out.obj")
    assert word in ran.stderr.splitlines()[0]
    assert os.listdir(tmp_path) == ["in"]
    assert not [path for path in cache_folder.glob("v1/export/*/*") if path.suffix != ".lock"]


def test_views_are_no_mesh(mv3d, refused, ball, tmp_path):
    tiny = ("--size", 16, "--views", "front")
    views = mv3d("render", ball, *tiny, "-o", tmp_path / "views").path
    error, hint = refused("export", views, "-o", tmp_path / "a.glb").stderr.splitlines()
    assert "views" in error
    assert "fit-sdf" in hint
    assert "data set" in refused("export", mv3d("render", ball, *tiny, "--rotations", 1).path).stderr
    (views / "artifact.json").unlink()
    assert "fit-sdf" in refused("export", views).stderr
    assert "not a mesh file" in refused("export", views / "color" / "front.png").stderr


@pytest.mark.parametrize(
    ("words", "problem", "advice"),
    [
        (["--height-mm", "0"], "--height-mm 0", "from 0.001"),
        (["--height-mm", "-3"], "--height-mm -3", "from 0.001"),
        (["--height-mm", "nan"], "--height-mm nan", "from 0.001"),
        (["--faces", "-1"], "--faces -1", "0 to"),
        (["--faces", "3"], "--faces 3", "4 or more"),
        (["--texture", "4"], "--texture 4", "16 to"),
        (["--format", "fbx"], "fbx", "mv3d export --help"),
        (["--up", "x"], "x", "mv3d export --help"),
        (["-o", "car.fbx"], ".fbx", ".glb, .obj, .ply, .stl"),
        (["-o", "car.obj", "--format", "ply"], ".ply files, not .obj", ".ply"),
    ],
)
def test_what_cannot_be_asked(refused, car, tmp_path, words, problem, advice):
    error, hint = refused("export", car, *words, cwd=tmp_path).stderr.splitlines()
    assert problem in error
    assert advice in hint
    assert os.listdir(tmp_path) == ["in"]


@pytest.mark.parametrize("name", ["auto.obj", "auto.mtl", "auto.png"])
def test_files_of_others_stay(refused, car, tmp_path, name):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / name).write_text("theirs")
    assert name in refused("export", car, "-o", tmp_path / "out" / "auto.obj").stderr
    assert os.listdir(tmp_path / "out") == [name]
    assert (tmp_path / "out" / name).read_text() == "theirs"


def test_a_real_scan(mv3d, shared, tmp_path):
    """A scanned object keeps its texture in every format, and with a tenth of its faces."""
    scan = shared / "gso" / "Dino_4"
    whole = mv3d("export", scan, "-o", tmp_path / "dino.obj").path
    few = mv3d("export", scan, "-o", tmp_path / "few.ply", "--faces", 2000, "--texture", 512, "--up", "y").path
    assert len(read_mesh(MeshFile("a", few)).faces) <= 2000
    before, after = drawn(whole), drawn(few)
    both = (before[..., 3] == 255) & (after[..., 3] == 255)
    assert both.sum() > 500
    assert np.abs(before - after)[both].mean() < 12
    assert np.ptp(before[both], axis=0)[:3].min() > 60  # its colours differ
