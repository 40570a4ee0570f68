"""`mv3d render`, one mesh: what is printed, what is written, and what another run finds."""

from __future__ import annotations

import json
import os
import resource
from pathlib import Path

import numpy as np
import pytest

from mv3d_cli.formats.images import read_depth, read_image
from mv3d_cli.formats.views_folder import read_views
from mv3d_cli.scene.rig import HORIZONTAL

RIG = [*HORIZONTAL, "top", "front_right_top", "front_left_top", "back_right_top"]
SMALL = ("--size", 32)


def digest(folder: Path) -> str:
    return json.loads((folder / "artifact.json").read_text())["digest"]


def inodes(folder: Path) -> dict[str, tuple[int, int]]:
    """What tells whether a file was written again."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {path.relative_to(folder).as_posix(): (path.stat().st_ino, path.stat().st_mtime_ns) for path in files}


def limit_files(size: int):
    """What a process calls before it starts, to be refused files larger than this: as on a full disk."""
    return lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))


def test_stdout_is_the_path_of_a_views_folder(mv3d, ball):
    ran = mv3d("render", ball, *SMALL)
    assert ran.stdout == f"{ran.path}\n"
    assert ran.stderr == ""
    kinds = {"color": "png", "depth": "exr", "normal": "png"}
    files = [f"{kind}/{name}.{end}" for kind, end in kinds.items() for name in RIG]
    assert sorted(inodes(ran.path)) == sorted([*files, "transforms.json", "object.json", "sheet.png", "artifact.json"])
    views = read_views(ran.path)
    assert [view.camera.name for view in views.frames] == RIG
    assert all(view.shape == (32, 32) for view in views.frames)


def test_a_ball_is_a_disc_of_the_known_depth(mv3d, ball):
    folder = mv3d("render", ball, "--size", 64).path
    for name in ("front", "top", "back_right_top"):
        depth = read_depth(folder / "depth" / f"{name}.exr")
        centre = (np.arange(64) + 0.5) / 32 - 1
        radius = np.hypot(*np.meshgrid(centre, centre))
        inside = radius < 0.9
        assert np.abs(depth[inside] - (2 - np.sqrt(1 - radius[inside] ** 2))).max() < 0.06  # of 320 flat faces
        assert not depth[radius > 1.03].any()


def test_a_second_run_finds_the_first(mv3d, ball):
    first = mv3d("render", ball, *SMALL).path
    before = inodes(first)
    assert mv3d("render", ball.parent / "." / ball.name, *SMALL).path == first
    now = inodes(first)
    assert before.pop("artifact.json")[0] == now.pop("artifact.json")[0]  # whose time says when it was last used
    assert before == now


def test_json_is_the_manifest(mv3d, ball, tmp_path):
    ran = mv3d("render", ball, *SMALL, "--json", "-o", tmp_path / "out")
    manifest = json.loads(ran.stdout)
    assert manifest["step"] == "render"
    assert manifest["config"]["size"] == 32
    assert manifest["path"] == str(tmp_path / "out")
    assert manifest["digest"] == digest(tmp_path / "out")
    assert "jobs" not in manifest["config"]


def test_output_is_a_copy(mv3d, ball, tmp_path, cache_folder):
    ran = mv3d("render", ball, *SMALL, "-o", "deep/er/out/", cwd=tmp_path)
    assert ran.path == Path("deep/er/out")
    out = tmp_path / ran.path
    cached = mv3d("render", ball, *SMALL).path
    assert cache_folder in cached.parents
    mine, theirs = inodes(out), inodes(cached)
    assert mine.keys() == theirs.keys()
    assert not {i for i, _ in mine.values()} & {i for i, _ in theirs.values()}
    assert os.listdir(out.parent) == ["out"]


def test_output_again_and_with_other_settings(mv3d, ball, tmp_path):
    out = tmp_path / "out"
    first = digest(mv3d("render", ball, *SMALL, "-o", out).path)
    assert digest(mv3d("render", ball, *SMALL, "-o", out).path) == first
    assert digest(mv3d("render", ball, "--size", 48, "-o", out).path) != first
    assert read_image(out / "color" / "front.png").shape == (48, 48, 4)


def test_an_edited_output_is_not_overwritten(mv3d, refused, ball, tmp_path):
    out = mv3d("render", ball, *SMALL, "-o", tmp_path / "out").path
    (out / "color" / "front.png").write_bytes(b"mine")
    ran = refused("render", ball, *SMALL, "-o", out)
    assert "color/front.png" in ran.stderr
    assert (out / "color" / "front.png").read_bytes() == b"mine"


def test_the_path_may_come_through_a_pipe(mv3d, refused, ball):
    piped = mv3d("render", "-", *SMALL, stdin=f"{ball}\n").path
    assert piped == mv3d("render", ball, *SMALL).path
    assert "no path" in refused("render", "-", *SMALL, stdin="").stderr


def test_views_in_the_order_asked_for(mv3d, ball):
    folder = mv3d("render", ball, *SMALL, "--views", "right, front").path
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    assert [frame["name"] for frame in frames] == ["right", "front"]
    assert sorted(os.listdir(folder / "color")) == ["front.png", "right.png"]


def test_cameras_of_ones_own(mv3d, ball, tmp_path):
    place = {"type": "orthographic", "half_extent": 2}
    rig = {"version": 1, "cameras": [{"name": "far", "position": [0, -5, 0], "projection": place}]}
    (tmp_path / "rig.json").write_text(json.dumps(rig))
    first = mv3d("render", ball, *SMALL, "--cameras", tmp_path / "rig.json").path
    depth = read_depth(first / "depth" / "far.exr")
    assert depth[16, 16] == pytest.approx(4, abs=0.05)
    assert (depth > 0).mean() == pytest.approx(np.pi / 16, abs=0.03)
    rig["cameras"][0]["position"] = [0, -6, 0]
    (tmp_path / "rig.json").write_text(json.dumps(rig))
    second = mv3d("render", ball, *SMALL, "--cameras", tmp_path / "rig.json").path
    assert read_depth(second / "depth" / "far.exr")[16, 16] == pytest.approx(5, abs=0.05)


def test_lighting(mv3d, meshes):
    """Without light a grey box is one grey; the studio's light differs from face to face; seeds draw lights."""

    def colours(*words: object) -> set[tuple[int, ...]]:
        folder = mv3d("render", meshes / "box.ply", *SMALL, "--views", "front_right_top", *words).path
        pixels = read_image(folder / "color" / "front_right_top.png")
        return {tuple(map(int, pixel)) for pixel in pixels[pixels[..., 3] == 255]}

    assert colours("--lighting", "none") == {(128, 128, 128, 255)}
    studio = colours("--lighting", "studio")
    assert len(studio) > 2
    assert colours() != colours("--seed", 1)


