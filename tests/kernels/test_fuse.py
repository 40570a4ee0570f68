"""The fusion's kernel against its torch twin, and against the distances of spheres and boxes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from mv3d_cli.kernels.fuse import Picture, fuse, reference
from mv3d_cli.scene.camera import (
    Camera,
    Orthographic,
    Perspective,
    direction_on_sphere,
    look_at_origin,
    pixel_from_camera,
)

RADIUS = 0.6
PARALLEL, PINHOLE = Orthographic(), Perspective((1.1, 1.0), (0.52, 0.49))
AXES = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))


def grid(resolution: int) -> tuple[np.ndarray, tuple[float, float, float], float]:
    """Points (x, y, z, 3) over [-1, 1], and the arguments that ask for them."""
    voxel = 2 / (resolution - 1)
    axis = -1 + voxel * np.arange(resolution)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1), (-1.0, -1.0, -1.0), voxel


def across(camera: Camera, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """x and y, camera axes, of the pixels' rays: where they start, or at distance 1."""
    (sx, ox), (sy, oy) = pixel_from_camera(camera, width, height)
    y, x = np.indices((height, width)) + 0.5
    return (x - ox) / sx, (y - oy) / sy


def sphere_from(camera: Camera, height: int = 160, width: int = 160, weight: float = 1.0) -> Picture:
    """The sphere about the origin; beyond its silhouette, depth and cosine of the silhouette."""
    x, y = across(camera, height, width)
    far = np.linalg.norm(camera.world_from_camera[:3, 3])
    if isinstance(camera.projection, Perspective):
        reach = RADIUS / np.sqrt(far**2 - RADIUS**2)  # of the silhouette at distance 1
        shrink = np.minimum(1, 0.999 * reach / np.hypot(x, y))
        u, v = x * shrink, y * shrink
        a = 1 + u**2 + v**2
        depth = (far - np.sqrt(far**2 - a * (far**2 - RADIUS**2))) / a
        place, ray = np.stack([u * depth, v * depth, depth - far]), np.stack([u, v, np.ones_like(u)])
    else:
        reach = RADIUS
        shrink = np.minimum(1, 0.999 * reach / np.hypot(x, y))
        u, v = x * shrink, y * shrink
        depth = far - np.sqrt(RADIUS**2 - u**2 - v**2)
        place, ray = np.stack([u, v, depth - far]), np.stack([0 * u, 0 * u, np.ones_like(u)])
    facing = np.abs((place * ray).sum(0)) / RADIUS
    texels = np.stack([depth, facing, np.hypot(x, y) - reach, 0 * depth + 1], axis=-1)
    return Picture(camera, texels.astype(np.float32), True, True, weight)


def eyes(count: int, projection: Orthographic | Perspective, radius: float = 2.0) -> list[Camera]:
    turns = np.linspace(0, 2 * np.pi, count, endpoint=False)
    heights = [0.6 * (-1) ** i for i in range(count)]
    return [
        look_at_origin(f"{i}", direction_on_sphere(turn, height, radius), projection)
        for i, (turn, height) in enumerate(zip(turns, heights, strict=True))
    ]


def noise(camera: Camera, height: int, width: int, rng: np.random.Generator, **known: bool) -> Picture:
    """A picture of nothing in particular, full of steps."""
    x, y = across(camera, height, width)
    depth = 2 + 0.1 * np.sin(5 * x) + np.where(rng.random((height, width)) < 0.1, 0.3, 0)
    outline = np.hypot(x, y) - 0.4 + rng.normal(0, 0.02, x.shape)
    texels = np.stack([depth, rng.uniform(0.2, 1, x.shape), outline, rng.uniform(0, 1, x.shape)], axis=-1).astype(
        np.float32
    )
    if not known["outlined"]:
        texels[..., 2] = -1
    return Picture(camera, texels, **known, weight=rng.uniform(0.2, 2))


def assert_same(ours: np.ndarray, twin: np.ndarray, reach: float) -> None:
    """Equal but for voxels whose nearest texel, or cell, a rounding decides."""
    assert ours.dtype == twin.dtype == np.float32
    assert ours.shape == twin.shape
    assert twin.std() > 0.1 * reach
    assert (np.abs(ours - twin) < 1e-4 * reach + 1e-5).mean() > 0.998


@pytest.mark.parametrize("projection", [PARALLEL, PINHOLE], ids=["orthographic", "perspective"])
@pytest.mark.parametrize(
    "known",
    [{"deep": True, "outlined": True}, {"deep": True, "outlined": False}, {"deep": False, "outlined": True}],
    ids=["both", "depth", "outline"],
)
def test_equals_the_torch_twin(projection, known: dict[str, bool]) -> None:
    rng = np.random.default_rng(1)
    pictures = [noise(camera, 40, 40, rng, **known) for camera in eyes(3, projection)]
    _, origin, voxel = grid(24)
    given = (pictures, 24, origin, voxel, 0.3)
    assert_same(fuse(*given), reference.fuse(*given), 0.3)


def mixed() -> list[Picture]:
    """Pictures of every kind and size."""
    rng = np.random.default_rng(2)
    a, b, c = eyes(3, PARALLEL)
    d, e, f = eyes(3, PINHOLE)
    return [
        noise(a, 30, 50, rng, deep=True, outlined=True),
        noise(d, 64, 20, rng, deep=True, outlined=False),
        sphere_from(b, 48, 40, 0.5),
        noise(e, 17, 33, rng, deep=False, outlined=True),
        replace(sphere_from(f, 96, 80), outlined=False),
        noise(c, 8, 8, rng, deep=False, outlined=False),
    ]


