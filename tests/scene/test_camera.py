"""Cameras against hand-made poses."""

from __future__ import annotations

import numpy as np
import pytest

from mv3d_cli.scene.camera import (
    Orthographic,
    Perspective,
    direction_on_sphere,
    look_at_origin,
    pixel_from_camera,
    projected,
)

FRONT = look_at_origin("front", (0.0, -2.0, 0.0), Orthographic())


def test_front_camera_sees_right_as_right_and_up_as_up() -> None:
    right, up, origin = (FRONT.camera_from_world @ [*p, 1.0] for p in ((1, 0, 0), (0, 0, 1), (0, 0, 0)))
    assert np.allclose(right[:3], [1, 0, 2])
    assert np.allclose(up[:3], [0, -1, 2])
    assert np.allclose(origin[:3], [0, 0, 2])


@pytest.mark.parametrize("position", [(0.0, 0.0, 2.0), (0.0, 0.0, -2.0), (1.0, 2.0, -0.5)])
def test_poses_are_rotations_that_look_at_the_origin(position: tuple[float, float, float]) -> None:
    pose = look_at_origin("any", position, Orthographic()).world_from_camera
    assert np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3))
    assert np.isclose(np.linalg.det(pose[:3, :3]), 1)
    assert np.allclose(pose[:3, 2] * np.linalg.norm(position), -np.array(position))


def test_top_camera_has_the_front_at_the_bottom() -> None:
    top = look_at_origin("top", (0.0, 0.0, 2.0), Orthographic())
    assert np.allclose((top.camera_from_world @ [0, -1, 0, 1])[:3], [0, 1, 2])


def test_pixels_of_both_projections() -> None:
    (sx, ox), (sy, oy) = pixel_from_camera(FRONT, 200, 100)
    assert (sx, ox, sy, oy) == (100, 100, 100, 50)
    pinhole = look_at_origin("p", (0.0, -2.0, 0.0), Perspective((1.5, 2.0), (0.4, 0.6)))
    assert np.allclose(pixel_from_camera(pinhole, 200, 100), [[300, 80], [200, 60]])


def test_directions_turn_counter_clockwise_from_the_front() -> None:
    assert np.allclose(direction_on_sphere(0.0, 0.0), (0, -2, 0))
    assert np.allclose(direction_on_sphere(np.pi / 2, 0.0), (2, 0, 0))
    assert np.allclose(direction_on_sphere(0.0, np.pi / 2, 1.0), (0, 0, 1))


@pytest.mark.parametrize("projection", [Orthographic(0.8), Perspective((1.1, 1.4), (0.45, 0.6))])
def test_projected_points_lie_on_their_pixels_rays(projection: Orthographic | Perspective) -> None:
    camera = look_at_origin("slanted", (1.0, -1.5, 0.7), projection)
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 3))
    (x, y), z = (part.T for part in projected(camera, points, 40, 30))
    (sx, ox), (sy, oy) = pixel_from_camera(camera, 40, 30)
    ray = np.stack([(x - ox) / sx, (y - oy) / sy, np.ones_like(x)], axis=1)
    place = ray * z[:, None] if isinstance(projection, Perspective) else np.column_stack([ray[:, :2], z])
    world = place @ camera.world_from_camera[:3, :3].T + camera.world_from_camera[:3, 3]
    assert world == pytest.approx(points, abs=1e-12)
