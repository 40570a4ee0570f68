"""Vehicles on wheels, wings and water. Each family: random generator -> parts."""

from __future__ import annotations

import numpy as np

from mv3d_cli.capture.shapes.assembly import around, aspect, painted, pair, place
from mv3d_cli.capture.shapes.deformations import taper
from mv3d_cli.capture.shapes.draws import chance, count, pick
from mv3d_cli.capture.shapes.extrusions import box, extrusion
from mv3d_cli.capture.shapes.prints import facade
from mv3d_cli.capture.shapes.surfaces import (
    Part,
    ball,
    cylinder,
    lathe,
    spline,
    torus,
)
from mv3d_cli.capture.shapes.textures import (
    Palette,
    coat,
    colour,
    draw_palette,
    metal,
    patterned,
    plain,
    timber,
)


def _wheels(rng: np.random.Generator, palette: Palette, x: float, ys: list[float], radius: float) -> list[Part]:
    """Tyres and hubs on both sides, axles along x, standing on z = 0."""
    tyre, hub = (
        plain(rng, colour(0, 0, rng.uniform(0.08, 0.2))),
        plain(rng, pick(rng, [palette.accent, palette.light])),
    )
    wide = rng.uniform(0.16, 0.3)
    parts: list[Part] = []
    for y in ys:
        rubber = place(cylinder(radius, radius, wide, 0.05, 28), (x - wide / 2, y, radius), (0, 90, 0))
        cap = place(cylinder(0.6 * radius, 0.5 * radius, 0.06, 0.02, 20), (x + wide / 2 - 0.03, y, radius), (0, 90, 0))
        parts += [painted(part, tyre) for part in pair(rubber)] + [painted(part, hub) for part in pair(cap)]
    return parts


def car(rng: np.random.Generator) -> list[Part]:
    """A car seen from its bonnet, or turned: body, cabin, wheels, lamps, grille."""
    palette = draw_palette(rng)
    skin = plain(rng, palette.main, 0.02) if chance(rng, 0.6) else coat(rng, palette, 0)
    half, long, tall, radius = (
        rng.uniform(0.42, 0.55),
        rng.uniform(0.9, 1.3),
        rng.uniform(0.32, 0.5),
        rng.uniform(0.2, 0.32),
    )
    belt = 0.7 * radius + tall
    body = box((2 * half, 2 * long, tall), rng.uniform(0.06, 0.15))
    start, size, roof = rng.uniform(-0.45, 0.0) * long, rng.uniform(0.7, 1.1) * long, rng.uniform(0.3, 0.55)
    cabin = taper(place(box((1.8 * half, size, roof), 0.06), (0, 0, roof / 2)), -rng.uniform(0.3, 0.8))
    glass = plain(rng, colour(0.58, 0.3, rng.uniform(0.15, 0.5)))
    parts = [painted(place(body, (0, 0, belt - tall / 2)), skin)]
    parts.append(place(painted(cabin, glass, glass, glass, glass, skin), (0, start + 0.4 * size, belt - 0.03)))
    parts += _wheels(rng, palette, half, [-0.62 * long, 0.62 * long], radius)
    lamp = place(ball((0.12, 0.06, 0.1), 9), (0.68 * half, -long, belt - 0.35 * tall))
    rear = place(box((0.2, 0.05, 0.1), 0.02), (0.68 * half, long, belt - 0.35 * tall))
    grille = place(box((0.8 * half, 0.06, 0.35 * tall), 0.02), (0, -long, belt - 0.62 * tall))
    bumper = place(box((1.9 * half, 0.14, 0.1), 0.04), (0, -long, belt - 0.92 * tall))
    parts += [painted(part, plain(rng, colour(0.15, 0.2, 0.98))) for part in pair(lamp)]
    parts += [painted(part, plain(rng, colour(0, 0.85, 0.8))) for part in pair(rear)]
    parts += [painted(grille, plain(rng, palette.dark)), painted(bumper, metal(rng))]
    if chance(rng, 0.35):
        rack = place(box((1.2 * half, 0.4, 0.12), 0.03), (0, start + 0.4 * size, belt + roof))
        parts.append(painted(rack, plain(rng, palette.accent)))
    turn = pick(rng, [0, 0, 30, 50, -40, 90])
    return [place(part, turn=(0, 0, turn)) for part in parts]


