"""Families of objects: each is a function from a random generator to painted parts, some 2 units tall."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mv3d_cli.capture.shapes.families import (
    creatures,
    figures,
    furniture,
    goods,
    places,
    toys,
    vehicles,
    vessels,
)
from mv3d_cli.capture.shapes.surfaces import Part

Family = Callable[[np.random.Generator], list[Part]]

FAMILIES: tuple[tuple[Family, float], ...] = (
    (vessels.vase, 1.5),
    (vessels.mug, 1.5),
    (vessels.bottle, 1.5),
    (vessels.bowl, 1.0),
    (vessels.teapot, 1.0),
    (vessels.can, 1.0),
    (vessels.goblet, 0.8),
    (vessels.plant, 1.2),
    (vessels.bucket, 0.8),
    (toys.ring_stand, 0.9),
    (furniture.table, 1.2),
    (furniture.chair, 1.4),
    (furniture.lamp, 1.0),
    (furniture.cabinet, 1.1),
    (furniture.sofa, 1.2),
    (furniture.clock, 0.8),
    (furniture.television, 0.9),
    (furniture.stool, 0.8),
    (goods.package, 1.6),
    (goods.stack, 1.2),
    (toys.die, 0.6),
    (goods.book, 0.9),
    (toys.sign, 1.4),
    (goods.tool, 1.2),
    (goods.fruit, 1.1),
    (goods.cake, 1.0),
    (toys.ball_toy, 1.0),
    (goods.shoe, 1.5),
    (goods.hat, 0.8),
    (goods.gadget, 1.2),
    (toys.guitar, 0.5),
    (creatures.quadruped, 2.2),
    (figures.doll, 2.0),
    (figures.robot, 1.6),
    (creatures.bird, 1.3),
    (creatures.fish, 1.0),
    (creatures.crawler, 1.0),
    (figures.monster, 1.2),
    (figures.chess_piece, 0.7),
    (vehicles.car, 1.8),
    (vehicles.truck, 1.2),
    (vehicles.aircraft, 1.2),
    (vehicles.boat, 0.9),
    (places.house, 1.4),
    (places.castle, 0.9),
    (places.tree, 1.1),
    (places.mushroom, 0.8),
    (places.flower, 0.8),
    (toys.assembly_of_solids, 2.0),
    (toys.totem, 1.0),
)
