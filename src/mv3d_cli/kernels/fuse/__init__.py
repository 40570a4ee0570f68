"""Pictures of depth and outlines fused into truncated signed distances on a grid, many cameras at once.

The distance to a view's surface is measured to its tangent plane and counts as the squared cosine at which the view
sees it, less and less behind the surface (Curless and Levoy, 1996); silhouettes carve (Laurentini, 1994).
"""

# Warp's type stubs are narrower than Warp:
# pyright: reportArgumentType=false, reportCallIssue=false, reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import warp as wp
from jaxtyping import Float32

from mv3d_cli.kernels.fuse import warp_kernels as source
from mv3d_cli.kernels.runtime import empty, in_threads, load, threads, to_warp
from mv3d_cli.scene.camera import Camera, Perspective, pixel_from_camera


@dataclass(frozen=True)
class Picture:
    """What one view brings.

    texels  depth (planar z), |normal . ray| with the ray's z being 1, outline (signed distance, negative inside;
            scene units under parallel rays, scene units at distance 1 under a pinhole), trust in depth, 0 to 1
    deep, outlined  whether depth and outline are known
    """

    camera: Camera
    texels: Float32[np.ndarray, "height width 4"]
    deep: bool
    outlined: bool
    weight: float = 1.0


def fuse(
    pictures: Sequence[Picture],
    resolution: int,
    origin: tuple[float, float, float],
    voxel: float,
    reach: float,
    device: str = "cpu",
) -> Float32[np.ndarray, "x y z"]:
    """Signed distances at `origin + voxel * (i, j, k)`, scene units, positive outside, within +-`reach`.

    What no view sees, and no outline carves, is inside.
    """
    load(source, device)
    shelf = np.concatenate([picture.texels.reshape(-1, 4) for picture in pictures]).astype(np.float32)
    starts = np.cumsum([0] + [picture.texels.shape[0] * picture.texels.shape[1] for picture in pictures])
    structs = [_struct(picture, int(start)) for picture, start in zip(pictures, starts, strict=False)]
    given = [
        to_warp(shelf, wp.vec4, device),
        wp.array(structs, dtype=source.Picture, device=device),
        wp.vec3(*origin),
        wp.float32(voxel),
        wp.float32(reach),
    ]
    distances = empty((resolution,) * 3, dtype=wp.float32, device=device)

    def slab(first: int, last: int) -> None:
        wp.launch(source.fuse, (last - first, resolution), [*given, first, distances], device=device)

    edges = np.linspace(0, resolution, (4 * threads() if device == "cpu" else 1) + 1).astype(int)
    in_threads([partial(slab, int(a), int(b)) for a, b in pairwise(edges)])
    return distances.numpy()


def _struct(picture: Picture, start: int) -> Any:
    """The view as the kernel reads it."""
    height, width = picture.texels.shape[:2]
    (sx, ox), (sy, oy) = pixel_from_camera(picture.camera, width, height)
    pose = picture.camera.camera_from_world
    struct = source.Picture()
    struct.rotation, struct.translation = wp.mat33(pose[:3, :3]), wp.vec3(pose[:3, 3])
    struct.scale, struct.offset = wp.vec2(sx, sy), wp.vec2(ox, oy)
    struct.perspective = int(isinstance(picture.camera.projection, Perspective))
    struct.start, struct.width, struct.height = start, width, height
    struct.deep, struct.outlined, struct.weight = int(picture.deep), int(picture.outlined), picture.weight
    return struct
