"""The z-buffer rasteriser: which face is seen at each pixel centre, where on it, and how deep.

Several views at once, orthographic and perspective, CPU and CUDA from one source. Axes as in `scene.conventions`.
"""

# Warp's type stubs are narrower than Warp:
# pyright: reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false, reportOperatorIssue=false

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import warp as wp

from mv3d_cli.kernels.rasterize import warp_kernels as source
from mv3d_cli.kernels.rasterize.footprint import Eye
from mv3d_cli.kernels.runtime import device_of, empty, in_threads, like, load, threads, to_warp
from mv3d_cli.scene.camera import Camera, Perspective, pixel_from_camera


@dataclass(frozen=True)
class Fragments:
    """What is seen at each pixel centre, (views, height, width): NumPy arrays or torch tensors.

    face         int32, -1 = nothing
    barycentric  float32, a last axis of 3; the weights of the face's corners, 0 = nothing
    depth        float32, planar z, 0 = nothing
    """

    face: Any
    barycentric: Any
    depth: Any


@dataclass(frozen=True)
class Triangles:
    """Geometry on a device, and the alpha tests of its faces (see `warp_kernels.Cutouts`)."""

    vertices: wp.array
    faces: wp.array
    cutouts: source.Cutouts
    device: str


def triangles(vertices: Any, faces: Any, cutouts: source.Cutouts | None = None, device: str | None = None) -> Triangles:
    """Geometry for the kernels: vertices (v, 3) float32 and faces (f, 3) int32, NumPy or torch."""
    device = device or device_of(vertices)
    place = (to_warp(vertices, wp.vec3, device), to_warp(faces, wp.vec3i, device))
    return Triangles(*place, cutouts if cutouts is not None else source.Cutouts(), device)


def eye_of(camera: Camera, width: int, height: int) -> Eye:
    """The camera as kernels read it, for pictures of `width` by `height` pixels."""
    (sx, ox), (sy, oy) = pixel_from_camera(camera, width, height)
    eye = Eye()
    eye.rotation = wp.mat33d(camera.camera_from_world[:3, :3])
    eye.translation = wp.vec3d(camera.camera_from_world[:3, 3])
    eye.scale, eye.offset = wp.vec2d(sx, sy), wp.vec2d(ox, oy)
    eye.perspective = int(isinstance(camera.projection, Perspective))
    return eye


def eyes_of(cameras: Sequence[Camera], width: int, height: int, device: str) -> wp.array:
    """All cameras of a rig, as `eye_of`."""
    return wp.array([eye_of(camera, width, height) for camera in cameras], dtype=Eye, device=device)


def z_buffer(mesh: Triangles, eyes: wp.array, view: int, words: wp.array) -> wp.array:
    """Fills the z-buffer words (height, width) of one view; returns its projected vertices (v,)."""
    screen = empty((len(mesh.vertices),), dtype=wp.vec3, device=mesh.device)
    words.fill_(source.EMPTY)
    block = block_of(mesh.device)
    given = [eyes, view, block, mesh.vertices, screen]
    wp.launch(source.project, -(-len(mesh.vertices) // block), given, device=mesh.device)
    phases = 1 if mesh.device == "cpu" else max(1, min(64, 200_000 // max(len(mesh.faces), 1)))
    place = (mesh.vertices, mesh.faces, screen, mesh.cutouts)

    def fill(band: tuple[int, int]) -> None:
        given = [eyes, view, wp.vec2i(*band), block, *place, phases, words]
        wp.launch(source.fill_z_buffer, (-(-len(mesh.faces) // block), phases), given, device=mesh.device)

    in_threads([partial(fill, band) for band in bands(words.shape[0], workers(mesh.device))])
    return screen


def block_of(device: str) -> int:
    """Items that one thread of a launch takes."""
    return 64 if device == "cpu" else 1


def workers(device: str) -> int:
    """Parts that a launch is split into."""
    return threads() if device == "cpu" else 1


def new_words(height: int, width: int, device: str) -> wp.array:
    """Room for one view's z-buffer words."""
    return empty((height, width), dtype=wp.int64, device=device)


def bands(rows: int, count: int) -> list[tuple[int, int]]:
    """`count` runs of rows that together make the picture."""
    edges = np.linspace(0, rows, count + 1).astype(int)
    return [(int(a), int(b)) for a, b in pairwise(edges)]


def rasterize(vertices: Any, faces: Any, cameras: Sequence[Camera], width: int, height: int) -> Fragments:
    """The faces seen from each camera.

    vertices  (v, 3) float32, world; faces (f, 3) int32; NumPy arrays, or torch tensors on the CPU or a CUDA device
    returns   fragments of the same family, on the same device
    """
    device = device_of(vertices)
    load(source, device)
    mesh = triangles(vertices, faces, device=device)
    eyes = eyes_of(cameras, width, height, device)
    shape = (len(cameras), height, width)
    outputs = [empty(shape, dtype=kind, device=device) for kind in (wp.int32, wp.vec3, wp.float32)]

    def draw(views: tuple[int, int]) -> None:
        words = new_words(height, width, device)
        for view in range(*views):
            screen = z_buffer(mesh, eyes, view, words)
            _resolve(mesh, eyes, view, screen, words, [output[view] for output in outputs])

    few = len(cameras) < workers(device)  # few views: each is split by rows; many: the views are split
    in_threads([partial(draw, part) for part in bands(len(cameras), 1 if few else workers(device))])
    return Fragments(*(like(output, vertices) for output in outputs))


def _resolve(
    mesh: Triangles, eyes: wp.array, view: int, screen: wp.array, words: wp.array, outputs: list[wp.array]
) -> None:
    """Words of one view into its face index, barycentrics and depth."""

    block = block_of(mesh.device)

    def rows(band: tuple[int, int]) -> None:
        given = [eyes, view, band[0], block, mesh.vertices, mesh.faces, screen, words, *outputs]
        wp.launch(source.resolve, (band[1] - band[0], -(-words.shape[1] // block)), given, device=mesh.device)

    in_threads([partial(rows, band) for band in bands(words.shape[0], workers(mesh.device))])
