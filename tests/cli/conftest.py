"""Small meshes to draw."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh


@pytest.fixture(scope="session")
def meshes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of three good meshes: ball.glb, box.ply, cone.stl."""
    folder = tmp_path_factory.mktemp("meshes")
    ball = trimesh.creation.icosphere(subdivisions=2)
    ball.visual.vertex_colors = np.uint8(np.c_[(ball.vertices + 1) * 127, np.full(len(ball.vertices), 255)])
    ball.export(folder / "ball.glb")
    trimesh.creation.box((1, 2, 3)).export(folder / "box.ply")
    trimesh.creation.cone(1, 2).export(folder / "cone.stl")
    return folder


@pytest.fixture(scope="session")
def ball(meshes: Path) -> Path:
    return meshes / "ball.glb"
