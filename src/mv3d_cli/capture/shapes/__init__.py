"""Procedural objects: coloured, textured meshes from a seed alone, to train on without any data set.

    surfaces, extrusions    closed parts: lathes, superquadrics, tubes; boxes, extruded outlines
    deformations            bend, taper, twist, shear, waves
    textures, prints        patterns that tile; pictures with a right way up
    assembly                parts placed, painted and joined
    families                what is made of them: vases, chairs, creatures, cars ...

An object is a union of closed parts that interpenetrate; what lies inside never shows.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mv3d_cli.capture.shapes.assembly import join, place
from mv3d_cli.capture.shapes.deformations import bend, draw_waves, shear, taper, twist, warp
from mv3d_cli.capture.shapes.draws import chance, pick
from mv3d_cli.capture.shapes.families import FAMILIES
from mv3d_cli.capture.shapes.families.toys import badge
from mv3d_cli.capture.shapes.surfaces import Part
from mv3d_cli.scene.mesh import Mesh


def procedural_mesh(seed: int) -> Mesh:
    """The object of that seed: textured, front to -Y, some 2 units tall, not normalised.

    The same seed gives the same bytes. Seeds are non-negative; numpy raises ValueError for others.
    """
    return join(procedural_parts(seed))


def procedural_parts(seed: int) -> list[Part]:
    """The closed, painted parts whose union is `procedural_mesh(seed)`."""
    rng = np.random.default_rng(seed)
    families, weights = zip(*FAMILIES, strict=True)
    parts = _centred(pick(rng, families, weights)(rng))
    return _varied(rng, [*parts, *_badges(rng, parts)] if chance(rng, 0.12) else parts)


def _centred(parts: list[Part]) -> list[Part]:
    """The object with the middle of its bounding box at the origin, where deformations do least harm."""
    low = np.min([part.vertices.min(axis=0) for part in parts], axis=0)
    high = np.max([part.vertices.max(axis=0) for part in parts], axis=0)
    return [replace(part, vertices=part.vertices - (low + high) / 2) for part in parts]


def _badges(rng: np.random.Generator, parts: list[Part]) -> list[Part]:
    """A sticker or two, half sunk into the foremost surface near the middle, so that the front matters more."""
    vertices = np.concatenate([part.vertices for part in parts])
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    badges = []
    for _ in range(pick(rng, [1, 1, 2])):
        target = rng.uniform(0.25, 0.75, 2) * (high - low)[[0, 2]] + low[[0, 2]]
        near = vertices[np.hypot(*(vertices[:, [0, 2]] - target).T) < 0.15 * (high - low)[[0, 2]].max()]
        if len(near):
            badges.append(place(badge(rng), tuple(near[near[:, 1].argmin()])))
    return badges


def _varied(rng: np.random.Generator, parts: list[Part]) -> list[Part]:
    """Other proportions, and sometimes one deformation of the whole."""
    stretch = np.exp(rng.normal(0, 0.13, 3))
    parts = [replace(part, vertices=part.vertices * stretch) for part in parts]
    if chance(rng, 0.55):
        return parts
    amount, heading = rng.uniform(0.05, 0.22) * rng.choice([-1, 1]), rng.uniform(0, np.pi)
    waves = draw_waves(rng, 0.06, 2.2)
    kind = int(rng.integers(6))
    changes = (
        lambda part: bend(part, amount, heading),
        lambda part: taper(part, amount),
        lambda part: twist(part, amount),
        lambda part: shear(part, 0.5 * amount, 0.3 * amount),
        lambda part: warp(part, waves),
        lambda part: warp(part, waves),
    )
    return [changes[kind](part) for part in parts]
