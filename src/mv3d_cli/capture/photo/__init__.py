"""A photo becomes the front view: its object is cut out, brought to the middle, and to a size.

The photo is refused, with the reason, where there is nothing to be cut out, or more than one thing.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from mv3d_cli.capture.photo.framing import INSIDE
from mv3d_cli.capture.photo.matting import alpha_of, labelled
from mv3d_cli.errors import BadImage

LEAST_SIDE = 16  # pixels of a photo

_SECOND = 0.35  # of the larger object's area: what is less is an accessory
_GAP = 0.03  # of the longest side: what is nearer belongs together
_LEAST = 5e-4  # share of a photo that its object covers, at least
_CUT = 0.01  # of a side's length: an object may touch the frame along that much
_HINT = "Give a photo of one object before a plain background, or a PNG that is transparent around it."

Alpha = UInt8[np.ndarray, "height width"]


def cut_out(photo: UInt8[np.ndarray, "height width 4"], name: str = "the photo") -> Alpha:
    """The opacity of the photo's one object, at the photo's pixels.

    Raises BadImage for a photo that is tiny, transparent, holds nothing that stands out, or two things.
    """
    height, width = photo.shape[:2]
    if min(height, width) < LEAST_SIDE:
        raise BadImage(
            f"{name} is {width}x{height} pixels, too small to show an object.",
            f"Give one of at least {LEAST_SIDE} pixels a side; 256 and more are good.",
        )
    if photo[..., 3].max() < INSIDE:
        raise BadImage(f"{name} is transparent everywhere.", "Give one whose object is opaque.")
    alpha = alpha_of(photo)
    if (alpha >= INSIDE).mean() < _LEAST:
        raise BadImage(f"nothing in {name} stands out from the background.", _HINT)
    _refuse_two(alpha, name)
    return alpha


def is_cut_by_frame(alpha: Alpha) -> bool:
    """Whether the object reaches over the picture's border, where more of it may be."""
    mask = alpha >= INSIDE
    return any(side.sum() > _CUT * len(side) + 1 for side in (mask[0], mask[-1], mask[:, 0], mask[:, -1]))


def _refuse_two(alpha: Alpha, name: str) -> None:
    areas = np.sort(areas_apart(_reduced(alpha, 256)))[::-1]
    if len(areas) > 1 and areas[1] > _SECOND * areas[0]:
        share = areas[1] / areas[0]
        raise BadImage(
            f"{name} shows two objects, one {share:.0%} as large as the other, with a gap between them.",
            "Crop it to one of them, or make the other transparent.",
        )


def areas_apart(mask: Bool[np.ndarray, "height width"]) -> np.ndarray:
    """The areas, in pixels, of the mask's parts that are clearly apart from each other."""
    reach = max(1, round(max(mask.shape) * _GAP / 2))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    count, labels = labelled(cv2.dilate(mask.astype(np.uint8), kernel) > 0, 8)
    return np.bincount(labels[mask], minlength=count)[1:]


def _reduced(alpha: Alpha, side: int) -> Bool[np.ndarray, "rows columns"]:
    scale = min(1.0, side / max(alpha.shape))
    size = [max(1, round(length * scale)) for length in alpha.shape[::-1]]
    return cv2.resize(alpha, size, interpolation=cv2.INTER_AREA) >= INSIDE
