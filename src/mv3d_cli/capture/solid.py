"""A solid between two sheets: what the front and the back of an object show, joined along their common outline.

Under parallel rays the back's outline is the front's, mirrored. Two depths and two colours at each place inside it say
most of what there is to know of an object: drawn from true ones, the views from its sides have 25 dB on scans.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy import ndimage

from mv3d_cli.capture.rendering import render
from mv3d_cli.scene.camera import Camera
from mv3d_cli.scene.conventions import RIG_RADIUS, linear_from_srgb
from mv3d_cli.scene.mesh import Material, Mesh
from mv3d_cli.scene.views import View, Views

RESOLUTION = 128  # places a side
INSIDE = 0.5  # least coverage of a place that belongs to the object
THINNEST = 0.01  # scene units between the sheets
CALM = 1.5  # places over which depth is averaged

Grid = Float[np.ndarray, "rows columns"]
Colors = Float[np.ndarray, "rows columns 3"]


@dataclass(frozen=True)
class Sheet:
    """One side of the solid, as seen from the front: its y in scene units, and its colours, sRGB in [0, 1]."""

    y: Grid
    color: Colors


def views_between(front: View, back: View, cameras: Sequence[Camera]) -> Views:
    """What the cameras see of the solid between the rig's front and back views, which hold colour and depth; pictures
    are as large as those."""
    assert front.color is not None
    assert back.color is not None
    color, mask = reduced(front.color, RESOLUTION)
    behind, _ = reduced(back.color[:, ::-1], RESOLUTION)
    near = Sheet(_calm(_reduced_depth(front), mask) - RIG_RADIUS, color)
    far_y = RIG_RADIUS - _calm(_reduced_depth(back)[:, ::-1], mask)
    far = Sheet(np.maximum(far_y, near.y + THINNEST), behind)
    return render(solid_between(mask, near, far), cameras, len(front.color), None)


def solid_between(mask: Bool[np.ndarray, "rows columns"], near: Sheet, far: Sheet) -> Mesh:
    """The closed mesh of two sheets of quads over a square grid of places that spans the unit sphere from the front."""
    mask, near_y, far_y, near_color, far_color = (
        np.pad(part, [(1, 1), (1, 1), (0, 0)][: part.ndim]) for part in (mask, near.y, far.y, near.color, far.color)
    )
    step = 2 / (len(mask) - 2)
    beside = nearest(mask)
    rows, columns = (np.indices(mask.shape) + beside) / 2  # places beside the outline move onto it, and the sheets meet
    x, z = (columns - 0.5) * step - 1, 1 - (rows - 0.5) * step
    middle = ((near_y + far_y) / 2)[beside[0], beside[1]]
    inside = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    inner = nearest(inside if inside.any() else mask)  # at the outline, colours mix with what is behind
    sheets, looks = [], []
    for y, color in ((near_y, near_color), (far_y, far_color)):
        sheets.append(np.stack([x, np.where(mask, y, middle), z], axis=-1).reshape(-1, 3))
        looks.append(linear_from_srgb(color[inner[0], inner[1]]).reshape(-1, 3))
    faces = _faces(mask)
    return Mesh(
        vertices=np.concatenate(sheets).astype(np.float32),
        faces=faces,
        face_material=np.zeros(len(faces), np.int32),
        materials=(Material(),),
        colors=np.pad(np.concatenate(looks), ((0, 0), (0, 1)), constant_values=1).astype(np.float32),
    )


def reduced(
    picture: UInt8[np.ndarray, "side side 4"], resolution: int
) -> tuple[Colors, Bool[np.ndarray, "rows columns"]]:
    """(sRGB colour in [0, 1], mask) of the picture on the solid's grid; the mask is never empty."""
    alpha = picture[..., 3:].astype(np.float32) / 255
    spread = np.dstack([picture[..., :3] * (alpha / 255), alpha])
    small = cv2.resize(spread, (resolution, resolution), interpolation=cv2.INTER_AREA)
    mask = small[..., 3] >= INSIDE
    if not mask.any():
        mask[resolution // 2, resolution // 2] = True
    return (small[..., :3] / np.maximum(small[..., 3:], 1e-3)).clip(0, 1), mask


def nearest(mask: Bool[np.ndarray, "rows columns"]) -> Int[np.ndarray, "2 rows columns"]:
    """(row, column) of the mask's place nearest to each."""
    return np.asarray(ndimage.distance_transform_edt(~mask, return_distances=False, return_indices=True))


def _reduced_depth(view: View) -> Grid:
    """The view's depth on the solid's grid; where there is no surface, the nearest one's."""
    assert view.depth is not None
    there = view.depth > 0
    spread = np.dstack([np.where(there, view.depth, 0), there]).astype(np.float32)
    small = cv2.resize(spread, (RESOLUTION, RESOLUTION), interpolation=cv2.INTER_AREA)
    known = small[..., 1] > 0
    if not known.any():
        return np.full(known.shape, RIG_RADIUS)
    place = nearest(known)
    return (small[..., 0] / np.maximum(small[..., 1], 1e-6))[place[0], place[1]]


def _calm(depth: Grid, mask: Bool[np.ndarray, "rows columns"]) -> Grid:
    """Depth without spikes: predicted depth errs most beside outlines, and a row of one place that errs is a thorn when
    seen from the side."""
    median = cv2.medianBlur(depth.astype(np.float32), 5)
    weight = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), CALM)
    return cv2.GaussianBlur(median * mask, (0, 0), CALM) / np.maximum(weight, 1e-3)


def _faces(mask: np.ndarray) -> np.ndarray:
    """Triangles of both sheets, wherever a quad touches the mask; the far sheet faces backwards."""
    touched = mask[:-1, :-1] | mask[:-1, 1:] | mask[1:, :-1] | mask[1:, 1:]
    index = np.arange(mask.size, dtype=np.int32).reshape(mask.shape)
    a, b, c, d = (corner[touched] for corner in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    near = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return np.concatenate([near, near[:, ::-1] + mask.size]).astype(np.int32)
