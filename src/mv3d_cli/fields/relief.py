"""Reliefs: what each view says of the surface, as smooth pictures that can be looked up between pixels.

Pictures are (height, width) float32, filled beyond what is known with the nearest known pixel. Slopes are of planar z,
scene units per pixel, to the right and down. Outlines are pixels, negative inside. Camera axes are OpenCV's.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy.ndimage import distance_transform_edt, gaussian_filter

from mv3d_cli.kernels.plane_fit import fitted_planes
from mv3d_cli.kernels.runtime import in_threads
from mv3d_cli.scene.camera import Camera, Perspective, pixel_from_camera
from mv3d_cli.scene.views import View, Views

EDGE = 2.0  # pixels' widths: neighbours further off the fitted plane hardly count
SIGMA = 1.5  # pixels: how far measured or generated depth is smoothed; rendered depth is exact
SLACK = 1.0  # pixels in 256: generated silhouettes err, and where many err the narrowest would carve
STEP = 12.0  # pixels' widths of depth across three pixels: more is a step, not a slope

Picture = Float32[np.ndarray, "height width"]


@dataclass(frozen=True)
class Relief:
    """One view, ready to be looked up.

    depth    planar z, smooth; None: the view has no depth
    known    pixels whose depth was known, not filled in
    slope    (h, w, 2) of depth; None without depth
    smooth   pixels whose depth is known and not beside a step
    outline  signed distance to the silhouette; None: the view does not say where the object ends
    color    (h, w, 3) sRGB in [0, 1], a little blurred; None without colour
    weight   how much a fit should trust it
    """

    camera: Camera
    depth: Picture | None
    known: Bool[np.ndarray, "height width"]
    slope: Float32[np.ndarray, "height width 2"] | None
    smooth: Bool[np.ndarray, "height width"]
    outline: Picture | None
    color: Float32[np.ndarray, "height width 3"] | None
    weight: float

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) in pixels."""
        return self.smooth.shape[0], self.smooth.shape[1]

    @property
    def pixel_width(self) -> float:
        """What a pixel spans, scene units; under a pinhole: at distance 1."""
        return 1 / float(pixel_from_camera(self.camera, self.shape[1], self.shape[0])[0, 0])


def reliefs_of(views: Views) -> tuple[Relief, ...]:
    """The views as reliefs."""
    return tuple(in_threads([partial(relief_of, view) for view in views.frames]))


def relief_of(view: View) -> Relief:
    """One view as a relief; its depth is smoothed over planes unless it was rendered."""
    mask = mask_of(view)
    depth = slope = None
    smooth = valid = np.zeros(view.shape, dtype=bool)
    if view.depth is not None and known(view.depth).any():
        depth, slope, smooth = _surface(view)
        valid = known(view.depth)
    color = None
    if view.color is not None:
        solid = cv2.erode(mask.astype(np.uint8), np.ones((3, 3))) > 0 if mask is not None else np.ones(view.shape, bool)
        color = _blurred_color(view.color[..., :3], solid if solid.any() else mask)
    outline = outline_of(view, mask) if mask is not None else None
    if outline is not None and view.source == "generated":
        outline -= np.float32(SLACK * view.shape[1] / 256)
    return Relief(view.camera, depth, valid, slope, smooth, outline, color, view.weight)


