"""The main job as a new user does it: a photo, the bundled model, a mesh; offline."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from skimage import data

from mv3d_cli.capture.rendering import render
from mv3d_cli.diffusion.model.checkpoint import record_of_weights, weights_of
from mv3d_cli.formats.assets import asset
from mv3d_cli.formats.cameras import load_cameras, select
from mv3d_cli.formats.meshes import find_meshes, read_mesh
from mv3d_cli.formats.views_folder import read_views
from mv3d_cli.meshes.repair import watertight
from mv3d_cli.metrics.overlap import iou
from mv3d_cli.scene.rig import HORIZONTAL

CUP = Path(data.__path__[0]) / "coffee.png"


@pytest.fixture(scope="module")
def places(mv3d, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """(views of a coffee cup, its mesh)."""
    folder = tmp_path_factory.mktemp("job")
    offline = {"MV3D_CACHE_DIR": str(folder / "cache"), "HF_HUB_OFFLINE": "1"}
    made = mv3d("generate", CUP, "-o", folder / "views", env=offline)
    assert made.code == 0, made.stderr
    fitted = mv3d("fit-sdf", made.path, "--quick", "-o", folder / "cup.glb", env=offline)
    assert fitted.code == 0, fitted.stderr
    return made.path, fitted.path


def test_the_views_are_whole(places) -> None:
    views = read_views(places[0])
    assert tuple(view.camera.name for view in views.frames) == HORIZONTAL
    for view in views.frames:
        assert view.depth is not None
        assert view.color is not None
        assert 0.02 < (view.depth > 0).mean() < 0.6, view.camera.name
    names = {path.name for path in places[0].iterdir()}
    assert names >= {"input.png", "mask.png", "sheet.png", "transforms.json", "artifact.json"}


def test_the_mesh_is_closed_and_fills_the_photos_outline(places) -> None:
    mesh = read_mesh(find_meshes(places[1])[0])
    assert watertight(mesh)
    front = read_views(places[0]).frames[0].color
    drawn = render(mesh, select(load_cameras(), ("front",)), 256, None).frames[0].color
    assert front is not None
    assert drawn is not None
    assert iou(front[..., 3] > 127, drawn[..., 3] > 127) > 0.85


def test_the_bundled_model_says_how_it_was_made() -> None:
    stages = record_of_weights(weights_of(asset("weights/small")))
    assert [stage["stage"] for stage in stages][:2] == ["autoencoder", "2"]
    assert all(stage["objects"] > 0 for stage in stages)
    config = json.loads((asset("weights/small") / "config.json").read_text())
    assert config["picture_size"] == 256
    assert config["drafts"]
