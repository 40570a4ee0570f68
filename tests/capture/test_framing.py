"""Framing against a sphere whose place and size are known, and cameras against the pixels they showed before."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mv3d_cli.capture.framing import moved_camera, random_turn, unit_sphere_from_views
from mv3d_cli.errors import BadViews
from mv3d_cli.formats.cameras import load_cameras
from mv3d_cli.scene.camera import (
    Camera,
    Orthographic,
    Perspective,
    direction_on_sphere,
    look_at_origin,
    pixel_from_camera,
)

SIZE = (96, 128)
PROJECTIONS = {"orthographic": Orthographic(2.0), "perspective": Perspective((1.2, 1.6))}


def around(projection: Orthographic | Perspective, count: int = 6, radius: float = 4.0) -> list[Camera]:
    turns = np.linspace(0, 2 * np.pi, count, endpoint=False)
    places = [direction_on_sphere(turn, 0.4 * (-1) ** i, radius) for i, turn in enumerate(turns)]
    return [look_at_origin(f"{i}", place, projection) for i, place in enumerate(places)]


def seen(camera: Camera, centre: np.ndarray, radius: float, size: tuple[int, int] = SIZE) -> np.ndarray:
    """The silhouette of a sphere."""
    (sx, ox), (sy, oy) = pixel_from_camera(camera, size[1], size[0])
    y, x = np.indices(size) + 0.5
    u, v = (x - ox) / sx, (y - oy) / sy
    place = camera.camera_from_world[:3, :3] @ centre + camera.camera_from_world[:3, 3]
    if not isinstance(camera.projection, Perspective):
        return np.hypot(u - place[0], v - place[1]) < radius
    ray = np.stack([u, v, np.ones_like(u)], axis=-1) / np.sqrt(u**2 + v**2 + 1)[..., None]
    return (np.linalg.norm(np.cross(ray, place), axis=-1) < radius) & (ray @ place > 0)


def projected(camera: Camera, points: np.ndarray) -> np.ndarray:
    place = points @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3]
    pixel = pixel_from_camera(camera, SIZE[1], SIZE[0])
    across = place[:, :2] / place[:, 2:] if isinstance(camera.projection, Perspective) else place[:, :2]
    return across * pixel[:, 0] + pixel[:, 1]


@pytest.mark.parametrize("kind", list(PROJECTIONS))
@pytest.mark.parametrize(
    ("scale", "place"), [(1.0, (0.5, -0.3, 0.2)), (13.0, (40.0, 2.0, -7.0)), (0.02, (0.0, 0.0, 0.0))]
)
def test_a_sphere_anywhere_comes_into_the_unit_sphere(kind: str, scale: float, place: tuple[float, ...]) -> None:
    """The scene is a ball of radius 0.8 before cameras that do not look right at it, scaled and moved."""
    ball, radius = np.array([0.2, 0.15, -0.1]), 0.8
    world_from_scene = np.diag([scale, scale, scale, 1.0])
    world_from_scene[:3, 3] = place
    cameras = [moved_camera(camera, world_from_scene) for camera in around(PROJECTIONS[kind])]
    centre = scale * ball + place
    masks = [seen(camera, centre, scale * radius) for camera in cameras]
    frame = unit_sphere_from_views(cameras, masks)
    assert np.linalg.norm(frame[:3, :3] @ centre + frame[:3, 3]) < 0.02
    found = np.cbrt(np.linalg.det(frame[:3, :3])) * scale * radius
    assert 0.93 < found <= 1.0
    assert np.allclose(frame[:3, :3], np.cbrt(np.linalg.det(frame[:3, :3])) * np.eye(3))


@pytest.mark.parametrize("radius", [0.97, 0.7, 0.5])
def test_what_the_rig_sees_stays_where_it_is(radius: float) -> None:
    cameras = load_cameras()
    masks = [seen(camera, np.zeros(3), radius, (64, 64)) for camera in cameras]
    assert np.array_equal(unit_sphere_from_views(cameras, masks), np.eye(4))


def test_views_without_a_mask_do_not_count() -> None:
    cameras, centre = around(PROJECTIONS["perspective"]), np.array([0.4, 0.5, 0.0])
    masks = [seen(camera, centre, 0.3) for camera in cameras]
    frame = unit_sphere_from_views(cameras[:4], masks[:4])
    nothing = np.zeros(SIZE, bool)
    assert not np.array_equal(frame, np.eye(4))
    assert np.array_equal(unit_sphere_from_views(cameras, [*masks[:4], None, nothing]), frame)
    assert np.array_equal(unit_sphere_from_views(cameras[:2], [masks[0], None]), np.eye(4))


@pytest.mark.parametrize("kind", list(PROJECTIONS))
def test_cameras_that_look_away_are_refused(kind: str) -> None:
    """As when OpenGL's axes were meant: the pose is right and the camera looks along -z."""
    away = [
        replace(camera, world_from_camera=camera.world_from_camera @ np.diag([1.0, -1.0, -1.0, 1.0]))
        for camera in around(PROJECTIONS[kind])
    ]
    middle = np.zeros(SIZE, bool)
    middle[30:66, 40:88] = True
    with pytest.raises(BadViews, match="behind") as refusal:
        unit_sphere_from_views(away, [middle] * len(away))
    assert "transform_matrix" in refusal.value.hint


@settings(deadline=None, max_examples=40)
@given(
    kind=st.sampled_from(list(PROJECTIONS)),
    turn=st.tuples(*[st.floats(-3, 3)] * 3),
    scale=st.floats(0.01, 100),
    place=st.tuples(*[st.floats(-50, 50)] * 3),
)
def test_a_moved_camera_sees_the_same_pixels(kind: str, turn: tuple, scale: float, place: tuple) -> None:
    b_from_a = np.eye(4)
    b_from_a[:3, :3] = scale * Rotation.from_rotvec(turn).as_matrix()
    b_from_a[:3, 3] = place
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    for camera in around(PROJECTIONS[kind], 3):
        moved = moved_camera(camera, b_from_a)
        there = points @ b_from_a[:3, :3].T + b_from_a[:3, 3]
        assert np.allclose(projected(moved, there), projected(camera, points), atol=1e-5)
        rotation = moved.world_from_camera[:3, :3]
        assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
        back = moved_camera(moved, np.linalg.inv(b_from_a))
        assert np.allclose(back.world_from_camera, camera.world_from_camera, atol=1e-6)


@given(st.integers(0, 2**32 - 1), st.floats(0, 180))
def test_a_random_turn_is_a_rotation_that_tips_no_further_than_told(seed, tilt):
    turned = random_turn(np.random.default_rng(seed), tilt)
    rotation = turned[:3, :3]
    assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    assert np.array_equal(turned[3], [0, 0, 0, 1])
    assert not turned[:3, 3].any()
    assert np.degrees(np.arccos(np.clip(rotation[2, 2], -1, 1))) <= tilt + 1e-5


def test_random_turns_cover_the_circle():
    headings = [
        np.arctan2(*random_turn(np.random.default_rng(seed), 0.0)[:2, 0][::-1]) for seed in range(400)
    ]  # where the x axis goes
    counts, _ = np.histogram(headings, bins=8, range=(-np.pi, np.pi))
    assert counts.min() > 25
