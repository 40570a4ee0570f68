"""Colour and normal codecs: round trips and skimage's sRGB."""

from __future__ import annotations

import numpy as np
from skimage.color import rgb2xyz

from mv3d_cli.scene.conventions import bytes_from_normal, linear_from_srgb, normal_from_bytes, srgb_from_linear


def test_srgb_round_trip_and_known_values() -> None:
    codes = np.arange(256) / 255
    assert np.allclose(srgb_from_linear(linear_from_srgb(codes)), codes, atol=1e-12)
    assert np.isclose(linear_from_srgb(np.array([0.5]))[0], 0.21404114)


def test_luminance_agrees_with_skimage() -> None:
    color = np.array([[[0.2, 0.5, 0.9]]])
    ours = linear_from_srgb(color) @ [0.212671, 0.71516, 0.072169]
    assert np.isclose(ours[0, 0], rgb2xyz(color)[0, 0, 1], atol=1e-6)


def test_normals_round_trip_within_a_step() -> None:
    normals = np.random.default_rng(0).normal(size=(500, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    back = normal_from_bytes(bytes_from_normal(normals))
    assert np.rad2deg(np.arccos((back * normals).sum(1).clip(-1, 1))).max() < 0.5
