"""What a model answers becomes views: where in its pictures the object is, and how sure that is.

A model shows depth everywhere: the object's surface, and the far side of the unit sphere where there is nothing. At an
outline it passes from one to the other, at once where the model is sure, over some pixels where it is not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from mv3d_cli.capture.normals import normals_from_depth
from mv3d_cli.capture.photo.framing import INSIDE, nearest
from mv3d_cli.capture.photo.matting import labelled
from mv3d_cli.scene.camera import Camera
from mv3d_cli.scene.conventions import RIG_RADIUS, bytes_from_normal
from mv3d_cli.scene.views import View

NOTHING = RIG_RADIUS + 1
"""Depth, in scene units, at which a model shows that there is nothing."""

PHOTO_WEIGHT = 2.0
"""Of the view that is the photo itself."""

LEAST_WEIGHT = 0.2
"""Of a view whose whole outline is unsure."""

_BOUNDS = (2.35, 2.8)  # scene units between which the object's end is looked for, as its surface is near or far
_SURE = 0.75  # of the way from nothing to the surface nearby: nearer is the surface itself
_GRAIN = 2.0  # pixels: size of the grain of a model's depth
_STEP = 0.06  # scene units: steps in depth that are no grain
_EDGE = 4.0  # as `normals_from_depth` has it
_SPECK = 0.02  # of the largest part's area: what is smaller is left out
_PINHOLE = 0.002  # of the picture's area: what is smaller is filled

Depth = Float[np.ndarray, "height width"]
Mask = Bool[np.ndarray, "height width"]


@dataclass(frozen=True)
class Outline:
    """Where the object is in a model's picture.

    mask    the object
    sure    its pixels that show nothing but its surface
    weight  of the view: 1 where every pixel beside the outline is either surface or nothing, falling to LEAST_WEIGHT
            with the share of those that are neither
    """

    mask: Mask
    sure: Mask
    weight: float


def outline_of(depth: Depth, rows: Bool[np.ndarray, " height"] | None = None) -> Outline:
    """The object in a depth map of the model's; `rows` are those in which it can be at all."""
    side = max(depth.shape)
    reach = max(1, side // 64)
    calm = cv2.medianBlur(np.ascontiguousarray(depth, np.float32), 3)
    surface = cv2.erode(calm, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))  # the nearest depth around
    end = ((surface + NOTHING) / 2).clip(*_BOUNDS)
    mask = calm < end
    if rows is not None:
        mask &= _dilated(rows[:, None], max(1, side // 128))
    mask = _without_flaws(mask)
    covered = (NOTHING - calm) / np.maximum(NOTHING - surface, 1e-3)
    sure = mask & ((covered > _SURE) | ~_dilated(~mask, 2 * reach))
    beside = _dilated(mask, reach) & _dilated(~mask, reach)
    unsure = (covered > 1 - _SURE) & (covered < _SURE)
    share = float(unsure[beside].mean()) if beside.any() else 1.0
    return Outline(mask, sure, 1 - (1 - LEAST_WEIGHT) * share)


def generated_view(color: UInt8[np.ndarray, "height width 3"], depth: Depth, outline: Outline, camera: Camera) -> View:
    """A view as the model has it: soft at the outline, beside which colours and depths are those further inside, since
    the model mixes them there with the white background's and the far side's."""
    known = outline.sure & ~_dilated(~outline.mask, max(1, max(depth.shape) // 96))
    known = next(mask for mask in (known, outline.sure, outline.mask) if mask.any())
    soft = cv2.GaussianBlur(outline.mask.astype(np.float32), (0, 0), 0.6)
    alpha = np.round(soft * 255).astype(np.uint8)
    alpha[outline.mask] = np.maximum(alpha[outline.mask], INSIDE)
    alpha[~outline.mask] = np.minimum(alpha[~outline.mask], INSIDE - 1)
    shown = np.where(alpha[..., None] > 0, nearest(color, known), 0).astype(np.uint8)
    surface = _surface(depth, outline.mask, outline.sure if outline.sure.any() else known)
    view = View(camera, np.dstack([shown, alpha]), surface, None, "generated", outline.weight)
    return _with_normal(view)


def photo_view(photo: UInt8[np.ndarray, "height width 4"], depth: Depth, camera: Camera) -> View | None:
    """The photo, as framed, and the model's depth of it, which ends where the photo's object does. None where the
    model sees nothing of it."""
    mask = photo[..., 3] >= INSIDE
    surface = mask & outline_of(depth).sure
    if not surface.any():
        return None
    return _with_normal(View(camera, photo, _surface(depth, mask, surface), None, "photo", PHOTO_WEIGHT))


def back_view(
    photo: UInt8[np.ndarray, "height width 4"],
    color: UInt8[np.ndarray, "height width 3"],
    depth: Depth,
    outline: Outline,
    camera: Camera,
) -> View:
    """The view opposite to the photo's: its outline is the photo's, mirrored, whatever the model says."""
    alpha = np.ascontiguousarray(photo[:, ::-1, 3])
    mask = alpha >= INSIDE
    inner = mask & ~_dilated(~mask, max(1, max(depth.shape) // 96))
    known = next(part for part in (inner & outline.sure, inner & outline.mask, inner, mask) if part.any())
    shown = np.where(alpha[..., None] > 0, nearest(color, known), 0).astype(np.uint8)
    return _with_normal(
        View(camera, np.dstack([shown, alpha]), _surface(depth, mask, known), None, "generated", outline.weight)
    )


def halfway(view: View, guess: View) -> View:
    """The view with the mean of its own depth and a guess's, where both have one."""
    assert view.depth is not None
    assert guess.depth is not None
    both = (view.depth > 0) & (guess.depth > 0)
    return _with_normal(replace(view, depth=np.where(both, (view.depth + guess.depth) / 2, view.depth)))


def unfolded(view: View, weight: float) -> View:
    """A view of the solid between front and back, which is as good as those; its depth is exact."""
    assert view.depth is not None
    normals = normals_from_depth(view.depth, view.camera, sigma=1.0, edge=_EDGE)
    return replace(view, normal=bytes_from_normal(normals), source="generated", weight=weight)


def is_level(camera: Camera) -> bool:
    """Whether the camera looks along the horizon, upright: then it sees a point of the object in the same row as every
    other such camera, since rays are parallel."""
    return bool(np.allclose(camera.world_from_camera[:3, 1], [0, 0, -1], atol=1e-6))


def _surface(depth: Depth, mask: Mask, sure: Mask) -> Depth:
    """Depth of the mask's pixels, from those that are sure; rid of the model's grain, steps kept."""
    whole = nearest(np.asarray(depth, np.float32), sure)
    return np.where(mask, cv2.bilateralFilter(whole, 0, _STEP, _GRAIN), 0).astype(np.float32)


def _with_normal(view: View) -> View:
    assert view.depth is not None
    normals = normals_from_depth(view.depth, view.camera, sigma=_GRAIN, edge=_EDGE)
    return replace(view, normal=bytes_from_normal(normals))


def _dilated(mask: Mask, reach: int) -> Mask:
    """The mask and what is within so many pixels of it, along rows, columns and diagonals."""
    kernel = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    return cv2.dilate(mask.astype(np.uint8), kernel).astype(bool).reshape(mask.shape)


def _without_flaws(mask: Mask) -> Mask:
    """The mask without specks and pinholes."""
    count, holes = labelled(~mask, 4)
    areas = np.bincount(holes.ravel(), minlength=count)
    areas[0] = mask.size
    mask = mask | (areas < _PINHOLE * mask.size)[holes]
    count, parts = labelled(mask, 8)
    areas = np.bincount(parts.ravel(), minlength=count)
    areas[0] = 0
    return mask & (areas >= max(_SPECK * areas.max(), 2))[parts]
