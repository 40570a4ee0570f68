"""How alike two pictures are. sRGB bytes with straight alpha, composited on white; the same size."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8

Pixels = UInt8[np.ndarray, "height width 4"]


def on_white(pixels: Pixels) -> Float[np.ndarray, "height width 3"]:
    """The picture over white, sRGB in [0, 1]; blended in sRGB, as published evaluations do."""
    alpha = pixels[..., 3:] / 255
    return pixels[..., :3] / 255 * alpha + (1 - alpha)


def psnr(predicted: Pixels, true: Pixels) -> float:
    """Peak signal-to-noise ratio over all pixels, decibels; infinite for equal pictures."""
    error = float(((on_white(predicted) - on_white(true)) ** 2).mean())
    return float(-10 * np.log10(error)) if error else float("inf")


def ssim(predicted: Pixels, true: Pixels) -> float:
    """Structural similarity, mean over pixels and channels: an 11 x 11 Gaussian of 1.5 pixels (Wang et al., 2004)."""
    from skimage.metrics import structural_similarity

    similarity = structural_similarity(
        *(on_white(pixels) for pixels in (predicted, true)),
        data_range=1.0,
        channel_axis=-1,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
    )
    return float(np.asarray(similarity))
