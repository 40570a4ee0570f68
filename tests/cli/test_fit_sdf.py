"""`mv3d fit-sdf` as a user runs it, on good views and bad ones."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import trimesh

from mv3d_cli.formats.images import read_image, write_depth, write_png
from mv3d_cli.formats.views_folder import read_views

HORIZONTAL = "front,back,right,left,front_right,front_left,back_right,back_left"
SMALL = ("--resolution", "64", "--faces", "2000", "--texture", "128")


@pytest.fixture(scope="module")
def made_views(mv3d, meshes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight views of a coloured ball, 64 px."""
    folder = tmp_path_factory.mktemp("fit") / "views"
    return mv3d(
        "render", meshes / "ball.glb", "--size", "64", "--views", HORIZONTAL, "--lighting", "none", "-o", folder
    ).path


@pytest.fixture
def views(made_views: Path, tmp_path: Path) -> Path:
    """A copy that a test may spoil; it is nobody's artifact."""
    shutil.copytree(made_views, tmp_path / "views")
    (tmp_path / "views" / "artifact.json").unlink()
    return tmp_path / "views"


def test_a_ball_is_a_ball(mv3d, made_views: Path, tmp_path: Path) -> None:
    fit = mv3d("fit-sdf", made_views, "--steps", "20", *SMALL, "-o", tmp_path / "fit").path
    names = {path.name for path in fit.iterdir()}
    assert names == {"artifact.json", "check.json", "field.safetensors", "mesh.glb", "sheet.png", "views"}
    mesh = trimesh.load(fit / "mesh.glb", force="mesh")
    welded = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    welded.merge_vertices(merge_tex=True, merge_norm=True)
    assert welded.is_watertight
    assert welded.volume == pytest.approx(4 / 3 * np.pi, rel=0.06)  # the ball has 320 faces
    assert len(mesh.faces) <= 2100
    check = json.loads((fit / "check.json").read_text())
    assert check["watertight"]
    assert check["components"] == 1
    assert check["mask_iou"] > 0.96
    assert check["psnr"] > 22
    assert set(check["views"]) == set(HORIZONTAL.split(","))
    assert len(np.unique(read_image(fit / "sheet.png").reshape(-1, 4), axis=0)) > 100


def test_pipes_and_is_kept(mv3d, made_views: Path) -> None:
    first = mv3d("fit-sdf", "-", "--quick", *SMALL, stdin=f"{made_views}\n").path
    started = time.monotonic()
    assert mv3d("fit-sdf", made_views, "--quick", *SMALL).path == first
    assert time.monotonic() - started < 5
    manifest = json.loads(mv3d("fit-sdf", made_views, "--quick", *SMALL, "--json").stdout)
    assert manifest["main"] == "mesh.glb"
    assert "render" in mv3d("cache", "why", first).stdout


@pytest.mark.parametrize("suffix", ["obj", "stl"])
def test_other_formats_come_with_all_their_files(mv3d, made_views: Path, tmp_path: Path, suffix: str) -> None:
    made = mv3d("fit-sdf", made_views, "--quick", *SMALL, "-o", tmp_path / f"ball.{suffix}").path
    names = {path.name for path in tmp_path.iterdir()}
    assert names == ({"ball.obj", "ball.mtl", "ball.png"} if suffix == "obj" else {"ball.stl"})
    mesh = trimesh.load(made, force="mesh")
    assert mesh.extents == pytest.approx([2, 2, 2], abs=0.05)


def test_weights_and_earlier_fits(mv3d, views: Path, tmp_path: Path, refused) -> None:
    some = mv3d("fit-sdf", views, "--quick", *SMALL, "--weight", "front=3,back=0").path
    kept = read_views(some / "views")
    assert {view.camera.name: view.weight for view in kept.frames}["front"] == 3
    assert "back" not in {view.camera.name for view in kept.frames}
    content = json.loads((views / "transforms.json").read_text())
    content["frames"] = [frame for frame in content["frames"] if frame["name"] in ("front", "back")]
    (views / "transforms.json").write_text(json.dumps(content))
    more = mv3d("fit-sdf", views, "--quick", *SMALL, "--from", some).path
    assert {view.camera.name for view in read_views(more / "views").frames} == set(HORIZONTAL.split(","))
    assert "weight" in refused("fit-sdf", views, "--weight", "nobody=2").stderr
    refused("fit-sdf", views, "--weight", "front=much")
    refused("fit-sdf", views, "--weight", "front=0,back=0")
    refused("fit-sdf", views, "--from", tmp_path)


