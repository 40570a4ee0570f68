"""Simple objects to learn from, a little model, and settings of a few small steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import trimesh

from mv3d_cli.diffusion.model import Model
from mv3d_cli.diffusion.model.checkpoint import load_model
from mv3d_cli.formats.meshes import MeshFile, find_meshes
from mv3d_cli.steps.train import Config
from mv3d_cli.steps.train.sources import Source

SETTINGS = Config(views=("front", "right"), batch=2, steps=3, jobs=0, device="cpu", precision="fp32")


@pytest.fixture
def settings(little: Path) -> Callable[..., Config]:
    """settings(steps=5): a few small steps from the little model on the processor, with those changes."""

    def made(**changes: object) -> Config:
        return replace(SETTINGS, **{"from_": str(little), **changes})

    return made


@pytest.fixture
def model(little: Path) -> Model:
    return load_model(little)


@pytest.fixture(scope="session")
def meshes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of two good meshes: box.ply and cone.glb."""
    folder = tmp_path_factory.mktemp("meshes")
    trimesh.creation.box((1, 2, 3)).export(folder / "box.ply")
    trimesh.creation.cone(1, 2).export(folder / "cone.glb")
    return folder


@pytest.fixture(scope="session")
def objects(tmp_path_factory: pytest.TempPathFactory) -> list[Source]:
    """Five boxes of different shapes."""
    folder = tmp_path_factory.mktemp("boxes")
    for number in range(5):
        trimesh.creation.box((1, 1 + number / 3, 2)).export(folder / f"{number}.ply")
    return [Source(file.name, file.name, mesh=file) for file in find_meshes(folder)]


@pytest.fixture
def broken(tmp_path: Path) -> Source:
    """A mesh file that cannot be read."""
    path = tmp_path / "broken.glb"
    path.write_bytes(b"glTF")
    return Source("broken", "b", mesh=MeshFile("broken", path))
