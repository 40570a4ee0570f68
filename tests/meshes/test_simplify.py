"""Fewer faces, the same surface: counts, closure, and distance to analytic shapes."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from mv3d_cli.meshes.repair import components, watertight
from mv3d_cli.meshes.simplify import simplified


@pytest.mark.parametrize("name", ["sphere", "torus"])
def test_smooth_shapes_keep_their_place(name: str, fields, mesh_from) -> None:
    mesh = mesh_from(fields[name])
    fewer = simplified(mesh, 2000)
    assert abs(len(fewer.faces) - 2000) <= 100
    assert watertight(fewer)
    samples, _ = trimesh.sample.sample_surface(
        trimesh.Trimesh(fewer.vertices, fewer.faces, process=False), 20000, seed=0
    )
    assert np.abs(fields[name](samples)).max() < 0.01
    back = trimesh.proximity.ProximityQuery(trimesh.Trimesh(fewer.vertices, fewer.faces, process=False))
    assert np.abs(back.signed_distance(mesh.vertices[::20])).max() < 0.01
    assert fewer.normals is not None


@pytest.mark.parametrize("faces", [4000, 1000, 300])
def test_thin_shapes_stay_closed(faces: int, fields, mesh_from) -> None:
    mesh = mesh_from(fields["wing"], nodes=80)
    fewer = simplified(mesh, faces)
    assert watertight(fewer)
    assert components(fewer) == 1
    assert abs(len(fewer.faces) - faces) <= 0.06 * faces


def test_a_mesh_that_is_small_enough_is_left_alone(fields, mesh_from) -> None:
    mesh = mesh_from(fields["sphere"], nodes=16)
    assert simplified(mesh, 10**6) is mesh


def test_the_same_mesh_gives_the_same_bytes(fields, mesh_from) -> None:
    first, second = (simplified(mesh_from(fields["torus"]), 1500) for _ in range(2))
    assert first.vertices.tobytes() == second.vertices.tobytes()
    assert first.faces.tobytes() == second.faces.tobytes()
