"""What a shot sees of points: facing, occlusion and silhouettes, against trimesh's ray caster."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from mv3d_cli.meshes.shots import LEAST, POWER, Shot, sights, witness
from mv3d_cli.meshes.surface import mesh_of, with_normals
from mv3d_cli.scene.camera import Camera, Orthographic, Perspective, look_at_origin

SIZE = 128
CAMERAS = [
    look_at_origin("parallel", (1.2, -1.5, 0.4), Orthographic(1.1)),
    look_at_origin("pinhole", (1.8, -2.2, 0.9), Perspective((1.2, 1.2))),
]


def scene():
    """A ball before a box before nothing."""
    small = trimesh.creation.icosphere(subdivisions=3, radius=0.25)
    small.apply_translation((0.35, -0.45, 0.1))
    block = trimesh.creation.box((0.9, 0.3, 0.9)).subdivide().subdivide().subdivide()
    block.apply_translation((0.0, 0.2, 0.0))
    both = trimesh.util.concatenate([small, block])
    return with_normals(mesh_of(both.vertices, both.faces)), both


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.name)
def test_trust_falls_with_slope_and_ends_where_rays_are_blocked(camera: Camera) -> None:
    mesh, solid = scene()
    points, face = trimesh.sample.sample_surface(solid, 4000, seed=1)
    normals = solid.face_normals[face]
    (sight,) = sights(mesh, [Shot(camera, np.full((SIZE, SIZE, 4), 255, np.uint8))])
    trust = witness(sight, points.astype(np.float32), normals.astype(np.float32)).trust
    towards = camera.world_from_camera[:3, 3] - points
    if isinstance(camera.projection, Orthographic):
        towards = np.broadcast_to(-camera.world_from_camera[:3, 2], points.shape)
    towards = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    facing = (normals * towards).sum(axis=1)
    blocked = solid.ray.intersects_any(points + 1e-3 * normals, towards)
    assert trust[facing <= 0].max() == 0
    clear = (facing > 0.3) & ~blocked
    assert trust[(facing > 0.05) & blocked].max() < 0.05 * np.median(trust[clear])
    assert (trust[clear] > 0).mean() > 0.93  # the others lie within a pixel of an edge
    assert (trust[clear] <= facing[clear] ** POWER + 1e-5).all()
    assert np.isclose(trust[clear], facing[clear] ** POWER, atol=1e-3).mean() > 0.5


def test_what_lies_outside_of_the_picture_or_its_mask_is_unseen() -> None:
    mesh, _ = scene()
    near = replace(CAMERAS[0], projection=Orthographic(0.3))
    color = np.full((SIZE, SIZE, 4), 255, np.uint8)
    color[:, : SIZE // 2, 3] = 0
    (sight,) = sights(mesh, [Shot(near, color)])
    assert mesh.normals is not None
    said = witness(sight, mesh.vertices, mesh.normals)
    inside = mesh.vertices @ near.camera_from_world[:3, :3].T
    assert said.trust[(inside[:, 0] < -0.01) | (np.abs(inside[:, :2]) > 0.31).any(axis=1)].max() == 0
    seen = said.trust > 0.1
    assert seen.any()
    assert (said.color[seen] == 1).all()
    assert 0 < said.trust[said.trust > 0].min() < 10 * LEAST
