"""Pictures as witnesses of a surface: which points a camera sees, how well, and in what colour.

Points and normals are in world axes, pixels as in `conventions`, colours sRGB in [0, 1].
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from mv3d_cli.kernels.rasterize import rasterize
from mv3d_cli.kernels.runtime import in_threads
from mv3d_cli.scene.camera import Camera, Orthographic, pixel_from_camera, projected
from mv3d_cli.scene.mesh import Mesh

PixelOf = Callable[[Float[np.ndarray, "points 3"]], Float[np.ndarray, "points 2"]]

FINER = 2
"""Pixels of the depth buffer to a pixel of the picture."""

FEATHER = 2.5
"""Pixels of the picture over which trust falls to nothing towards a silhouette."""

LEAST = 1e-3
"""Trust left at a silhouette, so that things thinner than the feather are seen at all."""

POWER = 4
"""Of the cosine between normal and ray, in the trust."""


@dataclass(frozen=True)
class Shot:
    """A picture of the object, for its colours.

    color     sRGB with straight alpha
    weight    trust
    pixel_of  the (x, y) of world points in this picture; None: the camera's plain projection. Called from threads
    fixed     its exposure is right, and that of the other shots follows it
    gain      what its colours are multiplied with
    """

    camera: Camera
    color: UInt8[np.ndarray, "height width 4"]
    weight: float = 1.0
    pixel_of: PixelOf | None = None
    fixed: bool = False
    gain: float = 1.0


@dataclass(frozen=True)
class Sight:
    """A shot ready for questions about one mesh.

    depth    of the mesh, `FINER` times the picture's size: the nearest within a pixel of the picture; inf = nothing
    feather  trust in [LEAST, 1] by distance to the mesh's occlusion edges, like `depth`
    picture  premultiplied RGBA
    rim      trust in [LEAST, 1] by distance to the picture's own silhouette
    """

    shot: Shot
    depth: Float32[np.ndarray, "h w"]
    feather: Float32[np.ndarray, "h w"]
    picture: Float32[np.ndarray, "height width 4"]
    rim: Float32[np.ndarray, "height width"]


@dataclass(frozen=True)
class Witness:
    """What a shot says of points: trust in [0, 1] (0 = unseen) and colour."""

    trust: Float32[np.ndarray, "points"]
    color: Float32[np.ndarray, "points 3"]


def sights(mesh: Mesh, shots: Sequence[Shot]) -> list[Sight]:
    """Each shot with its view of the mesh, in order."""
    return in_threads([partial(_sight, mesh, shot) for shot in shots])


def witness(sight: Sight, points: Float32[np.ndarray, "points 3"], normals: Float32[np.ndarray, "points 3"]) -> Witness:
    """What the shot says of up to 16384 points of the mesh."""
    trust = np.zeros(len(points), np.float32)
    color = np.zeros((len(points), 3), np.float32)
    facing = _facing(sight.shot.camera, points, normals)
    front = np.flatnonzero(facing > 0.05)
    front = front[_visible(sight, points[front], facing[front])]
    if not len(front):
        return Witness(trust, color)
    plain, _ = _placed(sight, points[front])
    place = sight.shot.pixel_of(points[front]) if sight.shot.pixel_of is not None else plain
    near = _lookup(sight.feather, FINER * plain, cv2.INTER_LINEAR)
    sampled = _lookup(sight.picture, place, cv2.INTER_CUBIC)
    alpha = sampled[:, 3]
    inside = np.clip(2 * alpha - 1, 0, 1) * _lookup(sight.rim, place, cv2.INTER_LINEAR)
    trust[front] = sight.shot.weight * facing[front] ** POWER * near * inside
    gain = np.float32(sight.shot.gain)
    color[front] = np.clip(gain * sampled[:, :3] / np.maximum(alpha, 0.25)[:, None], 0, 1)
    return Witness(trust, color)


def _sight(mesh: Mesh, shot: Shot) -> Sight:
    height, width = shot.color.shape[:2]
    picture = rasterize(mesh.vertices, mesh.faces, [shot.camera], FINER * width, FINER * height)
    depth = np.where(picture.face[0] >= 0, picture.depth[0], np.float32(np.inf))
    alpha = shot.color[..., 3:].astype(np.float32) / 255
    premultiplied = np.concatenate([shot.color[..., :3].astype(np.float32) / 255 * alpha, alpha], axis=2)
    rim = _feather(alpha[..., 0] > 0.5, FEATHER)
    nearest = cv2.erode(depth, np.ones((5, 5), np.uint8))  # a picture's pixel mixes what lies within it
    return Sight(shot, nearest, _edge_feather(depth, shot), premultiplied, rim)


def _edge_feather(depth: Float32[np.ndarray, "h w"], shot: Shot) -> Float32[np.ndarray, "h w"]:
    """Trust by distance to where depth leaps by more than a surface at 80 degrees would."""
    step = _pixel_size(shot, np.where(np.isfinite(depth), depth, 0)) / FINER
    kernel = np.ones((3, 3), np.uint8)
    finite = np.where(np.isfinite(depth), depth, np.float32(1e6))
    leap = cv2.dilate(finite, kernel) - cv2.erode(finite, kernel)
    return _feather(leap < 12 * step, FEATHER * FINER)


def _feather(inside: np.ndarray, width: float) -> Float32[np.ndarray, "h w"]:
    if inside.all():
        return np.ones(inside.shape, np.float32)
    distance = cv2.distanceTransform(inside.astype(np.uint8), cv2.DIST_L2, 5)
    x = np.clip(distance / width, 0, 1)
    return np.maximum(x * x * (3 - 2 * x), LEAST).astype(np.float32)


def _pixel_size(shot: Shot, depth: np.ndarray) -> np.ndarray:
    """Scene units across a pixel of the picture at that depth."""
    scale = pixel_from_camera(shot.camera, shot.color.shape[1], shot.color.shape[0])[0, 0]
    return np.ones_like(depth) / scale if isinstance(shot.camera.projection, Orthographic) else depth / scale


def _facing(camera: Camera, points: np.ndarray, normals: np.ndarray) -> Float32[np.ndarray, "points"]:
    """Cosine between the normal and the direction to the camera."""
    if isinstance(camera.projection, Orthographic):
        return -normals @ camera.world_from_camera[:3, 2].astype(np.float32)
    towards = camera.world_from_camera[:3, 3].astype(np.float32) - points
    return (normals * towards).sum(axis=1) / np.linalg.norm(towards, axis=1)


def _visible(sight: Sight, points: np.ndarray, facing: np.ndarray) -> np.ndarray:
    """Whether nothing of the mesh is before the points, within what the slope explains."""
    pixels, z = _placed(sight, points)
    place = (FINER * pixels).astype(np.int32)
    height, width = sight.depth.shape
    within = (place >= 0).all(axis=1) & (place < [width, height]).all(axis=1) & (z > 0)
    column, row = place.clip(0, [width - 1, height - 1]).T
    slope = np.minimum(np.sqrt(1 - np.minimum(facing, 1) ** 2) / facing, 6)
    bias = _pixel_size(sight.shot, z) / FINER * (1 + 3.5 * slope)
    return within & (z <= sight.depth[row, column] + bias)


def _placed(sight: Sight, points: np.ndarray) -> tuple[Float32[np.ndarray, "points 2"], Float32[np.ndarray, "points"]]:
    """The points in the picture by the camera alone, and their planar z."""
    height, width = sight.shot.color.shape[:2]
    return projected(sight.shot.camera, points, width, height)


def _lookup(picture: np.ndarray, place: Float[np.ndarray, "points 2"], how: int) -> np.ndarray:
    """The picture at places in pixels; nothing outside of it."""
    x, y = (np.ascontiguousarray(place[None, :, axis] - 0.5, np.float32) for axis in (0, 1))
    return cv2.remap(picture, x, y, how, borderMode=cv2.BORDER_CONSTANT, borderValue=0)[0]
