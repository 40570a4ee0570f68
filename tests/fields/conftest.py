"""An ellipsoid that is seen exactly: the views that the tests of this folder share, and their analytic depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from mv3d_cli.scene.camera import (
    Camera,
    Orthographic,
    Perspective,
    direction_on_sphere,
    look_at_origin,
    pixel_from_camera,
)
from mv3d_cli.scene.conventions import RIG_RADIUS
from mv3d_cli.scene.views import View

SUPERSAMPLES = 4
PROJECTIONS = {"orthographic": Orthographic(), "perspective": Perspective((0.85, 0.85))}


@dataclass(frozen=True)
class Ellipsoid:
    """A painted ellipsoid about `centre`, world axes, scene units."""

    radii: tuple[float, float, float] = (0.7, 0.5, 0.6)
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def depth(self, camera: Camera, x: np.ndarray, y: np.ndarray, size: int) -> np.ndarray:
        """Planar z where the rays of pixels (x, y) enter; NaN where they miss."""
        origin, direction = rays(camera, x, y, size)
        start, along = (origin - self.centre) / self.radii, direction / self.radii
        a, b, c = (along**2).sum(-1), (start * along).sum(-1), (start**2).sum(-1) - 1
        with np.errstate(invalid="ignore"):
            return (-b - np.sqrt(b * b - a * c)) / a

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Signed distance to first order, negative inside."""
        unit = (points - self.centre) / self.radii
        length = np.linalg.norm(unit, axis=-1)
        return (length - 1) * length / np.maximum(np.linalg.norm(unit / self.radii, axis=-1), 1e-9)

    def paint(self, points: np.ndarray) -> np.ndarray:
        """sRGB in [0, 1]."""
        x, y, z = np.moveaxis(points, -1, 0)
        waves = [np.sin(9 * x + 2 * z) + np.sin(8 * y), np.sin(7 * z + 3 * y) + np.cos(8 * x), np.sin(8 * z - 5 * x)]
        return 0.5 + 0.15 * np.stack(waves, axis=-1)

    def view(self, camera: Camera, size: int = 128, source: str = "rendered") -> View:
        """Exact depth at pixel centres, antialiased alpha, painted colour."""
        y, x = np.indices((size, size)) + 0.5
        depth = self.depth(camera, x, y, size)
        origin, direction = rays(camera, x, y, size)
        color = self.paint(origin + np.nan_to_num(depth)[..., None] * direction)
        fine = (np.arange(size * SUPERSAMPLES) + 0.5) / SUPERSAMPLES
        hit = np.isfinite(self.depth(camera, *np.meshgrid(fine, fine), size))
        covered = hit.reshape(size, SUPERSAMPLES, size, SUPERSAMPLES).mean((1, 3))
        rgba = np.round(np.dstack([color, covered]) * 255).astype(np.uint8)
        return View(camera, rgba, np.nan_to_num(depth).astype(np.float32), source=source)


def rays(camera: Camera, x: np.ndarray, y: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions, world axes, of pixels' rays; the parameter along them is planar z."""
    (sx, ox), (sy, oy) = pixel_from_camera(camera, size, size)
    across = np.stack([(x - ox) / sx, (y - oy) / sy, np.zeros_like(x)], axis=-1)
    forward = np.broadcast_to([0.0, 0.0, 1.0], across.shape)
    pinhole = isinstance(camera.projection, Perspective)
    start, along = (np.zeros_like(across), across + forward) if pinhole else (across, forward)
    pose = camera.world_from_camera
    return start @ pose[:3, :3].T + pose[:3, 3], along @ pose[:3, :3].T


@pytest.fixture(scope="session")
def ellipsoid() -> Ellipsoid:
    return Ellipsoid()


@pytest.fixture(scope="session")
def sphere() -> Ellipsoid:
    return Ellipsoid((0.6, 0.6, 0.6), (0.05, -0.02, 0.03))


@pytest.fixture(scope="session", params=list(PROJECTIONS))
def ring(request: pytest.FixtureRequest) -> tuple[Camera, ...]:
    """Eight cameras around the object, slightly above and below it in turn; once parallel, once pinholes."""
    turns = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    places = [direction_on_sphere(turn, 0.3 * (-1) ** i, RIG_RADIUS) for i, turn in enumerate(turns)]
    return tuple(look_at_origin(f"view{i}", place, PROJECTIONS[request.param]) for i, place in enumerate(places))
