"""Training examples of a sphere, whose silhouette tells its size, and turns that are read off their matrices."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from mv3d_cli.capture.examples import (
    BACKGROUNDS,
    EVALUATION,
    Drawing,
    Example,
    composited,
    example_from_mesh,
    example_from_views,
    photographed,
)
from mv3d_cli.errors import BadMesh
from mv3d_cli.formats.cameras import load_cameras
from mv3d_cli.scene.camera import look_at_origin
from mv3d_cli.scene.mesh import Material, Mesh
from mv3d_cli.scene.views import View, Views

SIZE = 96
CAMERAS = load_cameras()[:3]
SEEDS = st.integers(0, 2**32 - 1)


def mesh_of(solid: trimesh.Trimesh) -> Mesh:
    faces = solid.faces.astype(np.int32)
    return Mesh(solid.vertices.astype(np.float32), faces, np.zeros(len(faces), np.int32), (Material(),))


@pytest.fixture(scope="module")
def ball() -> Mesh:
    """Somewhere else and of another size: it has to be brought into place."""
    return mesh_of(trimesh.creation.icosphere(subdivisions=3, radius=7.0).apply_translation([3.0, -2.0, 5.0]))


@pytest.fixture(scope="module")
def slab() -> Mesh:
    """Its six sides are told apart by their sizes."""
    return mesh_of(trimesh.creation.box((0.5, 1.0, 1.6)))


def drawn(mesh: Mesh, seed: int, **settings: object) -> Example:
    return example_from_mesh(mesh, CAMERAS, replace(Drawing(size=SIZE), **settings), np.random.default_rng(seed))


def same(one: Example, other: Example) -> bool:
    return all(np.array_equal(value, getattr(other, name)) for name, value in vars(one).items())


@given(SEEDS, st.floats(0, 89))
def test_a_turn_is_a_rotation_whose_height_is_within_bounds(seed: int, elevation: float) -> None:
    turned = photographed(np.random.default_rng(seed), elevation)
    rotation = turned[:3, :3]
    assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    assert np.array_equal(turned[3], [0, 0, 0, 1])
    assert not turned[:3, 3].any()
    top = rotation[:, 2]
    height = np.degrees(np.arcsin(np.clip(-top[1], -1, 1)))
    assert -elevation / 3 - 1e-6 <= height <= elevation + 1e-6


def test_most_photos_are_taken_from_above_and_show_the_top() -> None:
    """A face is seen from -Y where its normal's y is negative; the mean of the triangle's corners is its own."""
    tops = np.stack([photographed(np.random.default_rng(seed), 30.0)[:3, 2] for seed in range(3000)])
    heights = np.degrees(np.arcsin(-tops[:, 1]))
    assert heights.mean() == pytest.approx((-10 + 0 + 30) / 3, abs=0.5)
    assert heights.min() < -8
    assert heights.max() > 26
    assert np.histogram(heights, bins=8, range=(-10, 30))[0].argmax() in (1, 2)  # the two that meet at level
    assert CAMERAS[0].world_from_camera[1, 3] < 0


def test_a_photo_from_above_is_a_camera_that_rises() -> None:
    """The turned object before the level camera is the object before a camera of that height."""
    from_above = [photographed(np.random.default_rng(seed), 60.0)[:3, :3] for seed in range(20)]
    for rotation in (r for r in from_above if -r[1, 2] > 0.3):
        eye = rotation.T @ np.array([0.0, -2.0, 0.0])
        assert eye[2] == pytest.approx(2 * -rotation[1, 2])
        risen = look_at_origin("risen", tuple(eye), CAMERAS[0].projection).world_from_camera[:3, :3]
        roll = np.linalg.inv(risen) @ rotation.T @ CAMERAS[0].world_from_camera[:3, :3]
        assert abs(np.degrees(np.arctan2(roll[1, 0], roll[0, 0]))) < 15  # not held quite straight
        assert roll[2, 2] == pytest.approx(1)


def test_without_elevation_photos_are_level_and_from_all_around() -> None:
    turns = np.stack([photographed(np.random.default_rng(seed), 0.0) for seed in range(400)])
    assert np.abs(turns[:, 1, 2]).max() < 1e-12
    rolls = np.degrees(np.arctan2(turns[:, 0, 2], turns[:, 2, 2]))
    assert 2.5 < rolls.std() < 3.5
    counts, _ = np.histogram(np.arctan2(turns[:, 1, 0], turns[:, 1, 1]), bins=8, range=(-np.pi, np.pi))
    assert counts.min() > 25


def test_an_example_is_a_photo_with_as_many_views_as_cameras(ball: Mesh) -> None:
    example = drawn(ball, 0)
    assert example.photo.shape == (SIZE, SIZE, 3)
    assert example.color.shape == (3, SIZE, SIZE, 3)
    assert example.depth.shape == (3, SIZE, SIZE)
    assert example.depth.dtype == np.float32
    poses = np.stack([camera.world_from_camera for camera in CAMERAS])
    assert np.array_equal(example.world_from_camera, poses.astype(np.float32))


@pytest.mark.parametrize("varied", [True, False])
def test_the_same_numbers_give_the_same_bytes(slab: Mesh, varied: bool) -> None:
    one, again, other = (drawn(slab, seed, varied=varied) for seed in (5, 5, 6))
    assert same(one, again)
    assert not np.array_equal(one.depth, other.depth)


def test_the_photo_is_the_first_view_and_only_the_photo_is_spoilt(slab: Mesh) -> None:
    clean = drawn(slab, 3, varied=False)
    assert np.array_equal(clean.photo, clean.color[0])
    assert not np.array_equal(clean.color[0], clean.color[1])
    spoilt = [drawn(slab, seed) for seed in range(8)]
    off = [np.abs(example.photo.astype(int) - example.color[0]).mean() for example in spoilt]
    assert np.median(off) > 0.5
    assert max(off) < 25


def test_in_evaluation_an_object_is_always_the_same(slab: Mesh) -> None:
    """As it stands, as large as it can be: the slab's broad side before the camera, its corners at radius 1."""
    one, other = (drawn(slab, seed, **EVALUATION) for seed in (0, 1))
    assert same(one, other)
    half = np.array([0.5, 1.0, 1.6]) / np.linalg.norm([0.5, 1.0, 1.6])
    seen = one.depth[0] > 0
    columns, rows = np.flatnonzero(seen.any(axis=0)), np.flatnonzero(seen.any(axis=1))
    assert len(columns) == pytest.approx(half[0] * SIZE, abs=1.01)
    assert len(rows) == pytest.approx(half[2] * SIZE, abs=1.01)
    assert one.depth[0][seen] == pytest.approx(2 - half[1], abs=1e-4)


