"""Components, bubbles and pinched edges on solids whose answer is known; trimesh judges the result."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from mv3d_cli.meshes.repair import components, repaired, watertight, welded, without_floaters
from mv3d_cli.meshes.surface import mesh_of
from mv3d_cli.scene.mesh import Mesh


def ball(radius: float, centre: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> trimesh.Trimesh:
    made = trimesh.creation.icosphere(subdivisions=2, radius=radius)
    made.apply_translation(centre)
    return made


def cavity(radius: float) -> trimesh.Trimesh:
    made = ball(radius)
    made.invert()
    return made


def union(*parts: trimesh.Trimesh) -> Mesh:
    joined = trimesh.util.concatenate(parts)
    return mesh_of(joined.vertices, joined.faces)


def judged(mesh: Mesh) -> trimesh.Trimesh:
    bare = welded(mesh)
    return trimesh.Trimesh(bare.vertices, bare.faces, process=False)


def test_small_parts_go_and_large_parts_stay() -> None:
    mesh = union(ball(0.5), ball(0.2, (0.8, 0, 0)), ball(0.02, (0, 0, 0.8)))
    assert components(mesh) == 3
    kept = without_floaters(mesh)
    assert (components(kept), watertight(kept)) == (2, True)
    assert np.isclose(judged(kept).volume, ball(0.5).volume + ball(0.2).volume, rtol=1e-4)
    assert components(without_floaters(mesh, keep=1e-4)) == 3


def test_bubbles_and_what_floats_in_them_go() -> None:
    mesh = union(ball(0.8), cavity(0.6), ball(0.3))
    kept = without_floaters(mesh)
    assert components(kept) == 1
    assert np.isclose(judged(kept).volume, ball(0.8).volume, rtol=1e-4)


def test_a_ring_does_not_enclose_what_stands_in_its_hole() -> None:
    ring = trimesh.creation.torus(0.7, 0.15)
    kept = without_floaters(union(ring, ball(0.3)))
    assert components(kept) == 2


def test_attributes_stay_with_their_vertices() -> None:
    mesh = union(ball(0.02, (0, 0, 0.8)), ball(0.5))
    marked = replace(mesh, uvs=mesh.vertices[:, :2].copy(), colors=np.pad(mesh.vertices, ((0, 0), (0, 1))))
    kept = without_floaters(marked)
    assert kept.uvs is not None
    assert kept.colors is not None
    assert len(kept.vertices) == len(ball(0.5).vertices)
    assert np.array_equal(kept.uvs, kept.vertices[:, :2])
    assert np.array_equal(kept.colors[:, :3], kept.vertices)


def test_watertight_judges_welded_vertices() -> None:
    cube = trimesh.creation.box((1, 1, 1))
    torn = mesh_of(cube.vertices[cube.faces].reshape(-1, 3), np.arange(36).reshape(-1, 3))
    assert watertight(torn)
    assert not watertight(mesh_of(cube.vertices, cube.faces[1:]))
    turned = cube.faces.copy()
    turned[0] = turned[0, ::-1]
    assert not watertight(mesh_of(cube.vertices, turned))


def two_cubes(shift: tuple[float, float, float]) -> Mesh:
    first, second = trimesh.creation.box((1, 1, 1)), trimesh.creation.box((1, 1, 1))
    second.apply_translation(shift)
    return welded(union(first, second))


@pytest.mark.parametrize("shift", [(1.0, 1.0, 0.0), (1.0, 1.0, 1.0)])
def test_cubes_that_touch_are_parted(shift: tuple[float, float, float]) -> None:
    fixed = repaired(two_cubes(shift))
    if shift[2] == 0:  # they share an edge, which belongs to four faces
        assert not watertight(two_cubes(shift))
        assert components(fixed) == 2
    assert watertight(fixed)
    assert np.isclose(judged(fixed).volume, 2, rtol=0.02)


def test_an_edge_whose_sheets_meet_again_at_both_ends_is_parted() -> None:
    blocks = np.ones((3, 3, 1), bool)  # a ring of cubes that is closed by an edge only
    blocks[1, 1] = blocks[0, 0] = False
    mesh = trimesh.voxel.VoxelGrid(blocks).as_boxes()
    mesh.merge_vertices()
    centres = mesh.triangles_center.round(4)
    _, inverse, count = np.unique(centres, axis=0, return_inverse=True, return_counts=True)
    pinched = mesh_of(mesh.vertices, mesh.faces[count[inverse.reshape(-1)] == 1])
    fixed = repaired(pinched)
    assert watertight(fixed)
    assert judged(fixed).is_winding_consistent


def test_holes_are_closed() -> None:
    whole = ball(0.5)
    open_ball = mesh_of(whole.vertices, whole.faces[3:])
    assert not watertight(open_ball)
    fixed = repaired(open_ball)
    assert watertight(fixed)
    assert np.isclose(judged(fixed).volume, whole.volume, rtol=0.02)
