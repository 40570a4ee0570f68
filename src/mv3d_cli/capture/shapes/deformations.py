"""Deformations of parts: smooth maps of space, so that what is closed or touches still is or does.

Shading normals are taken from the deformed surface when parts are joined.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from mv3d_cli.capture.shapes.draws import Number
from mv3d_cli.capture.shapes.surfaces import Part


def taper(part: Part, rate: Number) -> Part:
    """x and y scaled by 1 + rate * z."""
    scale = 1 + rate * part.vertices[:, 2:]
    return replace(part, vertices=np.concatenate([part.vertices[:, :2] * scale, part.vertices[:, 2:]], axis=1))


def twist(part: Part, rate: Number) -> Part:
    """A turn round +Z of rate * z radians."""
    x, y, z = part.vertices.T
    cos, sin = np.cos(rate * z), np.sin(rate * z)
    return replace(part, vertices=np.stack([cos * x - sin * y, sin * x + cos * y, z], axis=1))


def shear(part: Part, slope_x: Number, slope_y: Number) -> Part:
    """x and y moved in proportion to z."""
    return replace(part, vertices=part.vertices + part.vertices[:, 2:] * np.array([slope_x, slope_y, 0]))


def bend(part: Part, curvature: Number, heading: Number = 0.0) -> Part:
    """The z axis bent into an arc of that curvature (radians per unit) towards `heading` (radians, 0 is +X).

    Lengths along the axis are kept. Points farther than 1 / curvature on the inner side would fold over.
    """
    if abs(curvature) < 1e-9:
        return part
    cos, sin = np.cos(heading), np.sin(heading)
    x, y, z = part.vertices.T
    along, across = cos * x + sin * y, cos * y - sin * x
    reach = 1 / curvature - along
    along, z = 1 / curvature - reach * np.cos(curvature * z), reach * np.sin(curvature * z)
    return replace(part, vertices=np.stack([cos * along - sin * across, sin * along + cos * across, z], axis=1))


@dataclass(frozen=True)
class Waves:
    """A smooth random displacement field: a sum of plane waves."""

    numbers: Float[np.ndarray, "waves 3"]
    phases: Float[np.ndarray, "waves"]
    pushes: Float[np.ndarray, "waves 3"]


def draw_waves(rng: np.random.Generator, amount: Number, frequency: Number, count: int = 6) -> Waves:
    """Waves of about `frequency` radians per unit that displace by about `amount`.

    Points cannot change order while amount * frequency stays below 1 / 2.
    """
    direction = rng.standard_normal((count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    numbers = direction * frequency * rng.uniform(0.5, 1.0, (count, 1))
    return Waves(numbers, rng.uniform(0, 2 * np.pi, count), rng.standard_normal((count, 3)) * amount / np.sqrt(count))


def warp(part: Part, waves: Waves) -> Part:
    """Every point displaced by the waves there."""
    heights = np.sin(part.vertices @ waves.numbers.T + waves.phases)
    return replace(part, vertices=part.vertices + heights @ waves.pushes)


def ripple(part: Part, waves: Waves) -> Part:
    """Every point moved away from the origin by the waves' height in its direction: hills on a ball."""
    distance = np.linalg.norm(part.vertices, axis=1, keepdims=True)
    direction = part.vertices / np.maximum(distance, 1e-9)
    amount = np.linalg.norm(waves.pushes, axis=1)
    heights = np.sin(direction @ waves.numbers.T + waves.phases) @ amount
    return replace(part, vertices=part.vertices * (1 + heights[:, None]))
