"""Picture scores against scikit-image, PyTorch's convolution and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from skimage.data import astronaut
from skimage.metrics import peak_signal_noise_ratio

from mv3d_cli.metrics.image import on_white, psnr, ssim


@pytest.fixture(scope="module")
def pictures() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    true = np.dstack([astronaut()[100:228, 150:278], rng.integers(0, 256, (128, 128))]).astype(np.uint8)
    noise = rng.normal(0, 12, (128, 128, 4))
    return (true + noise).clip(0, 255).astype(np.uint8), true


def test_what_is_transparent_is_white():
    pixels = np.array([[[10, 20, 30, 0], [10, 20, 30, 255], [0, 0, 0, 51]]], np.uint8)
    np.testing.assert_allclose(on_white(pixels)[0] * 255, [[255] * 3, [10, 20, 30], [204] * 3])


def test_psnr_is_scikit_image_s(pictures: tuple[np.ndarray, np.ndarray]):
    predicted, true = pictures
    expected = peak_signal_noise_ratio(on_white(true), on_white(predicted), data_range=1.0)
    assert psnr(predicted, true) == pytest.approx(expected, abs=1e-9)
    assert psnr(true, true) == float("inf")


def test_psnr_of_an_even_difference():
    grey = np.full((16, 16, 4), 255, np.uint8)
    grey[..., :3] = 204  # .2 below white
    assert psnr(grey, np.full_like(grey, 255)) == pytest.approx(-20 * np.log10(0.2))


def test_ssim_is_its_formula(pictures: tuple[np.ndarray, np.ndarray]):
    """Wang et al., eq. 13, where the window of 11 x 11 lies inside the picture."""
    line = torch.exp(-(torch.arange(-5, 6, dtype=torch.float64) ** 2) / (2 * 1.5**2))
    window = (line[:, None] * line / line.sum() ** 2)[None, None]
    x, y = (torch.as_tensor(on_white(picture)).permute(2, 0, 1)[:, None] for picture in pictures)
    blur = lambda v: torch.nn.functional.conv2d(v, window)  # noqa: E731
    mx, my = blur(x), blur(y)
    vx, vy, cov = blur(x * x) - mx**2, blur(y * y) - my**2, blur(x * y) - mx * my
    value = (2 * mx * my + 1e-4) * (2 * cov + 9e-4) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))
    assert ssim(*pictures) == pytest.approx(float(value.mean()), abs=1e-6)
    assert ssim(pictures[1], pictures[1]) == pytest.approx(1)
