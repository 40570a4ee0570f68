"""`mv3d depth2normal` as a user runs it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from mv3d_cli.formats.images import read_image, write_depth
from mv3d_cli.formats.views_folder import read_views
from mv3d_cli.scene.conventions import normal_from_bytes


@pytest.fixture
def views(mv3d, ball: Path, tmp_path: Path) -> Path:
    """Two views of a ball at 64 px."""
    return mv3d("render", ball, "--size", "64", "--views", "front,top", "-o", tmp_path / "views").path


def test_views_get_the_normals_of_their_depth(mv3d, views: Path, tmp_path: Path) -> None:
    made = mv3d("depth2normal", views, "-o", tmp_path / "normals").path
    assert {path.name for path in made.iterdir()} == {
        "artifact.json", "color", "depth", "normal", "sheet.png", "transforms.json",
    }  # fmt: skip
    for before, after in zip(read_views(views).frames, read_views(made).frames, strict=True):
        assert np.array_equal(before.depth, after.depth)
        assert np.array_equal(before.color, after.color)
        assert before.depth is not None
        inside = before.depth > 0
        cosine = (normal_from_bytes(before.normal) * normal_from_bytes(after.normal)).sum(-1)[inside]
        assert np.rad2deg(np.arccos(cosine.clip(-1, 1))).mean() < 8  # a faceted ball
        assert (after.normal[~inside] == 128).all()


def test_pipes_and_is_kept(mv3d, views: Path) -> None:
    first = mv3d("depth2normal", "-", stdin=f"{views}\n").path
    assert mv3d("depth2normal", views).path == first
    manifest = json.loads(mv3d("depth2normal", views, "--paper", "--json").stdout)
    assert manifest["config"]["paper"] is True
    assert manifest["path"] != str(first)
    why = mv3d("cache", "why", first).stdout
    assert "depth2normal" in why
    assert "render" in why


def test_a_depth_map_alone(mv3d, tmp_path: Path) -> None:
    depth = np.tile(2 + 0.5 * (np.arange(32) + 0.5) / 16, (32, 1)).astype(np.float32)  # slope 1/2 along x
    write_depth(tmp_path / "depth.exr", depth)
    made = mv3d("depth2normal", tmp_path / "depth.exr", "-o", tmp_path / "n.png").path
    normal = normal_from_bytes(read_image(made)[..., :3])
    assert np.abs(normal - np.array([0.5, 0, 1]) / np.sqrt(1.25)).max() < 0.01
    pinhole = mv3d("depth2normal", tmp_path / "depth.exr", "--focal", "16").path
    assert not np.array_equal(read_image(pinhole / "normal.png"), read_image(made))


def test_an_edited_view_is_a_new_input(mv3d, views: Path) -> None:
    before = mv3d("depth2normal", views).path
    depth = np.full((64, 64), 2.0, np.float32)
    write_depth(views / "depth" / "front.exr", depth)
    again = mv3d("depth2normal", views)
    assert again.path != before
    assert "was changed since it was made" in again.stderr


@pytest.mark.parametrize(
    ("spoil", "word"),
    [
        (lambda views: shutil.rmtree(views / "depth"), "depth"),
        (lambda views: (views / "depth" / "top.exr").write_bytes(b"no picture"), "top.exr"),
        (lambda views: (views / "color" / "top.png").write_bytes(b"no picture"), "top.png"),
        (lambda views: (views / "transforms.json").unlink(), "transforms.json"),
        (lambda views: write_depth(views / "depth" / "top.exr", np.ones((8, 8), np.float32)), "top"),
    ],
    ids=["no depth", "corrupted EXR", "corrupted PNG", "no transforms", "another size"],
)
def test_bad_views(refused, views: Path, tmp_path: Path, spoil, word: str) -> None:
    spoil(views)
    assert word in refused("depth2normal", views, "-o", tmp_path / "out").stderr
    assert not (tmp_path / "out").exists()


def test_bad_depth_maps(refused, tmp_path: Path) -> None:
    write_depth(tmp_path / "nothing.exr", np.full((8, 8), np.nan, np.float32))
    assert "no surface" in refused("depth2normal", tmp_path / "nothing.exr").stderr
    assert "missing.exr" in refused("depth2normal", tmp_path / "missing.exr").stderr
    assert "--sigma" in refused("depth2normal", tmp_path / "nothing.exr", "--sigma", "-1").stderr
