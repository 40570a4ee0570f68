"""Insides against trimesh's watertight meshes and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from mv3d_cli.metrics.overlap import iou, occupancy


def centres(resolution: int, extent: float = 1.0) -> np.ndarray:
    """Cell centres (x, y, z, 3)."""
    line = extent * ((np.arange(resolution) + 0.5) * 2 / resolution - 1)
    return np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1)


@settings(max_examples=20, deadline=None)
@given(st.tuples(*[st.floats(-0.3, 0.3)] * 3), st.floats(0.2, 0.6))
def test_a_sphere_holds_the_cells_nearer_than_its_radius(centre: tuple[float, float, float], radius: float):
    sphere = trimesh.creation.icosphere(4, radius)
    inside = occupancy(sphere.vertices + centre, sphere.faces, 32)
    distance = np.linalg.norm(centres(32) - centre, axis=-1)
    assert inside[distance < 0.995 * radius].all()
    assert not inside[distance > radius].any()


def test_axes_and_extent():
    box = trimesh.creation.box(bounds=[[-1.5, -0.5, 0.2], [0.4, 1.0, 1.1]])
    inside = occupancy(box.vertices, box.faces, 40, extent=2.0)
    place = centres(40, 2.0)
    expected = ((place > box.bounds[0]) & (place < box.bounds[1])).all(axis=-1)
    np.testing.assert_array_equal(inside, expected)


def test_a_box_along_the_grid_has_no_streaks():
    """Edges and diagonals that pass through cell centres are met once."""
    box = trimesh.creation.box((1.0 + 1 / 16,) * 3)
    inside = occupancy(box.vertices, box.faces, 32)
    away = (np.abs(np.abs(centres(32)) - (1 + 1 / 16) / 2) > 1e-3).all(axis=-1)
    expected = (np.abs(centres(32)) < (1 + 1 / 16) / 2).all(axis=-1)
    np.testing.assert_array_equal(inside[away], expected[away])


def test_a_hole_lets_nothing_out():
    sphere = trimesh.creation.icosphere(4, 0.7)
    whole = occupancy(sphere.vertices, sphere.faces, 32)
    torn = sphere.faces[sphere.triangles_center[:, 2] < 0.66]
    assert len(torn) < len(sphere.faces)
    np.testing.assert_array_equal(occupancy(sphere.vertices, torn, 32), whole)


def test_iou_of_two_spheres_is_the_ratio_of_their_volumes():
    one, other = (trimesh.creation.icosphere(4, radius) for radius in (0.8, 0.7))
    insides = [occupancy(mesh.vertices, mesh.faces, 64) for mesh in (one, other)]
    assert iou(*insides) == pytest.approx((0.7 / 0.8) ** 3, abs=0.005)
    assert iou(insides[0], insides[0]) == 1
    assert iou(insides[0], ~insides[0]) == 0
    assert iou(np.zeros(3, bool), np.zeros(3, bool)) == 1