def test_pictures_of_every_kind_and_size_at_once() -> None:
    _, origin, voxel = grid(31)
    given = (mixed(), 31, origin, voxel, 0.25)
    assert_same(fuse(*given), reference.fuse(*given), 0.25)


@pytest.mark.parametrize("projection", [PARALLEL, PINHOLE], ids=["orthographic", "perspective"])
@pytest.mark.parametrize("outlined", [True, False])
def test_a_sphere_has_its_distances(projection, outlined: bool) -> None:
    points, origin, voxel = grid(48)
    reach = 3 * voxel
    pictures = [replace(sphere_from(camera), outlined=outlined) for camera in eyes(12, projection)]
    distance = fuse(pictures, 48, origin, voxel, reach)
    true = np.linalg.norm(points, axis=-1) - RADIUS
    near = np.abs(true) < voxel
    assert np.abs(distance - true)[near].mean() < 0.08 * voxel
    assert np.abs(distance - true)[near].max() < 0.4 * voxel
    assert (distance[true < -0.2 * voxel] < 0).all()
    seen = (true > 0.2 * voxel) & (true < (0.3 if outlined else voxel))  # by some view; what none sees is inside
    assert (distance[seen] > 0).all()
    assert np.abs(distance).max() == pytest.approx(reach, rel=1e-6)


def test_the_hull_of_a_box_is_the_box() -> None:
    half = np.array([0.5, 0.35, 0.42])
    points, origin, voxel = grid(40)
    pictures = []
    for axis in AXES:
        camera = look_at_origin("side", tuple(2.0 * np.array(axis, dtype=float)), PARALLEL)
        x, y = across(camera, 200, 200)
        wide, high = (np.abs(camera.world_from_camera[:3, i]) @ half for i in (0, 1))
        beyond = np.stack([np.abs(x) - wide, np.abs(y) - high])
        outline = np.hypot(*np.maximum(beyond, 0)) + np.minimum(beyond.max(0), 0)
        texels = np.stack([0 * x, 0 * x, outline, 0 * x], axis=-1).astype(np.float32)
        pictures.append(Picture(camera, texels, deep=False, outlined=True))
    reach = 4 * voxel
    distance = fuse(pictures, 40, origin, voxel, reach)
    beyond = np.abs(points) - half
    inside = beyond.max(-1) < 0
    true = np.clip(beyond.max(-1), -reach, reach)
    assert np.array_equal(distance < 0, inside)
    assert np.abs(distance - true)[inside].max() < 2e-3
    beside = (beyond > 0).sum(-1) == 1  # facing one side, the nearest point of the box lies on it
    assert np.abs(distance - true)[beside].max() < 2e-3  # a fifth of a pixel: outlines have creases


def test_nothing_lies_between_two_surfaces() -> None:
    """A wall at z = 2.4 behind a plate at 1.6: the space above the wall, beside the plate, is empty right up to it."""
    camera = Camera("down", np.diag([1.0, -1.0, -1.0, 1.0]) + np.pad([[2.0]], ((2, 1), (3, 0))), PARALLEL)
    x, _ = across(camera, 50, 50)
    texels = np.stack([np.where(x < 0, 1.6, 2.4), np.ones_like(x), 0 * x - 1, 0 * x + 1], axis=-1).astype(np.float32)
    points, origin, voxel = grid(101)
    distance = fuse([Picture(camera, texels, True, False)], 101, origin, voxel, 0.05)
    apart = np.abs(points[..., 0]) > 1e-6  # right above the step, either may be meant
    height = np.where(points[..., 0] < 0, 0.4, -0.4)
    assert (distance[apart & (points[..., 2] > height + 1e-3)] > 0).all()
    assert (distance[apart & (points[..., 2] < height - 1e-3)] < 0).all()


def test_weights_decide_between_views() -> None:
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = 2.0
    camera = Camera("down", pose, PARALLEL)
    low, high = (np.zeros((4, 4, 4), np.float32) + np.float32([depth, 1, -1, 1]) for depth in (2.0, 1.96))
    _, origin, voxel = grid(81)

    def level(first: float, second: float) -> float:
        pictures = [Picture(camera, low, True, False, first), Picture(camera, high, True, False, second)]
        column = fuse(pictures, 81, origin, voxel, 0.2)[40, 40]
        index = int(np.flatnonzero(column > 0)[0])
        return -1 + voxel * (index - column[index] / (column[index] - column[index - 1]))

    assert level(1, 0) == pytest.approx(0.0, abs=1e-5)
    assert level(0, 1) == pytest.approx(0.04, abs=1e-5)
    assert 0.005 < level(3, 1) < 0.0125 < level(1, 1) < level(1, 3) < 0.035


def test_the_same_bytes_each_time() -> None:
    _, origin, voxel = grid(31)
    given = (mixed(), 31, origin, voxel, 0.25)
    assert fuse(*given).tobytes() == fuse(*given).tobytes()


@pytest.mark.cuda
def test_cuda_equals_the_twin() -> None:
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    _, origin, voxel = grid(31)
    given = (mixed(), 31, origin, voxel, 0.25)
    twin = reference.fuse(*given, device="cuda")
    assert_same(fuse(*given, device="cuda:0"), twin, 0.25)
    assert_same(fuse(*given), twin, 0.25)
