"""Marching cubes against analytic shapes and trimesh's volume; the narrow band against the dense grid."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from mv3d_cli.errors import EmptySurface
from mv3d_cli.meshes.repair import components, watertight
from mv3d_cli.meshes.surface import refine, surface_of_field, surface_of_grid
from mv3d_cli.scene.mesh import Mesh

BOX = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])


def as_trimesh(mesh: Mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


def test_a_torus_has_its_place_volume_and_genus(fields, mesh_from) -> None:
    mesh = mesh_from(fields["torus"])
    found = as_trimesh(mesh)
    assert np.abs(fields["torus"](mesh.vertices)).max() < 0.1 * 2 / 63
    assert np.isclose(found.volume, 2 * np.pi**2 * 0.6 * 0.22**2, rtol=0.02)
    assert found.is_watertight
    assert found.euler_number == 0
    assert mesh.normals is not None
    ring = mesh.vertices * [1, 1, 0] / np.hypot(mesh.vertices[:, :1], mesh.vertices[:, 1:2]) * 0.6
    outwards = (mesh.vertices - ring) / np.linalg.norm(mesh.vertices - ring, axis=1, keepdims=True)
    assert (mesh.normals * outwards).sum(axis=1).min() > 0.95


def test_a_surface_that_leaves_the_grid_is_closed_at_its_border(mesh_from) -> None:
    mesh = mesh_from(lambda p: p[..., 0] + 0.5, nodes=20)
    assert watertight(mesh)
    assert np.isclose(as_trimesh(mesh).volume, 0.5 * 2 * 2, rtol=0.05)


def test_zeros_on_nodes_leave_no_needles(mesh_from) -> None:
    mesh = mesh_from(lambda p: np.abs(p).max(axis=-1) - 0.5, nodes=33)
    assert watertight(mesh)
    assert as_trimesh(mesh).area_faces.min() > 0


def test_a_field_without_inside_is_refused(mesh_from) -> None:
    with pytest.raises(EmptySurface) as refusal:
        mesh_from(lambda p: np.ones(p.shape[:-1]))
    assert refusal.value.hint


@pytest.mark.parametrize("name", ["sphere", "torus"])
def test_the_band_gives_the_dense_surface_from_few_points(name: str, fields) -> None:
    asked = 0

    def field(points: np.ndarray) -> np.ndarray:
        nonlocal asked
        asked += len(points)
        return fields[name](points)

    band = surface_of_field(field, BOX, 64)
    axis = (np.arange(65) * (2 / 64) - 1).astype(np.float32)
    nodes = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    dense = surface_of_grid(fields[name](nodes).astype(np.float32), BOX[0], 2 / 64)
    assert np.array_equal(band.faces, dense.faces)
    assert np.allclose(band.vertices, dense.vertices, atol=1e-5)
    assert asked < 0.4 * 65**3


def test_bounds_need_not_be_a_cube(fields) -> None:
    mesh = surface_of_field(fields["torus"], np.array([[-0.9, -0.85, -0.3], [0.9, 0.87, 0.25]]), 50)
    assert (watertight(mesh), components(mesh)) == (True, 1)
    assert np.abs(fields["torus"](mesh.vertices)).max() < 0.005


def test_refining_finds_the_zero_and_never_makes_it_worse(fields) -> None:
    def curved(points: np.ndarray) -> np.ndarray:  # neither a distance nor linear
        return 3 * (np.linalg.norm(points, axis=-1) ** 3 - 0.343)

    voxel = 0.05
    rough = surface_of_field(fields["sphere"], BOX, 40).vertices
    rough = rough * (1 + np.random.default_rng(0).normal(0, 0.01, (len(rough), 1))).astype(np.float32)
    fine = refine(rough, curved, voxel)
    assert np.abs(np.linalg.norm(fine, axis=1) - 0.7).max() < 1e-3
    assert (np.abs(curved(fine)) <= np.abs(curved(rough)) + 1e-5).all()
    far = refine(rough * 1.3, curved, voxel)
    assert np.linalg.norm(far - rough * 1.3, axis=1).max() <= voxel * 1.001
