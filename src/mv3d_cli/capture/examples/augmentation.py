"""Clean renders spoilt a little, the way photos and their cut-outs are: exposure, blur, JPEG, a mask that errs.

sRGB, 8 bits, straight alpha.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import UInt8

Pixels = UInt8[np.ndarray, "height width 4"]

LIKELY = 0.5  # of each kind of damage


def augmented(pixels: Pixels, rng: np.random.Generator) -> Pixels:
    """The picture with each kind of damage, or without, as `rng` has it."""
    for damage in (exposed, blurred, masked_badly, compressed):
        if rng.uniform() < LIKELY:
            pixels = damage(pixels, rng)
    return pixels


def exposed(pixels: Pixels, rng: np.random.Generator) -> Pixels:
    """Another exposure (up to half a stop), white balance and contrast."""
    gain = 2 ** rng.uniform(-0.5, 0.5) * (1 + rng.normal(scale=0.03, size=3))
    curve = (np.linspace(0, 1, 256)[:, None] ** rng.uniform(0.85, 1.18) * gain ** (1 / 2.2)).clip(0, 1)
    table = np.round(curve * 255).astype(np.uint8)
    color = np.stack([table[pixels[..., i], i] for i in range(3)], axis=-1)
    return np.dstack([color, pixels[..., 3]])


def blurred(pixels: Pixels, rng: np.random.Generator) -> Pixels:
    """Out of focus by up to a two-hundredth of the picture; what is transparent gives no colour."""
    deviation = rng.uniform(0.1, 1) * max(pixels.shape[:2]) / 200
    alpha = pixels[..., 3:].astype(np.float32) / 255
    spread = cv2.GaussianBlur(np.dstack([pixels[..., :3] * alpha, alpha]), (0, 0), deviation)
    color = spread[..., :3] / np.maximum(spread[..., 3:], 1e-3)
    return np.dstack([np.round(color.clip(0, 255)), np.round(spread[..., 3:] * 255)]).astype(np.uint8)


def masked_badly(pixels: Pixels, rng: np.random.Generator) -> Pixels:
    """A cut-out too wide, showing what was behind, or too tight, by a hundredth of the picture or one pixel at most."""
    reach = 1 + int(rng.integers(0, max(max(pixels.shape[:2]) // 100, 1)))
    around = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    alpha = pixels[..., 3]
    if rng.uniform() < 0.5:
        return np.dstack([pixels[..., :3], cv2.erode(alpha, around)])
    wide = cv2.dilate(alpha, around)
    behind = rng.integers(0, 256, size=3)
    share = alpha[..., None] / 255
    color = np.round(pixels[..., :3] * share + behind * (1 - share)).astype(np.uint8)
    return np.dstack([np.where(wide[..., None] > 0, color, 0), wide])


def compressed(pixels: Pixels, rng: np.random.Generator) -> Pixels:
    """Colours as JPEG keeps them at a quality of 40 to 95; what is transparent is white to it."""
    share = pixels[..., 3:] / 255
    page = np.round(pixels[..., :3] * share + 255 * (1 - share)).astype(np.uint8)
    data = cv2.imencode(".jpg", page[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(40, 96))])[1]
    again = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))[..., ::-1]
    color = np.where(share > 0, (again - 255 * (1 - share)) / np.maximum(share, 0.05), pixels[..., :3])
    return np.dstack([np.round(color.clip(0, 255)), pixels[..., 3]]).astype(np.uint8)
