"""Mean angle between true normals and those from depth, 256²: an analytic sphere and rendered scans.

The scans' truth is the rendered normal map, eight horizontal views of each; pixels within two of the silhouette are
counted too. "8 bits" quantises depth to 255 steps of the rig's two units, as generated depth is.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mv3d_cli.capture.normals import normals_from_depth, paper_normals
from mv3d_cli.capture.rendering import render
from mv3d_cli.formats.cameras import load_cameras, select
from mv3d_cli.formats.meshes import find_meshes, read_mesh
from mv3d_cli.scene.camera import Camera
from mv3d_cli.scene.conventions import normal_from_bytes
from mv3d_cli.scene.rig import HORIZONTAL
from shared_data import in_unit_sphere, shared, table

SIZE = 256
RADIUS = 0.8
SIGMAS = (0.0, 1.0, 1.5, 2.0, 3.0)


def sphere(camera: Camera) -> tuple[np.ndarray, np.ndarray, Camera]:
    """Depth and normals of a sphere as an orthographic camera of the rig sees it."""
    c = (np.arange(SIZE) + 0.5) / (SIZE / 2) - 1
    x, y = np.meshgrid(c, -c)
    inside = x**2 + y**2 < RADIUS**2
    height = np.sqrt(np.maximum(RADIUS**2 - x**2 - y**2, 0))
    normals = np.stack([x, y, height], axis=-1) / RADIUS
    return np.where(inside, 2 - height, 0), np.where(inside[..., None], normals, 0), camera


def scans() -> list[tuple[np.ndarray, np.ndarray, Camera]]:
    """Depth and normals of every view of every scan."""
    rig, found = select(load_cameras(), HORIZONTAL), []
    for file in find_meshes(shared("gso")):
        for view in render(in_unit_sphere(read_mesh(file)), rig, SIZE, None).frames:
            assert view.depth is not None
            assert view.normal is not None
            truth = np.where(view.depth[..., None] > 0, normal_from_bytes(view.normal), 0)
            found.append((view.depth, truth, view.camera))
    return found


def quantised(depth: np.ndarray) -> np.ndarray:
    """Depth in 255 steps of two units from 1."""
    return np.where(depth > 0, 1 + np.round((depth - 1) / 2 * 255) / 255 * 2, 0)


def mean_angle(
    cases: list[tuple[np.ndarray, np.ndarray, Camera]], make: Callable[[np.ndarray, Camera], np.ndarray]
) -> str:
    """Mean over all pixels with a surface, degrees."""
    angles = []
    for depth, truth, camera in cases:
        cosine = (make(depth, camera) * truth).sum(-1)[depth > 0]
        angles.append(np.rad2deg(np.arccos(np.clip(cosine, -1, 1))))
    return f"{np.concatenate(angles).mean():.2f}°"


def main() -> None:
    conditions = {"sphere": [sphere(load_cameras()[0])], "scans": scans()}
    rows = []
    for name, cases in conditions.items():
        for label, dim in ((name, lambda depth: depth), (f"{name}, 8 bits", quantised)):
            row = [label]
            for sigma in SIGMAS:
                row.append(mean_angle(cases, lambda d, c, s=sigma, q=dim: normals_from_depth(q(d), c, sigma=s)))
            row.append(mean_angle(cases, lambda d, c: normal_from_bytes(paper_normals(d))))
            rows.append(row)
    table(["depth", *(f"sigma {sigma:g}" for sigma in SIGMAS), "--paper"], rows)


if __name__ == "__main__":
    main()