def known(depth: Float[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    """Where a depth map shows a surface."""
    return np.isfinite(depth) & (depth > 0)


def mask_of(view: View) -> Bool[np.ndarray, "height width"] | None:
    """Where the view shows the object: by its alpha, else by its depth; None where neither tells."""
    if view.color is not None and (view.color[..., 3] < 255).any():
        return view.color[..., 3] > 127
    if view.depth is not None and not known(view.depth).all():
        return known(view.depth)
    return None


def outline_of(view: View, mask: Bool[np.ndarray, "height width"]) -> Picture:
    """Signed distance to the mask's edge, pixels; between pixels where the alpha is antialiased.

    Parallel cameras see the whole object, so nothing lies beyond their pictures; a pinhole's may cut it off.
    """
    rim = 0 if isinstance(view.camera.projection, Perspective) else 2
    mask = np.pad(mask, rim)
    outer, inner = (np.asarray(distance_transform_edt(part)) for part in (~mask, mask))
    distance = outer - inner
    distance -= np.sign(distance) * 0.5  # the edge runs half-way between pixel centres
    if view.color is not None and ((view.color[..., 3] > 0) & (view.color[..., 3] < 255)).any():
        covered = gaussian_filter(np.pad(view.color[..., 3], rim) / 255.0, 0.7)
        down, right = np.gradient(covered)
        finer = (0.5 - covered) / np.maximum(np.hypot(down, right), 0.15)
        distance = np.where(np.abs(distance) < 1, np.clip(finer, -1.5, 1.5), distance)
    height, width = view.shape
    return distance[rim : rim + height, rim : rim + width].astype(np.float32)


def nearest(valid: Bool[np.ndarray, "height width"]) -> tuple[np.ndarray, np.ndarray]:
    """Row and column of the nearest valid pixel, of every pixel."""
    rows, columns = np.asarray(distance_transform_edt(~valid, return_distances=False, return_indices=True))
    return rows, columns


def lookup(picture: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A picture (h, w) or (h, w, c) between pixels, bilinear; beyond its border, the border."""
    height, width = picture.shape[:2]
    column, row = np.clip(x - 0.5, 0, width - 1.001), np.clip(y - 0.5, 0, height - 1.001)
    j, i = column.astype(np.int32), row.astype(np.int32)
    u, v = (column - j).astype(np.float32), (row - i).astype(np.float32)
    if picture.ndim == 3:
        u, v = u[..., None], v[..., None]
    above = picture[i, j] * (1 - u) + picture[i, j + 1] * u
    below = picture[i + 1, j] * (1 - u) + picture[i + 1, j + 1] * u
    return above * (1 - v) + below * v


def _surface(view: View) -> tuple[Picture, np.ndarray, np.ndarray]:
    """Smooth depth, its slopes, and where they can be trusted."""
    assert view.depth is not None
    valid = known(view.depth)
    solid = np.where(valid, view.depth, 1).astype(np.float64)
    width = 1 / pixel_from_camera(view.camera, view.shape[1], view.shape[0])[0, 0]
    perspective = isinstance(view.camera.projection, Perspective)
    heights = 1 / solid if perspective else solid
    # a pixel spans width * z under a pinhole, which is width / z of 1 / z
    tolerance = EDGE * width * (heights if perspective else np.ones_like(heights))
    sigma = 0 if view.source == "rendered" else SIGMA
    heights, right, down = fitted_planes(heights, valid, tolerance, sigma)
    if perspective:
        heights = 1 / np.maximum(heights, 1e-9)
        right, down = -right * heights**2, -down * heights**2
    rows, columns = nearest(valid)
    slope = np.stack([right, down], axis=-1)[rows, columns].astype(np.float32)
    low, high = (_extreme(view.depth, valid, sign) for sign in (-1, 1))
    reach = STEP * width * (solid if perspective else 1)
    return heights[rows, columns].astype(np.float32), slope, valid & (high - low < reach)


def _extreme(depth: np.ndarray, valid: np.ndarray, sign: int) -> np.ndarray:
    """The least (-1) or greatest (1) known depth of the 3 x 3 pixels around each."""
    return sign * cv2.dilate(np.where(valid, sign * depth, -1e30).astype(np.float32), np.ones((3, 3)))


def _blurred_color(color: np.ndarray, valid: np.ndarray | None) -> Float32[np.ndarray, "height width 3"]:
    """Colours in [0, 1], the object's continued over the background, blurred by a pixel."""
    picture = color.astype(np.float32) / 255
    if valid is not None and valid.any():
        picture = picture[nearest(valid)]
    return cv2.GaussianBlur(picture, (0, 0), 1.0)