def truck(rng: np.random.Generator) -> list[Part]:
    """A lorry, a bus or a locomotive with a load."""
    palette = draw_palette(rng)
    half, long, tall, radius = 0.5, rng.uniform(0.9, 1.3), rng.uniform(0.6, 1.0), rng.uniform(0.2, 0.28)
    floor = 1.2 * radius
    bed = place(box((2 * half, 2 * long, 0.14), 0.03), (0, 0, floor))
    parts = [painted(bed, plain(rng, palette.dark))]
    cab = box((2 * half, 0.55, tall), 0.08)
    front = facade(rng, palette, aspect(cab), door=False)
    parts.append(place(painted(cab, front, plain(rng, palette.main)), (0, -long + 0.3, floor + tall / 2)))
    space = 2 * long - 0.7
    if chance(rng, 0.35):
        load = place(cylinder(0.46, 0.46, space, 0.06, 32), (0, long, floor + 0.5), (90, 0, 0))
    else:
        load = place(box((2.1 * half, space, rng.uniform(0.7, 1.4) * tall), 0.04), (0, 0.35, 0))
        load = place(load, (0, 0, floor + 0.05 - load.vertices[:, 2].min()))
    parts.append(painted(load, coat(rng, palette._replace(main=palette.second), 0.1)))
    parts += _wheels(rng, palette, half - 0.02, list(np.linspace(-0.7, 0.75, count(rng, 2, 3)) * long), radius)
    lamp = place(ball((0.1, 0.05, 0.1), 8), (0.34, -long + 0.02, floor + 0.14))
    parts += [painted(part, plain(rng, colour(0.15, 0.3, 0.98))) for part in pair(lamp)]
    if chance(rng, 0.4):
        pipe = place(cylinder(0.09, 0.13, 0.5, columns=16), (0, -long + 0.4, floor + tall - 0.05))
        parts.append(painted(pipe, metal(rng)))
    turn = pick(rng, [0, 30, 50, -40, 80])
    return [place(part, turn=(0, 0, turn)) for part in parts]