def test_killed_and_run_again_gives_the_same_bytes(mv3d, made_views: Path, cache_folder: Path, tmp_path: Path) -> None:
    command = ("fit-sdf", made_views, "--steps", "120", *SMALL)
    whole = mv3d(*command, env={"MV3D_CACHE_DIR": str(tmp_path / "other")}).path
    program, nowhere = str(Path(sys.executable).parent / "mv3d"), subprocess.DEVNULL
    for _ in range(2):
        process = subprocess.Popen([program, *map(str, command)], stdout=nowhere, stderr=nowhere)
        deadline = time.monotonic() + 60
        while not list(cache_folder.rglob("checkpoint*")) and time.monotonic() < deadline and process.poll() is None:
            time.sleep(0.05)
        time.sleep(0.3)
        process.send_signal(signal.SIGKILL)
        process.wait()
    again = mv3d(*command).path
    assert not list(again.rglob("checkpoint*"))
    for name in ("field.safetensors", "mesh.glb", "check.json"):
        assert (again / name).read_bytes() == (whole / name).read_bytes()


def _drop(folder: Path, *kinds: str) -> None:
    """Takes kinds of pictures out of a views folder."""
    content = json.loads((folder / "transforms.json").read_text())
    for frame in content["frames"]:
        for kind in kinds:
            frame.pop(kind, None)
    (folder / "transforms.json").write_text(json.dumps(content))


def _each_color(folder: Path, change) -> None:
    for path in (folder / "color").iterdir():
        write_png(path, change(read_image(path)))


def _opaque(picture: np.ndarray) -> np.ndarray:
    return np.dstack([picture[..., :3], np.full(picture.shape[:2], 255, np.uint8)])


def test_views_that_say_nothing_are_refused(refused, views: Path) -> None:
    _each_color(views, _opaque)
    _drop(views, "depth_file_path", "normal_file_path")
    assert "neither depth nor a mask" in refused("fit-sdf", views).stderr


def test_one_view_is_refused(refused, views: Path) -> None:
    content = json.loads((views / "transforms.json").read_text())
    content["frames"] = content["frames"][:1]
    (views / "transforms.json").write_text(json.dumps(content))
    assert "one view" in refused("fit-sdf", views).stderr


def test_empty_masks_are_refused(refused, views: Path) -> None:
    _each_color(views, np.zeros_like)
    _drop(views, "depth_file_path")
    assert "nowhere to be seen" in refused("fit-sdf", views).stderr


@pytest.mark.parametrize("value", [np.nan, 2.0])
def test_depth_without_a_shape_is_refused(refused, views: Path, value: float) -> None:
    _each_color(views, _opaque)
    for path in (views / "depth").iterdir():
        write_depth(path, np.full((64, 64), value, np.float32))
    refused("fit-sdf", views)


def test_sizes_that_differ_are_refused(refused, views: Path) -> None:
    write_depth(views / "depth" / "left.exr", np.full((32, 32), 2.0, np.float32))
    assert "left" in refused("fit-sdf", views).stderr


@pytest.mark.parametrize("name", ["color/front.png", "depth/front.exr"])
def test_damaged_pictures_are_refused(refused, views: Path, name: str) -> None:
    (views / name).write_bytes((views / name).read_bytes()[:200])
    assert "front" in refused("fit-sdf", views).stderr


def test_cameras_that_look_away_are_refused(refused, views: Path) -> None:
    content = json.loads((views / "transforms.json").read_text())
    for frame in content["frames"]:
        turned = np.array(frame["transform_matrix"])
        turned[:3, [0, 2]] *= -1  # about the picture's vertical
        frame |= {
            "transform_matrix": turned.tolist(),
            "camera_model": "OPENCV",
            "fl_x": 64,
            "fl_y": 64,
            "w": 64,
            "h": 64,
        }
        frame.pop("half_extent")
    content.pop("camera_model")
    (views / "transforms.json").write_text(json.dumps(content))
    assert "look" in refused("fit-sdf", views).stderr


def test_silhouettes_that_leave_nothing_are_refused(refused, views: Path) -> None:
    half = np.arange(64) < 32
    for index, path in enumerate(sorted((views / "color").iterdir())):
        picture = read_image(path)
        picture[..., 3] = np.where(half[:, None] if index % 2 else ~half[:, None], picture[..., 3], 0)
        write_png(path, picture)
    _drop(views, "depth_file_path")
    assert "contradict" in refused("fit-sdf", views).stderr


def test_an_edited_view_is_a_new_input(mv3d, made_views: Path, tmp_path: Path) -> None:
    edited = tmp_path / "edited"
    shutil.copytree(made_views, edited)
    first = mv3d("fit-sdf", edited, "--quick", *SMALL).path
    _each_color(edited, lambda picture: np.dstack([255 - picture[..., :3], picture[..., 3]]))
    ran = mv3d("fit-sdf", edited, "--quick", *SMALL)
    assert ran.path != first
    assert "changed" in ran.stderr


def test_out_of_range_settings_are_refused(refused, views: Path) -> None:
    for option, value in (("--resolution", 8), ("--faces", 1), ("--steps", -1), ("--max-time", -2)):
        refused("fit-sdf", views, option, value)
    refused("fit-sdf", views, "-o", views.parent / "mesh.docx")
    refused("fit-sdf", views.parent / "nothing")
