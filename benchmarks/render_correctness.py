"""Does the rasteriser see the same face, at the same depth, as a ray caster and as Blender?

Judged on *interior* pixels: rays a hundredth of a pixel to the four corners of a pixel's centre hit the same face as
the ray through the centre, so that neither an edge nor an outline passes through it. `interior` is their share of the
pixels that show a surface.
The ray caster is trimesh's, with Embree where embreex is installed. Embree's hits are float32, so it only names the
face; the reference depth is the ray's own crossing of that face's plane, in float64.
`same face` counts another face as wrong even where both coincide; `or as deep` takes it for right where the two
planes lie within 1e-6 of each other along the ray, which is what duplicate faces in a scan come to.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np
import trimesh

from mv3d_cli.capture.blender import render as render_with_blender
from mv3d_cli.errors import MissingDependency
from mv3d_cli.formats.cameras import load_cameras, select
from mv3d_cli.kernels.rasterize import rasterize
from mv3d_cli.scene.camera import (
    Camera,
    Orthographic,
    Perspective,
    direction_on_sphere,
    look_at_origin,
    pixel_from_camera,
)
from mv3d_cli.scene.mesh import Mesh
from shared_data import scanned_mesh, table

NAMES = (
    "Dino_4",
    "Android_Figure_Panda",
    "Schleich_Bald_Eagle",
    "Cole_Hardware_Hammer_Black",
    "Nintendo_Yoshi_Action_Figure",
)
MARGIN = 0.01  # pixels
EQUAL = 1e-6


@dataclass(frozen=True)
class Reference:
    """What rays through the pixel centres hit: face (-1 = none), depth, and whether the pixel is interior."""

    face: np.ndarray
    depth: np.ndarray
    interior: np.ndarray


def cameras() -> tuple[Camera, ...]:
    """Three of the rig, and a pinhole off its axis."""
    pinhole = look_at_origin("pinhole", direction_on_sphere(0.6, 0.4, 2.6), Perspective((1.2, 1.3), (0.48, 0.53)))
    return (*select(load_cameras(), ["front", "front_left", "back_right_top"]), pinhole)


def rays(camera: Camera, size: int, right: float = 0.0, down: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions through all pixel centres, or pixels beside them, row by row.

    A direction advances one unit of planar z.
    """
    (sx, ox), (sy, oy) = pixel_from_camera(camera, size, size)
    row, column = np.mgrid[0:size, 0:size].reshape(2, -1) + 0.5
    x, y = (column + right - ox) / sx, (row + down - oy) / sy
    still, one = np.zeros_like(x), np.ones_like(x)
    origin, direction = np.stack([still, still, still], -1), np.stack([x, y, one], -1)
    if isinstance(camera.projection, Orthographic):
        origin, direction = np.stack([x, y, still], -1), np.stack([still, still, one], -1)
    pose = camera.world_from_camera
    return origin @ pose[:3, :3].T + pose[:3, 3], direction @ pose[:3, :3].T


def depth_of(mesh: Mesh, face: np.ndarray, camera: Camera) -> np.ndarray:
    """Planar z where the rays through the pixel centres cross the planes of `face` (rows, columns), float64."""
    corners = mesh.vertices[mesh.faces[face.ravel()]].astype(np.float64)
    origin, direction = rays(camera, len(face))
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    with np.errstate(divide="ignore", invalid="ignore"):
        z = ((corners[:, 0] - origin) * normal).sum(-1) / (direction * normal).sum(-1)
    return z.reshape(face.shape)


def seen_face(solid: trimesh.Trimesh, origin: np.ndarray, direction: np.ndarray, size: int) -> np.ndarray:
    """The face that each ray hits first (rows, columns), -1 = none."""
    face, ray, *_ = solid.ray.intersects_id(origin, direction, multiple_hits=False)
    seen = np.full(size * size, -1)
    seen[ray] = face
    return seen.reshape(size, size)


def cast(mesh: Mesh, camera: Camera, size: int) -> Reference:
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    face = seen_face(solid, *rays(camera, size), size)
    interior = face >= 0
    for right in (-MARGIN, MARGIN):
        for down in (-MARGIN, MARGIN):
            interior &= seen_face(solid, *rays(camera, size, right, down), size) == face
    return Reference(face, depth_of(mesh, face, camera), interior)


def blender_depths(mesh: Mesh, size: int) -> list[np.ndarray]:
    """Depth by Blender for every camera; none where Blender is not installed."""
    try:
        views = render_with_blender(mesh, cameras(), size, None, samples=1)
    except MissingDependency:
        return []
    return [view.depth for view in views.frames if view.depth is not None]


def row_of(name: str, size: int) -> list[object]:
    """One object's line: shares and depth errors over all cameras."""
    mesh = scanned_mesh(name)
    ours = rasterize(mesh.vertices, mesh.faces, cameras(), size, size)
    theirs = blender_depths(mesh, size)
    covered, pixels, same, alike, errors, from_blender = 0, 0, 0, 0, [], [np.zeros(0)]
    for i, camera in enumerate(cameras()):
        truth = cast(mesh, camera, size)
        inside, face = truth.interior, ours.face[i]
        equal = (face == truth.face)[inside]
        as_deep = np.abs(depth_of(mesh, face, camera) - truth.depth)[inside] < EQUAL
        covered += (truth.face >= 0).sum()
        pixels, same, alike = pixels + inside.sum(), same + equal.sum(), alike + (equal | as_deep).sum()
        errors.append(np.abs(ours.depth[i] - truth.depth)[inside])
        if theirs:
            from_blender.append(np.abs(ours.depth[i] - theirs[i])[inside])
    shares = [f"{100 * same / pixels:.3f} %", f"{100 * alike / pixels:.3f} %"]
    return [
        name,
        len(mesh.faces),
        pixels,
        f"{100 * pixels / covered:.0f} %",
        *shares,
        *spread(errors),
        *spread(from_blender),
    ]


def spread(errors: list[np.ndarray]) -> list[str]:
    """The 99.9 percentile and the greatest of all errors."""
    values = np.concatenate(errors)
    return [f"{np.percentile(values, 99.9):.1e}", f"{values.max():.1e}"] if len(values) else ["-", "-"]


def main() -> None:
    parser = argparse.ArgumentParser(description="Faces and depths against a ray caster and Blender.")
    parser.add_argument("--size", type=int, default=256, help="picture side in pixels")
    parser.add_argument("--objects", type=int, default=len(NAMES), help="how many of the objects")
    options = parser.parse_args()
    rows = [row_of(name, options.size) for name in NAMES[: options.objects]]
    rows.append(["target", "", "", "", "> 99.5 %", "", "<= 1e-4", "<= 1e-4", "<= 2e-3", "<= 2e-3"])
    head = ["object, 4 cameras", "faces", "pixels", "interior", "same face", "or as deep"]
    head += ["depth to rays, 99.9 %", "max", "to Blender, 99.9 %", "max"]
    table(head, rows)


if __name__ == "__main__":
    main()
