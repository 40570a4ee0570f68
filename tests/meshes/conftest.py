"""Analytic fields and meshes that the tests of this folder share."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from mv3d_cli.meshes.surface import surface_of_grid
from mv3d_cli.scene.mesh import Mesh

Field = Callable[[np.ndarray], np.ndarray]


def _sphere(points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points, axis=-1) - 0.7


def _torus(points: np.ndarray) -> np.ndarray:
    ring = np.hypot(points[..., 0], points[..., 1]) - 0.6
    return np.hypot(ring, points[..., 2]) - 0.22


def _wing(points: np.ndarray) -> np.ndarray:
    """A thin plate on a rod: what simplification likes to tie into itself."""
    plate = np.abs(points) - [0.8, 0.5, 0.022]
    rod = np.hypot(points[..., 0], points[..., 1]) - 0.1
    capped = np.maximum(rod, np.abs(points[..., 2]) - 0.7)
    return np.minimum(np.maximum.reduce([plate[..., 0], plate[..., 1], plate[..., 2]]), capped)


@pytest.fixture(scope="session")
def fields() -> dict[str, Field]:
    return {"sphere": _sphere, "torus": _torus, "wing": _wing}


@pytest.fixture(scope="session")
def mesh_from() -> Callable[..., Mesh]:
    """The mesh of a field on a grid over [-1, 1]: mesh_from(field, nodes=64)."""

    def mesh(field: Field, nodes: int = 64) -> Mesh:
        axis = np.linspace(-1, 1, nodes)
        grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
        return surface_of_grid(field(grid).astype(np.float32), np.full(3, -1.0), 2 / (nodes - 1))

    return mesh
