"""Mesh transforms against trimesh."""

from __future__ import annotations

import numpy as np
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from mv3d_cli.scene.conventions import WORLD_FROM_Y_UP
from mv3d_cli.scene.mesh import Material, Mesh, face_normals, transform, unit_sphere_from_mesh


def box() -> Mesh:
    cube = trimesh.creation.box((1.0, 2.0, 3.0))
    faces = cube.faces.astype(np.int32)
    normals = cube.vertex_normals.astype(np.float32)
    zeros = np.zeros(len(faces), np.int32)
    return Mesh(cube.vertices.astype(np.float32), faces, zeros, (Material(),), normals=normals)


def volume(mesh: Mesh) -> float:
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).volume


@given(seed=st.integers(0, 1000))
def test_affine_maps_keep_faces_outwards_and_normals_perpendicular(seed: int) -> None:
    matrix = np.eye(4)
    matrix[:3] = np.random.default_rng(seed).normal(size=(3, 4))
    if abs(np.linalg.det(matrix[:3, :3])) < 0.05:
        return
    moved = transform(box(), matrix)
    assert np.isclose(volume(moved), 6 * abs(np.linalg.det(matrix[:3, :3])), rtol=1e-3)
    assert moved.normals is not None
    reference = trimesh.Trimesh(box().vertices, box().faces, process=False)
    reference.apply_transform(matrix)
    assert np.allclose(np.sort(face_normals(moved), axis=0), np.sort(reference.face_normals, axis=0), atol=1e-3)
    assert np.allclose(np.linalg.norm(moved.normals, axis=1), 1, atol=1e-5)


def test_unit_sphere_ignores_unused_vertices() -> None:
    mesh = box()
    lonely = Mesh(
        np.vstack([mesh.vertices, [[99, 0, 0]]]).astype(np.float32), mesh.faces, mesh.face_material, (Material(),)
    )
    moved = transform(lonely, unit_sphere_from_mesh(lonely)).vertices[:-1]
    assert np.allclose(moved.min(0) + moved.max(0), 0, atol=1e-6)
    assert np.isclose(np.linalg.norm(moved, axis=1).max(), 1, atol=1e-6)


def test_gltf_front_and_up_become_ours() -> None:
    assert np.allclose(WORLD_FROM_Y_UP[:3, :3] @ [0, 0, 1], [0, -1, 0])
    assert np.allclose(WORLD_FROM_Y_UP[:3, :3] @ [0, 1, 0], [0, 0, 1])