def aircraft(rng: np.random.Generator) -> list[Part]:
    """An aeroplane, a rocket or a helicopter toy."""
    palette = draw_palette(rng)
    skin, trim = coat(rng, palette, 0.3), plain(rng, palette.accent)
    radius, long = rng.uniform(0.2, 0.36), rng.uniform(0.9, 1.2)
    outline = spline(np.array([(0.08, -long), (radius, -0.5 * long), (radius, 0.3 * long), (0.05, long)]), 28)
    hull = lathe(np.concatenate([[(0, -long)], np.maximum(outline, [0.02, -9]), [(0, long)]]), columns=28)
    if chance(rng, 0.4):
        fin = np.array([(0, 0), (0.5, -0.45), (0.5, 0.0), (0, 0.7)])
        fin_part = place(extrusion(fin, 0.07, 0.02), (radius - 0.1, 0, -0.75 * long))
        port = place(torus(0.14, 0.04, 28, 10), (0, -0.98 * radius, 0.15), (90, 0, 0))
        pane = place(ball((0.14, 0.05, 0.14), 10), (0, -0.97 * radius, 0.15))
        nozzle = place(cylinder(0.26, 0.12, 0.3), (0, 0, -long - 0.2))
        parts = [painted(hull, skin), painted(nozzle, metal(rng)), painted(port, trim)]
        parts.append(painted(pane, plain(rng, colour(0.55, 0.5, 0.8))))
        return parts + [painted(part, trim) for part in around(fin_part, count(rng, 3, 4), 45)]
    hull = place(hull, turn=(90, 0, 0))
    span, sweep = rng.uniform(0.8, 1.3), rng.uniform(0, 0.6)
    wing = np.array([(0, -0.28), (span, -0.1 - sweep), (span, 0.12 - sweep), (0, 0.3)])
    wing_part = place(extrusion(wing, 0.07, 0.025), (0, 0, rng.uniform(-0.1, 0.15)), (-90, 0, 0))
    flat = place(extrusion(wing * 0.4, 0.05, 0.02), (0, 0.8 * long, 0.05), (-90, 0, 0))
    upright = np.array([(-0.1, 0), (0.28, 0), (0.32, 0.5), (0.1, 0.5)])
    rudder = place(extrusion(upright, 0.06, 0.02), (0, 0.7 * long, 0.05), (0, 0, 90))
    dome = place(ball((0.7 * radius, 0.36, 0.2), 12), (0, -0.35 * long, 0.8 * radius))
    parts = [painted(hull, skin), painted(dome, plain(rng, colour(0.56, 0.35, 0.6)))]
    second = coat(rng, palette._replace(main=palette.second), 0.4)
    parts += [painted(part, second) for part in (*pair(wing_part), *pair(flat))] + [painted(rudder, trim)]
    blade = place(box((1.1, 0.05, 0.12), 0.02), (0, -long - 0.04, 0), (0, rng.uniform(0, 180), 0))
    parts += [painted(blade, plain(rng, palette.dark)), painted(place(ball(0.11, 9), (0, -long, 0)), trim)]
    turn = pick(rng, [0, 30, 60, -45])
    return [place(part, turn=(0, 0, turn)) for part in parts]


def boat(rng: np.random.Generator) -> list[Part]:
    """A hull with a cabin and a funnel, or a mast with sails."""
    palette = draw_palette(rng)
    half, long = rng.uniform(0.35, 0.5), 1.1
    y = np.linspace(-1, 1, 14)
    beam = half * (1 - np.abs(y) ** rng.uniform(2, 4) * np.where(y < 0, 1, 0.45)) + 0.02
    outline = np.concatenate([np.stack([beam, y * long], axis=1), np.stack([-beam, y * long], axis=1)[::-1]])
    hull = taper(place(extrusion(outline, 0.5, 0.03, 4), turn=(-90, 0, 0)), 0.7)
    deck = timber(rng)
    parts = [painted(hull, deck, coat(rng, palette, 0.3), plain(rng, palette.dark))]
    if chance(rng, 0.5):
        mast = place(cylinder(0.05, 0.04, 1.9, columns=12), (0, 0, 0.1))
        sail = np.array([(0.06, 0.15), (0.95, 0.2), (0.06, 1.65)])
        rear = place(extrusion(sail, 0.04, 0.01), (0, 0, 0.2), (0, 0, 90))
        fore = place(extrusion(sail[::-1] * [-0.85, 0.8], 0.04, 0.01), (0, 0, 0.2), (0, 0, 90))
        cloth = coat(rng, palette._replace(main=palette.light), 0.2)
        parts += [painted(mast, timber(rng)), painted(rear, cloth), painted(fore, cloth)]
    else:
        cabin = box((1.2 * half, 0.8, 0.5), 0.04)
        front = facade(rng, palette._replace(main=palette.light), aspect(cabin), door=False)
        parts.append(place(painted(cabin, front), (0, 0.1, 0.48)))
        for k in range(count(rng, 1, 2)):
            pipe = place(cylinder(0.14, 0.12, 0.55, 0.02, 18), (0, 0.35 * k, 0.68))
            parts.append(painted(pipe, patterned(rng, palette.accent, palette.dark)))
    turn = pick(rng, [30, 60, 90, -50, 0])
    return [place(part, turn=(0, 0, turn)) for part in parts]
