"""`mv3d render`, many meshes: a data set, whatever single meshes do and whenever the run is killed."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from mv3d_cli.formats.images import read_image
from mv3d_cli.formats.views_folder import read_views

TINY = ("--size", 16)
MANY = ("--procedural", 6, "--size", 128)


def digest(folder: Path) -> str:
    return json.loads((folder / "artifact.json").read_text())["digest"]


def started(command: Sequence[object], cache: Path) -> subprocess.Popen[str]:
    """A run with a process group of its own, which is not waited for."""
    return subprocess.Popen(
        [*map(str, command)],
        env={**os.environ, "MV3D_CACHE_DIR": str(cache)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def drawn(cache: Path) -> dict[str, int]:
    """The objects that lie finished in unfinished work, and what tells them from others of the same name."""
    found = cache.glob("v1/render/*/*.work/[!.]*/object.json")
    return {path.parent.name: path.stat().st_ino for path in found}


def wait_for(count: int, cache: Path, process: subprocess.Popen[str]) -> dict[str, int]:
    while len(done := drawn(cache)) < count:
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)
    return done


@pytest.fixture(scope="module")
def command() -> str:
    return str(Path(sys.executable).parent / "mv3d")


@pytest.fixture(scope="module")
def unbroken(command, tmp_path_factory) -> str:
    """The digest of the data set that the broken runs must end with."""
    process = started([command, "render", *MANY], tmp_path_factory.mktemp("unbroken"))
    return digest(Path(process.communicate()[0].strip()))


def test_a_folder_becomes_a_data_set(mv3d, meshes):
    folder = mv3d("render", meshes, *TINY).path
    assert sorted(os.listdir(folder)) == sorted(
        ["ball", "box", "cone", "index.json", "failures.json", "sheet.png", "artifact.json"]
    )
    index = json.loads((folder / "index.json").read_text())["objects"]
    assert [entry["folder"] for entry in index] == ["ball", "box", "cone"]
    assert [entry["faces"] for entry in index] == [320, 12, index[2]["faces"]]
    assert json.loads((folder / "failures.json").read_text()) == []
    assert len(read_views(folder / "cone").frames) == 12


def test_a_folder_of_one_mesh_is_a_data_set_and_that_mesh_is_not(mv3d, ball, tmp_path):
    shutil.copy(ball, tmp_path)
    one, several = mv3d("render", ball, *TINY).path, mv3d("render", tmp_path, *TINY).path
    assert (one / "transforms.json").is_file()
    assert (several / "ball" / "transforms.json").is_file()
    assert (several / "index.json").is_file()


def test_equal_names_are_numbered_and_none_is_lost(mv3d, ball, tmp_path):
    paths = [tmp_path / name / file for name in "ab" for file in ("ball.glb", "index.json.glb")]
    for path in paths:
        path.parent.mkdir(exist_ok=True)
        shutil.copy(ball, path)
    folder = mv3d("render", *paths, *TINY).path
    index = json.loads((folder / "index.json").read_text())["objects"]
    assert [entry["folder"] for entry in index] == ["ball", "index.json_2", "ball_2", "index.json_3"]


def test_rotations_differ(mv3d, meshes):
    folder = mv3d("render", meshes / "box.ply", *TINY, "--rotations", 2, "--jobs", 1).path
    index = json.loads((folder / "index.json").read_text())["objects"]
    assert [(entry["folder"], entry["turn"]) for entry in index] == [("box_r000", 0), ("box_r001", 1)]
    fronts = [read_image(folder / entry["folder"] / "color" / "front.png") for entry in index]
    assert (fronts[0] != fronts[1]).any()


def test_jobs_do_not_change_the_bytes(mv3d, cache_folder):
    words = ("render", "--procedural", 3, *TINY)
    one, two = (mv3d(*words, "--jobs", jobs, env={"MV3D_CACHE_DIR": str(cache_folder / jobs)}).path for jobs in "12")
    assert one != two
    assert digest(one) == digest(two)
    assert [entry["folder"] for entry in json.loads((two / "index.json").read_text())["objects"]] == [
        f"procedural_{i:06d}" for i in range(3)
    ]


def test_a_bad_mesh_does_not_stop_the_others(mv3d, meshes, tmp_path):
    folder = tmp_path / "mixed"
    shutil.copytree(meshes, folder)
    (folder / "bad.glb").write_bytes((folder / "ball.glb").read_bytes()[:500])
    ran = mv3d("render", folder, *TINY)
    assert "1 of 4 objects failed" in ran.stderr
    (failure,) = json.loads((ran.path / "failures.json").read_text())
    assert failure["name"] == "bad"
    assert failure["source"] == str(folder / "bad.glb")
    assert "truncated" in failure["reason"]
    assert failure["hint"]
    assert not (ran.path / "bad").exists()
    assert len(json.loads((ran.path / "index.json").read_text())["objects"]) == 3


def test_a_batch_of_nothing_but_bad_meshes(refused, tmp_path, cache_folder):
    for name in ("a.glb", "b.ply"):
        (tmp_path / name).write_bytes(b"nothing")
    ran = refused("render", tmp_path, *TINY, "-o", tmp_path / "out")
    assert "none of 2 objects" in ran.stderr
    assert not (tmp_path / "out").exists()
    assert not [*cache_folder.rglob("artifact.json")]


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_killed_batch_goes_on_where_it_was(mv3d, command, unbroken, cache_folder, jobs):
    words = ("render", *MANY, "--jobs", jobs)
    process = started([command, *words], cache_folder)
    wait_for(2, cache_folder, process)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    done = drawn(cache_folder)
    assert not [*cache_folder.rglob("artifact.json")]
    folder = mv3d(*words).path
    assert {name: (folder / name / "object.json").stat().st_ino for name in done} == done
    assert digest(folder) == unbroken
    assert json.loads((folder / "artifact.json").read_text())["resumed"] is True


@pytest.mark.parametrize("jobs", [1, 2])
def test_ctrl_c_is_quiet_and_keeps_what_is_done(mv3d, command, unbroken, cache_folder, jobs):
    words = ("render", *MANY, "--jobs", jobs)
    process = started([command, *words], cache_folder)
    wait_for(1, cache_folder, process)
    os.killpg(process.pid, signal.SIGINT)
    stdout, stderr = process.communicate(timeout=20)
    assert (process.returncode, stdout, stderr) == (130, "", "")
    done = drawn(cache_folder)
    assert done
    folder = mv3d(*words).path
    assert {name: (folder / name / "object.json").stat().st_ino for name in done} == done
    assert digest(folder) == unbroken


def test_ctrl_c_while_workers_start(command, cache_folder):
    rng = random.Random(1)
    for _ in range(3):
        process = started([command, "render", *MANY, "--jobs", 2], cache_folder)
        time.sleep(rng.uniform(0.5, 1.2))
        os.killpg(process.pid, signal.SIGINT)
        assert process.communicate(timeout=20) == ("", "")
        assert process.returncode == 130


def test_workers_leave_when_their_parent_is_killed(command, cache_folder):
    process = started([command, "render", "--procedural", 40, "--size", 128, "--jobs", 2], cache_folder)
    wait_for(1, cache_folder, process)
    process.kill()
    process.communicate(timeout=10)  # returns when the last worker has closed its standard error, by leaving


def test_a_single_render_killed_at_any_moment(mv3d, command, ball, cache_folder):
    """20 kills: there is a whole artifact or none, and the next run succeeds and leaves nothing else."""
    rng = random.Random(0)
    digests = set()
    for attempt in range(20):
        cache = cache_folder / str(attempt)
        process = started([command, "render", ball, "--size", 64], cache)
        time.sleep(rng.uniform(0.2, 1.2))
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        for manifest in cache.rglob("artifact.json"):
            if not manifest.parent.name.endswith(".tmp"):
                expected = json.loads(manifest.read_text())
                sizes = {name: (manifest.parent / name).stat().st_size for name in expected["files"]}
                assert sizes == {name: size for name, (_, size) in expected["files"].items()}
                digests.add(expected["digest"])
        if attempt % 5 == 0:
            folder = mv3d("render", ball, "--size", 64, env={"MV3D_CACHE_DIR": str(cache)}).path
            digests.add(digest(folder))
            assert not [*cache.glob("v1/render/*/*.tmp")]
            assert mv3d("cache", "verify", env={"MV3D_CACHE_DIR": str(cache)}).code == 0
    assert len(digests) == 1
