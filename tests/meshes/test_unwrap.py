"""Atlases judged by drawing them: no face covers another, charts keep their shape, the surface is the same."""

from __future__ import annotations

import numpy as np
import pytest

from mv3d_cli.kernels.rasterize import rasterize
from mv3d_cli.meshes.repair import watertight
from mv3d_cli.meshes.simplify import simplified
from mv3d_cli.meshes.unwrap import unwrapped, uv_camera
from mv3d_cli.scene.mesh import Mesh

SIZE = 512


def coil(points: np.ndarray) -> np.ndarray:
    """A flat band wound up like a snail: seen along its axis or across, it covers itself."""
    radius, angle = np.hypot(points[..., 0], points[..., 1]), np.arctan2(points[..., 1], points[..., 0])
    turn = 0.2 * (angle / (2 * np.pi))
    nearest = np.abs((radius - turn + 0.1) % 0.2 - 0.1)
    return np.maximum.reduce([nearest - 0.05, np.abs(points[..., 2]) - 0.3, radius - 0.75])


def uv_area(mesh: Mesh) -> np.ndarray:
    assert mesh.uvs is not None
    a, b, c = (mesh.uvs[mesh.faces[:, i]].astype(np.float64) for i in range(3))
    return 0.5 * np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])


@pytest.fixture(scope="module", params=["sphere", "torus", "wing", "coil"])
def laid(request, fields, mesh_from) -> tuple[Mesh, Mesh]:
    mesh = simplified(mesh_from({**fields, "coil": coil}[request.param]), 5000)
    return mesh, unwrapped(mesh, SIZE)


def test_the_surface_is_the_same(laid: tuple[Mesh, Mesh]) -> None:
    mesh, flat = laid
    assert np.array_equal(flat.vertices[flat.faces], mesh.vertices[mesh.faces])
    assert flat.normals is not None
    assert watertight(flat)
    assert flat.uvs is not None
    assert flat.uvs.min() >= 0
    assert flat.uvs.max() <= 1


def test_hardly_a_texel_belongs_to_two_faces(laid: tuple[Mesh, Mesh]) -> None:
    _, flat = laid
    assert flat.uvs is not None
    seen = rasterize(np.pad(flat.uvs, ((0, 0), (0, 1))), flat.faces, [uv_camera()], SIZE, SIZE).face[0] >= 0
    assert seen.mean() > 0.3
    assert abs(uv_area(flat).sum() - seen.mean()) < 0.02 * seen.mean()


def test_charts_keep_areas_within_what_one_axis_allows(laid: tuple[Mesh, Mesh]) -> None:
    _, flat = laid
    a, b, c = (flat.vertices[flat.faces[:, i]].astype(np.float64) for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    stretch = uv_area(flat) / np.maximum(area, 1e-12)
    stretch /= np.median(stretch)
    assert np.average((stretch > 0.3) & (stretch < 1.6), weights=area) > 0.97


def test_the_same_mesh_gives_the_same_bytes(laid: tuple[Mesh, Mesh]) -> None:
    mesh, flat = laid
    again = unwrapped(mesh, SIZE)
    assert flat.uvs is not None
    assert again.uvs is not None
    assert again.uvs.tobytes() == flat.uvs.tobytes()