def test_same_seed_same_bytes(mv3d, ball, cache_folder):
    runs = [
        mv3d(
            "render",
            ball,
            *SMALL,
            "--rotations",
            2,
            "--jobs",
            1,
            "--seed",
            seed,
            env={"MV3D_CACHE_DIR": str(cache_folder / name)},
        )
        for name, seed in (("a", 7), ("b", 7), ("c", 8))
    ]
    a, b, c = (digest(ran.path) for ran in runs)
    assert a == b != c


def test_a_full_disk(refused, ball, tmp_path, cache_folder):
    out = tmp_path / "out"
    ran = refused("render", ball, "--size", 64, "-o", out, code=1, before=limit_files(1000))
    assert "space" in ran.stderr
    assert not out.exists()
    assert not [*cache_folder.rglob("artifact.json")]
    assert not [*cache_folder.rglob("*.png")]
    assert not [*tmp_path.iterdir()]


def test_a_full_disk_stops_a_batch(refused, mv3d, meshes, cache_folder):
    """No object is at fault, so none is reported as bad; with space, the same command succeeds."""
    for jobs in (1, 2):
        ran = refused("render", meshes, "--size", 64, "--jobs", jobs, code=1, before=limit_files(1000))
        assert "space" in ran.stderr
        assert not [*cache_folder.rglob("artifact.json")]
    folder = mv3d("render", meshes, "--size", 64).path
    assert json.loads((folder / "failures.json").read_text()) == []
