"""Lights for an object: an environment in spherical harmonics of degree 2, one sun with a shadow, a highlight.

World axes and linear light as in `scene.conventions`.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Float

from mv3d_cli.kernels.shade import Light
from mv3d_cli.scene.camera import direction_on_sphere

Lighting = Literal["random", "studio", "none"]

COSINE_OVER_PI = np.array([1] + [2 / 3] * 3 + [1 / 4] * 5)
"""The cosine lobe's zonal coefficients over pi, by degree (Ramamoorthi & Hanrahan, 2001, eq. 8)."""


def harmonics(directions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 9"]:
    """The nine real spherical harmonics of degree <= 2 at unit directions, in the usual order."""
    x, y, z = directions.T
    return np.stack(
        [
            0.282095 * np.ones_like(x),
            0.488603 * y,
            0.488603 * z,
            0.488603 * x,
            1.092548 * x * y,
            1.092548 * y * z,
            0.315392 * (3 * z**2 - 1),
            1.092548 * x * z,
            0.546274 * (x**2 - y**2),
        ],
        axis=1,
    )


def ambient_from_lamps(
    directions: Float[np.ndarray, "lamps 3"],
    radiance: Float[np.ndarray, "lamps 3"],
    floor: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "9 3"]:
    """Irradiance / pi coefficients of far lamps plus an even glow `floor`.

    A lamp of radiance 1 alone gives 1 on the surface that faces it (before truncation to degree 2).
    """
    coefficients = np.pi * (harmonics(directions).T @ radiance) * COSINE_OVER_PI[:, None]
    coefficients[0] += floor / 0.282095
    return coefficients


def studio() -> Light:
    """The same neutral light for every object: a bright sky, a soft key light from the front left, no highlight."""
    directions = np.array([[0.0, 0.0, 1.0], direction_on_sphere(0.0, 0.3, 1.0), direction_on_sphere(np.pi, 0.3, 1.0)])
    radiance = np.array([[0.25] * 3, [0.15] * 3, [0.10] * 3])
    key = np.array(direction_on_sphere(np.deg2rad(-35.0), np.deg2rad(50.0), 1.0))
    return Light(ambient_from_lamps(directions, radiance, np.full(3, 0.38)), key, np.full(3, 0.40))


def random_light(rng: np.random.Generator) -> Light:
    """A light drawn at random, its exposure such that a white object is bright and hardly clipped."""
    count = rng.integers(2, 6)
    directions = rng.normal(size=(count, 3))
    directions[:, 2] = np.abs(directions[:, 2]) * rng.choice([1.0, 1.0, -0.3], size=count)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    tint = 1 + rng.normal(scale=0.05, size=(count, 3))
    radiance = rng.gamma(2.0, 0.5, size=(count, 1)) * tint
    floor = rng.uniform(0.35, 1.2) * (1 + rng.normal(scale=0.03, size=3))
    ambient = ambient_from_lamps(directions, radiance / count, floor)
    azimuth, elevation = rng.uniform(-np.pi, np.pi), np.arcsin(rng.uniform(0.15, 0.98))
    strength = rng.choice([0.0, 1.0], p=[0.15, 0.85]) * rng.uniform(0.2, 1.2)
    sun = strength * (1 + rng.normal(scale=0.04, size=3))
    exposure = rng.uniform(0.75, 1.0) / (0.282095 * ambient[0].mean() + 0.7 * sun.mean())
    return Light(
        ambient=ambient * exposure,
        sun_direction=np.array(direction_on_sphere(azimuth, elevation, 1.0)),
        sun_color=np.maximum(sun * exposure, 0),
        softness=float(rng.uniform(0.003, 0.03)),
        specular=float(rng.choice([0.0, rng.uniform(0.1, 1.0)])),
    )


def light_for(lighting: Lighting, rng: np.random.Generator) -> Light | None:
    """The light that a setting asks for; None = unlit, the picture is the albedo."""
    match lighting:
        case "none":
            return None
        case "studio":
            return studio()
        case "random":
            return random_light(rng)
