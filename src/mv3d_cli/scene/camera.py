"""Cameras: a pose in the world and a projection, orthographic or perspective.

A camera knows no picture size: projections are fractions of the picture's width, so one rig serves any resolution.
Axes as in `conventions`: OpenCV camera, +Z-up world.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mv3d_cli.scene.conventions import RIG_RADIUS


@dataclass(frozen=True)
class Orthographic:
    """Parallel rays; the picture's width spans `2 * half_extent` scene units, its pixels are square."""

    half_extent: float = 1.0


@dataclass(frozen=True)
class Perspective:
    """A pinhole; focal lengths and principal point as fractions of the picture's width and height."""

    focal: tuple[float, float]
    centre: tuple[float, float] = (0.5, 0.5)


@dataclass(frozen=True)
class Camera:
    """A named pose and a projection."""

    name: str
    world_from_camera: Float[np.ndarray, "4 4"]
    projection: Orthographic | Perspective

    @property
    def camera_from_world(self) -> Float[np.ndarray, "4 4"]:
        return np.linalg.inv(self.world_from_camera)


def pixel_from_camera(camera: Camera, width: int, height: int) -> Float[np.ndarray, "2 2"]:
    """Rows (scale, offset) for x and y: pixel = scale * coordinate (/ z if perspective) + offset, in pixels."""
    match camera.projection:
        case Orthographic(half_extent):
            scale = width / (2 * half_extent)
            return np.array([[scale, width / 2], [scale, height / 2]])
        case Perspective((fx, fy), (cx, cy)):
            return np.array([[fx * width, cx * width], [fy * height, cy * height]])


def projected(
    camera: Camera, points: Float[np.ndarray, "points 3"], width: int, height: int
) -> tuple[Float[np.ndarray, "points 2"], Float[np.ndarray, "points"]]:
    """Where a picture of `width` by `height` pixels shows points of the world: (x, y) in pixels, and planar z."""
    camera_from_world = camera.camera_from_world.astype(points.dtype)
    place = points @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
    across, z = place[:, :2], place[:, 2]
    if isinstance(camera.projection, Perspective):
        across = across / np.maximum(z, 1e-6)[:, None]
    scale, offset = pixel_from_camera(camera, width, height).astype(points.dtype).T
    return scale * across + offset, z


def look_at_origin(name: str, position: tuple[float, float, float], projection: Orthographic | Perspective) -> Camera:
    """A camera at `position` (scene units) that looks at the origin with +Z up in the picture.

    Seen straight from above or below, the picture's up is +Y (away from the object's front).
    """
    eye = np.asarray(position, dtype=np.float64)
    forward = -eye / np.linalg.norm(eye)
    up = np.array([0.0, 1.0, 0.0]) if abs(forward[2]) > 1 - 1e-6 else np.array([0.0, 0.0, 1.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    world_from_camera = np.eye(4)
    world_from_camera[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    world_from_camera[:3, 3] = eye
    return Camera(name, world_from_camera, projection)


def direction_on_sphere(azimuth: float, elevation: float, radius: float = RIG_RADIUS) -> tuple[float, float, float]:
    """The point at `azimuth` (radians, 0 in front at -Y, counter-clockwise from above) and `elevation`."""
    return (
        radius * np.cos(elevation) * np.sin(azimuth),
        -radius * np.cos(elevation) * np.cos(azimuth),
        radius * np.sin(elevation),
    )