def test_the_radius_is_drawn_between_the_least_and_one(ball: Mesh) -> None:
    radii = []
    for seed in range(12):
        depth = drawn(ball, seed, least=0.5, lighting="none").depth
        by_silhouette = 2 / SIZE * np.sqrt((depth > 0).sum(axis=(1, 2)) / np.pi)
        by_depth = 2 - np.where(depth > 0, depth, 9).min(axis=(1, 2))
        assert by_silhouette == pytest.approx(by_depth, abs=0.02)
        radii.append(by_depth.mean())
    assert 0.49 < min(radii) < 0.65
    assert 0.85 < max(radii) <= 1.0
    assert (2 - drawn(ball, 0, least=1.0).depth[0][SIZE // 2, SIZE // 2]) == pytest.approx(1, abs=0.01)


def test_one_background_for_photo_and_views_any_of_three(ball: Mesh) -> None:
    seen = set()
    for seed in range(20):
        example = drawn(ball, seed, least=0.6)
        corners = np.concatenate([example.photo[None], example.color])[:, [0, 0, -1, -1], [0, -1, 0, -1]]
        assert len(np.unique(corners)) == 1
        seen.add(int(corners[0, 0, 0]))
    assert seen == set(BACKGROUNDS.values())
    assert all((drawn(ball, seed, varied=False).photo[0, 0] == 255).all() for seed in range(3))


def test_the_light_is_drawn_too(ball: Mesh) -> None:
    """A sphere looks the same from everywhere: only the light tells the draws apart."""
    settings = {"elevation": None, "least": 1.0, "varied": False}
    one, other = (drawn(ball, seed, lighting="random", **settings) for seed in (0, 1))
    assert np.array_equal(one.depth, other.depth)
    assert np.abs(one.color.astype(int) - other.color).max() > 20
    albedo = drawn(ball, 0, lighting="none", **settings)
    assert (albedo.color[:, SIZE // 2, SIZE // 2] == 255).all()


def test_views_are_taken_as_they_come() -> None:
    rng = np.random.default_rng(0)
    colors = rng.integers(0, 256, (2, 8, 8, 4), np.uint8)
    depths = rng.uniform(1, 3, (2, 8, 8))
    views = Views(tuple(View(c, color, depth) for c, color, depth in zip(CAMERAS[:2], colors, depths, strict=True)))
    example = example_from_views(views, Drawing(size=64, varied=False), rng)
    assert np.array_equal(example.photo, composited(colors[0], 255))
    assert np.array_equal(example.color, np.stack([composited(color, 255) for color in colors]))
    assert np.array_equal(example.depth, depths.astype(np.float32))


def test_compositing_is_the_rounded_blend() -> None:
    """Against exact fractions for every colour, alpha and background."""
    color, alpha = np.meshgrid(np.arange(256), np.arange(256))
    pixels = np.dstack([color, color, color, alpha]).astype(np.uint8)
    for background in BACKGROUNDS.values():
        exact = (color * alpha + background * (255.0 - alpha)) / 255
        actual = composited(pixels, background)
        assert np.abs(actual - exact[..., None]).max() <= 0.5 + 1e-9


def test_a_mesh_without_extent_is_refused(slab: Mesh) -> None:
    with pytest.raises(BadMesh, match="no extent"):
        drawn(replace(slab, vertices=np.zeros_like(slab.vertices)), 0)
