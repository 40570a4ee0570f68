"""A cut-out in a square frame: moved, scaled, its edges free of the colours that lay behind it.

Pixels are averaged premultiplied, in sRGB, as the network's pictures are composited.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage

INSIDE = 128  # least alpha of a pixel that belongs to the object
OPAQUE = 242  # and of one whose colour is the object's alone
_PIXELS_AT_ONCE = 2**21

Cut = UInt8[np.ndarray, "height width 4"]


def framed(cut: Cut, side: int, fill: float | None) -> UInt8[np.ndarray, "side side 4"]:
    """The cut-out in a frame of `side` pixels, in straight alpha.

    fill  share of the frame's side that the longest side of the object's bounding box takes, its middle in the middle
          of the frame; None: the whole picture, fitted into the frame

    Raises ValueError for a cut-out without a pixel of alpha 128.
    """
    left, top, window = _window(cut[..., 3], fill)
    factor = max(1, int(window / side))
    small = reduced(cut, factor)
    # Twice the frame's size, the scale is between a half and one pixel's: nothing is skipped, and the mean smooths it.
    step = window / factor / (2 * side)
    place = np.array([[step, 0, left / factor + step / 2 - 0.5], [0, step, top / factor + step / 2 - 0.5]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    double = cv2.warpAffine(small, place, (2 * side, 2 * side), flags=flags, borderMode=cv2.BORDER_CONSTANT)
    frame = cv2.resize(double, (side, side), interpolation=cv2.INTER_AREA)
    color = frame[..., :3] / np.maximum(frame[..., 3:], 1e-4)
    straight = np.dstack([color * 255, frame[..., 3] * 255])
    return decontaminated(np.round(straight).clip(0, 255).astype(np.uint8))


def _window(alpha: UInt8[np.ndarray, "height width"], fill: float | None) -> tuple[float, float, float]:
    """(left, top, side) of the square of the picture that the frame shows, in pixels."""
    height, width = alpha.shape
    if fill is None:
        window = float(max(height, width))
        return (width - window) / 2, (height - window) / 2, window
    inside = alpha >= INSIDE
    (rows,), (columns,) = np.nonzero(inside.any(axis=1)), np.nonzero(inside.any(axis=0))
    if not len(rows):
        raise ValueError("the cut-out is empty")
    top, bottom, left, right = rows[0], rows[-1] + 1, columns[0], columns[-1] + 1
    window = max(bottom - top, right - left) / fill
    return (left + right - window) / 2, (top + bottom - window) / 2, window


def reduced(cut: Cut, factor: int) -> Float[np.ndarray, "rows columns 4"]:
    """Means over blocks of `factor` x `factor` pixels, premultiplied, in [0, 1]; made strip by strip, so that a large
    picture needs little memory. Beyond the picture there is nothing."""
    height, width = cut.shape[:2]
    columns = -(-width // factor)
    strip = factor * max(1, _PIXELS_AT_ONCE // (factor * width))
    parts = []
    for top in range(0, height, strip):
        part = cut[top : top + strip].astype(np.float32) / 255
        part[..., :3] *= part[..., 3:]
        rows = -(-len(part) // factor)
        part = np.pad(part, ((0, rows * factor - len(part)), (0, columns * factor - width), (0, 0)))
        parts.append(cv2.resize(part, (columns, rows), interpolation=cv2.INTER_AREA))
    return np.concatenate(parts)


def decontaminated(cut: Cut) -> Cut:
    """The cut-out, its partly covered pixels in the colour of the nearest one that is covered fully: at an edge,
    photos mix the object's colour with the background's."""
    opaque = cut[..., 3] >= OPAQUE
    if not opaque.any():
        return cut
    color = nearest(cut[..., :3], opaque)
    return np.dstack([np.where(cut[..., 3:] > 0, color, 0).astype(np.uint8), cut[..., 3]])


def nearest(values: np.ndarray, known: Bool[np.ndarray, "height width"]) -> np.ndarray:
    """The values, where they are not known those of the nearest pixel where they are."""
    place = np.asarray(ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True))
    return values[place[0], place[1]]
