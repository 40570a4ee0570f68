"""Random draws: choices, spelt the way a family reads, and smooth noise that repeats without a seam."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import TypeVar

import numpy as np
from jaxtyping import Float

T = TypeVar("T")
Number = float | int
Field = Float[np.ndarray, "size size"]
SIZE = 256
"""Texels along a side of a texture."""


def chance(rng: np.random.Generator, probability: Number) -> bool:
    """True with that probability."""
    return bool(rng.random() < probability)


def count(rng: np.random.Generator, low: int, high: int) -> int:
    """A whole number from `low` to `high`, both included."""
    return int(rng.integers(low, high + 1))


def pick(rng: np.random.Generator, options: Sequence[T], weights: Sequence[Number] | None = None) -> T:
    """One of the options, equally likely or by weight."""
    if weights is None:
        return options[int(rng.integers(len(options)))]
    share = np.cumsum(weights)
    return options[int(np.searchsorted(share, rng.random() * share[-1], side="right"))]


@lru_cache(maxsize=64)
def _spline_weights(size: int, lattice: int) -> Float[np.ndarray, "size lattice"]:
    """Periodic cubic B-spline interpolation from `lattice` values to `size` texels."""
    place = (np.arange(size) + 0.5) * lattice / size
    base = np.floor(place).astype(int)
    t = place - base
    taps = [(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3]
    weights = np.zeros((size, lattice))
    for offset, tap in enumerate(taps):
        np.add.at(weights, (np.arange(size), (base + offset - 1) % lattice), tap / 6)
    return weights


def noise(rng: np.random.Generator, across: int, down: int, size: int = SIZE) -> Field:
    """Smooth periodic noise of about unit variance with that many hills across and down."""
    lattice = rng.standard_normal((down, across))
    return 2 * _spline_weights(size, down) @ lattice @ _spline_weights(size, across).T


def fractal(rng: np.random.Generator, hills: int, octaves: int = 3, size: int = SIZE) -> Field:
    """Octaves of noise, clipped to [0, 1] around 0.5."""
    total = sum(noise(rng, hills * 2**k, hills * 2**k, size) / 2**k for k in range(octaves))
    return np.clip(0.5 + 0.28 * total, 0, 1)
