"""Normals from depth against planes, spheres and steps whose normals are known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from mv3d_cli.capture.normals import normals_from_depth, paper_normals
from mv3d_cli.scene.camera import Camera, Orthographic, Perspective, look_at_origin, pixel_from_camera

SIZE = 64
CAMERAS = {
    "orthographic": look_at_origin("a", (0.0, -2.0, 0.0), Orthographic(0.8)),
    "perspective": look_at_origin("b", (0.0, -2.0, 0.0), Perspective((1.3, 1.1), (0.4, 0.55))),
}


def rays(camera: Camera, size: int = SIZE) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions (z = 1) through the pixel centres, OpenCV camera axes."""
    (sx, ox), (sy, oy) = pixel_from_camera(camera, size, size)
    x, y = np.meshgrid((np.arange(size) + 0.5 - ox) / sx, (np.arange(size) + 0.5 - oy) / sy)
    across, forward = np.stack([x, y, np.zeros_like(x)], -1), np.array([0.0, 0.0, 1.0])
    if isinstance(camera.projection, Perspective):
        return np.zeros_like(across), across + forward
    return across, np.broadcast_to(forward, across.shape)


def plane_depth(camera: Camera, normal: np.ndarray, distance: float) -> np.ndarray:
    """Planar z of the plane that has `normal` (OpenCV axes) and passes (0, 0, distance)."""
    origin, direction = rays(camera)
    return ((np.array([0, 0, distance]) - origin) @ normal) / (direction @ normal)


def viewer(normal: np.ndarray) -> np.ndarray:
    """OpenCV axes to the viewer's."""
    return normal * [1, -1, -1]


def angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.rad2deg(np.arccos(np.clip((a * b).sum(-1), -1, 1)))


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
@settings(deadline=None, max_examples=15)
@given(x=st.floats(-0.6, 0.6), y=st.floats(-0.6, 0.6), distance=st.floats(2.0, 4.0), sigma=st.sampled_from([0.0, 1.0]))
def test_planes_are_exact_up_to_the_border(camera: Camera, x: float, y: float, distance: float, sigma: float) -> None:
    normal = np.array([x, y, -1.0]) / np.linalg.norm([x, y, -1.0])
    depth = plane_depth(camera, normal, distance)
    assert (depth > 0).all()
    assert angle(normals_from_depth(depth, camera, sigma=sigma), viewer(normal)).max() < 0.06  # as float32 angles go


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
@pytest.mark.parametrize("steps", [0, 255], ids=["exact", "8 bits"])
def test_sphere(camera: Camera, steps: int) -> None:
    origin, direction = rays(camera, 256)
    centre, radius = np.array([0, 0, 2.0]), 0.7
    a, b = (direction**2).sum(-1), (direction * (centre - origin)).sum(-1)
    root = b**2 - a * (((centre - origin) ** 2).sum(-1) - radius**2)
    inside = root > 0
    depth = np.where(inside, (b - np.sqrt(np.maximum(root, 0))) / a, 0)
    truth = viewer((origin + depth[..., None] * direction - centre) / radius)
    seen = np.where(inside, 1 + np.round((depth - 1) / 2 * steps) / steps * 2, 0) if steps else depth
    normals = normals_from_depth(seen, camera, sigma=2.0 if steps else 1.0)
    assert angle(normals, truth)[inside].mean() < (2.0 if steps else 0.3)
    assert not normals[~inside].any()


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_steps_and_silhouettes_stay_sharp(camera: Camera) -> None:
    """A near plate before a far plate before nothing: every pixel has its own plate's normal."""
    near, far = np.array([0.3, 0.1, -1.0]), np.array([-0.4, 0.2, -1.0])
    near, far = near / np.linalg.norm(near), far / np.linalg.norm(far)
    depth = plane_depth(camera, far, 3.0)
    depth[20:44, 20:44] = plane_depth(camera, near, 1.8)[20:44, 20:44]
    depth[:, :10] = 0
    truth = np.broadcast_to(viewer(far), (SIZE, SIZE, 3)).copy()
    truth[20:44, 20:44] = viewer(near)
    off = angle(normals_from_depth(depth, camera), truth)[depth > 0]
    assert np.percentile(off, 99) < 1.0
    assert off.max() < 10.0


def test_lonely_pixels_lines_and_bad_values() -> None:
    depth = np.zeros((9, 9))
    depth[2, 2] = 1.5  # nothing around it: it faces the viewer
    depth[6, :] = 2 + 0.01 * np.arange(9)
    depth[0, 0], depth[0, 1] = np.nan, np.inf
    normals = normals_from_depth(depth, look_at_origin("a", (0.0, -2.0, 0.0), Orthographic(0.09)))
    assert np.isfinite(normals).all()
    assert np.allclose(normals[2, 2], [0, 0, 1], atol=1e-6)
    slope = np.array([0.5, 0, 1]) / np.linalg.norm([0.5, 0, 1])
    assert np.allclose(normals[6], slope, atol=0.02)
    assert not normals[0].any()


def test_noise_is_filtered() -> None:
    camera = CAMERAS["orthographic"]
    noisy = plane_depth(camera, np.array([0.2, 0.0, -1.0]), 2.0) + np.random.default_rng(0).normal(0, 0.004, (64, 64))
    truth = viewer(np.array([0.2, 0.0, -1.0]) / np.linalg.norm([0.2, 0.0, -1.0]))
    raw, filtered = (angle(normals_from_depth(noisy, camera, sigma=s), truth).mean() for s in (0.0, 2.0))
    assert filtered < 2.5
    assert raw > 3 * filtered


def test_paper_recipe_by_its_formula() -> None:
    depth = np.zeros((16, 16))
    depth[4:12, 4:12] = 1.5 + 0.02 * np.arange(8)
    eight_bits = np.where(depth > 0, np.round((depth - 1) / 2 * 255), 255)
    down, right = np.gradient(gaussian_filter(eight_bits, 1))
    length = np.sqrt(right**2 + down**2 + 4)
    expected = np.round((np.stack([right, -down, np.full((16, 16), 2.0)], -1) / length[..., None] + 1) * 127.5)
    assert np.array_equal(paper_normals(depth), expected.astype(np.uint8))
