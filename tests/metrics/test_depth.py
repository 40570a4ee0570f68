"""Depth errors of maps whose error is known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mv3d_cli.metrics.depth import depth_error


@pytest.fixture
def true() -> np.ndarray:
    """A slope with a hole."""
    depth = np.tile(np.linspace(1.0, 3.0, 20, dtype=np.float32), (2, 10, 1))
    depth[:, 3:6, 4:9] = 0
    return depth


def test_an_even_shift_is_its_size_in_either_direction(true: np.ndarray) -> None:
    assert depth_error(true, true) == 0
    assert depth_error(true + np.float32(0.25), true) == pytest.approx(0.25, abs=1e-6)
    assert depth_error(true - np.float32(0.5), true) == pytest.approx(0.5, abs=1e-6)


def test_it_is_the_mean_over_the_surface_alone(true: np.ndarray) -> None:
    rng = np.random.default_rng(0)
    error = rng.normal(size=true.shape).astype(np.float32)
    expected = np.mean([abs(e) for e, t in zip(error.ravel(), true.ravel(), strict=True) if t > 0])
    assert depth_error(true + error, true) == pytest.approx(expected, rel=1e-5)
    elsewhere = np.where(true > 0, true, np.float32(77))
    assert depth_error(elsewhere, true) == 0


def test_a_surface_that_was_missed_lies_at_the_camera(true: np.ndarray) -> None:
    half = true.copy()
    half[0] = 0
    surface = true[0][true[0] > 0]
    assert depth_error(half, true) == pytest.approx(surface.mean() / 2, rel=1e-6)


def test_without_a_surface_there_is_no_number(true: np.ndarray) -> None:
    assert math.isnan(depth_error(true, np.zeros_like(true)))
