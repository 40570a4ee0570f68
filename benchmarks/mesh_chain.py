"""From a field to a textured mesh: seconds per part, and how the result looks from cameras that gave no picture.

The field is the intersection of 24 rendered depth maps and their silhouettes, on a 192³ grid; the pictures are eight
horizontal views, 256², without light. Held-out cameras: eight between them and the rig's four from above. PSNR is
over a white background, against the scan; what the eight pictures do not show (a mug's inside) counts as well.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from mv3d_cli.capture.rendering import render
from mv3d_cli.formats.cameras import load_cameras, select
from mv3d_cli.meshes.bake import bake, balanced
from mv3d_cli.meshes.repair import watertight, without_floaters
from mv3d_cli.meshes.shots import Shot
from mv3d_cli.meshes.simplify import simplified
from mv3d_cli.meshes.surface import surface_of_grid
from mv3d_cli.meshes.unwrap import unwrapped
from mv3d_cli.scene.camera import Orthographic, direction_on_sphere, look_at_origin
from mv3d_cli.scene.mesh import Material, Mesh
from mv3d_cli.scene.rig import HORIZONTAL
from mv3d_cli.scene.views import Views
from shared_data import scanned_mesh, table

T = TypeVar("T")
NODES, FACES, TEXTURE, SIZE = 192, 25_000, 1024, 256
OBJECTS = (
    "Schleich_Bald_Eagle",
    "BUNNY_RACER",
    "Dino_4",
    "Twinlab_Nitric_Fuel",
    "Android_Figure_Panda",
    "Room_Essentials_Mug_White_Yellow",
)
BETWEEN = [look_at_origin(f"m{i}", direction_on_sphere(np.pi / 8 * (2 * i + 1), 0.0), Orthographic()) for i in range(8)]
BELOW = [look_at_origin(f"b{i}", direction_on_sphere(np.pi / 2 * i, -0.6), Orthographic()) for i in range(4)]
ABOVE = [camera for camera in load_cameras() if camera.name not in HORIZONTAL]


def field_of(mesh: Mesh) -> np.ndarray:
    """Signed distances along the views' axes, the greatest over the views, on nodes over [-1.02, 1.02]."""
    axis = np.linspace(-1.02, 1.02, NODES, dtype=np.float32)
    nodes = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(NODES, -1, 3)
    field = np.full((NODES, NODES * NODES), -0.06, np.float32)
    for view in render(mesh, [*load_cameras(), *BETWEEN, *BELOW], 2 * SIZE, None).frames:
        assert view.depth is not None
        # the nearest of a pixel's neighbours: slopes seen at an angle would carve where a node falls between pixels
        depth = cv2.erode(np.where(view.depth > 0, view.depth, np.float32(9)), np.ones((3, 3), np.uint8))
        empty = depth == 9
        beside = cv2.distanceTransform(empty.astype(np.uint8), cv2.DIST_L2, 5) / SIZE
        camera = view.camera.camera_from_world.astype(np.float32)
        for plane, row in zip(nodes, field, strict=True):
            place = plane @ camera[:3, :3].T + camera[:3, 3]
            column, line = ((place[:, :2] + 1) * SIZE).astype(int).clip(0, 2 * SIZE - 1).T
            ahead = np.where(empty[line, column], beside[line, column], depth[line, column] - place[:, 2])
            np.maximum(row, (ahead + 1 / (2 * SIZE)).clip(-0.06, 0.06), out=row)
    return gaussian_filter(field.reshape(NODES, NODES, NODES), 0.6)


def psnr(truth: Views, made: Views) -> float:
    """Mean over the views, over white."""

    def over_white(picture: np.ndarray) -> np.ndarray:
        alpha = picture[..., 3:] / 255
        return picture[..., :3] * alpha + 255 * (1 - alpha)

    scores = []
    for a, b in zip(truth.frames, made.frames, strict=True):
        assert a.color is not None
        assert b.color is not None
        error = np.mean((over_white(a.color) - over_white(b.color)) ** 2)
        scores.append(10 * np.log10(255**2 / error))
    return float(np.mean(scores))


class Clock:
    """Seconds of each part, in the order of their first run."""

    def __init__(self) -> None:
        self.seconds: list[float] = []

    def __call__(self, work: Callable[[], T]) -> T:
        start = time.perf_counter()
        result = work()
        self.seconds.append(time.perf_counter() - start)
        return result


def row(name: str) -> list[object]:
    scan, clock = scanned_mesh(name), Clock()
    grid, shots = field_of(scan), shots_of(scan)
    surface = clock(lambda: surface_of_grid(grid, np.full(3, -1.02), 2.04 / (NODES - 1)))
    clean = clock(lambda: without_floaters(surface))
    fewer = clock(lambda: simplified(clean, FACES))
    flat = clock(lambda: unwrapped(fewer, TEXTURE))
    even = clock(lambda: balanced(flat, shots))
    texture = clock(lambda: bake(flat, even, TEXTURE))
    made = replace(flat, materials=(Material(texture=texture),))
    scores = [
        psnr(render(scan, cameras, SIZE, None), render(made, cameras, SIZE, None)) for cameras in (BETWEEN, ABOVE)
    ]
    times = [f"{seconds:.2f}" for seconds in (*clock.seconds, sum(clock.seconds))]
    return [name, len(fewer.faces), watertight(made), *times, *(f"{score:.1f}" for score in scores)]


def shots_of(scan: Mesh) -> list[Shot]:
    frames = render(scan, select(load_cameras(), HORIZONTAL), SIZE, None).frames
    return [Shot(frame.camera, frame.color) for frame in frames if frame.color is not None]


def main() -> None:
    row(OBJECTS[0])  # kernels are compiled or fetched
    head = ["object", "faces", "watertight", "surface", "floaters", "simplify", "unwrap", "gains", "bake", "all, s"]
    table([*head, "PSNR between", "above"], [row(name) for name in OBJECTS])


if __name__ == "__main__":
    main()
