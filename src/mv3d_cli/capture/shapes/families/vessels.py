"""Things turned on a wheel: vases, mugs, bottles, bowls, jars. Each family: random generator -> parts."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from mv3d_cli.capture.shapes.assembly import around, aspect, painted, pair, place
from mv3d_cli.capture.shapes.deformations import bend, draw_waves, ripple, twist
from mv3d_cli.capture.shapes.draws import chance, count, pick
from mv3d_cli.capture.shapes.prints import face, label
from mv3d_cli.capture.shapes.surfaces import (
    Part,
    ball,
    cylinder,
    lathe,
    spline,
    superquadric,
    torus,
    tube,
    vessel,
)
from mv3d_cli.capture.shapes.textures import (
    Paint,
    Palette,
    coat,
    colour,
    draw_palette,
    metal,
    plain,
    shade,
)


def section(rng: np.random.Generator, columns: int = 48) -> Float[np.ndarray, "columns"]:
    """A cross-section as factors of the radius: round, squarish, polygonal or fluted."""
    angle = 2 * np.pi * np.arange(columns) / columns
    match count(rng, 0, 4):
        case 0:
            power = rng.uniform(3, 6)
            return 0.9 * (np.abs(np.cos(angle)) ** power + np.abs(np.sin(angle)) ** power) ** (-1 / power)
        case 1:
            sides = pick(rng, [3, 6, 8])
            return 0.9 / np.cos((angle + np.pi / sides) % (2 * np.pi / sides) - np.pi / sides)
        case 2:
            return 1 + rng.uniform(0.03, 0.12) * np.cos(count(rng, 5, 12) * angle)
        case _:
            return np.ones(columns)


def handle(side: float, low: float, high: float, reach: float, thickness: float) -> Part:
    """An ear in the (x, z) plane that leaves the wall at x = `side` and comes back to it."""
    middle = (low + high) / 2
    stops = [
        (side, low),
        (side + 0.75 * reach, low),
        (side + reach, middle),
        (side + 0.75 * reach, high),
        (side, high),
    ]
    path = spline(np.array([(x, 0.0, z) for x, z in stops]), 20)
    return tube(path, thickness, columns=12)


def wall_print(rng: np.random.Generator, palette: Palette, part: Part) -> Paint:
    """What a vessel wears outside: a pattern mostly, else a label or a face."""
    kind = rng.random()
    if kind < 0.6:
        return coat(rng, palette, 0.2)
    return label(rng, palette, aspect(part)) if kind < 0.85 else face(rng, palette, aspect(part))


def vase(rng: np.random.Generator) -> list[Part]:
    """A free profile, often fluted or twisted, sometimes with two ears or a flower."""
    palette, stops = draw_palette(rng), count(rng, 4, 6)
    radii = rng.uniform(0.22, 0.85, stops)
    radii[-1] = rng.uniform(0.2, 0.6)
    heights = np.linspace(0, rng.uniform(1.3, 2.4), stops)
    profile = spline(np.stack([radii, heights], axis=1), 26)
    profile[:, 0] = np.maximum(profile[:, 0], 0.14)
    body = vessel(profile, 0.05, section(rng))
    if chance(rng, 0.2):
        body = twist(body, rng.uniform(-0.8, 0.8))
    parts = [painted(body, wall_print(rng, palette, body), plain(rng, shade(palette.main, 0.8)))]
    if chance(rng, 0.25):
        k = int(0.6 * len(profile))
        ear = handle(profile[k, 0] - 0.04, profile[k - 5, 1], profile[k, 1] + 0.2, rng.uniform(0.2, 0.4), 0.05)
        parts += pair(painted(ear, plain(rng, palette.accent)))
    if chance(rng, 0.25):
        parts += _bouquet(rng, palette, heights[-1])
    return parts


def _bouquet(rng: np.random.Generator, palette: Palette, height: float) -> list[Part]:
    parts: list[Part] = []
    green = plain(rng, colour(0.3, 0.6, 0.5))
    petals = plain(rng, palette.accent)
    for _ in range(count(rng, 1, 4)):
        top = (rng.uniform(-0.5, 0.5), rng.uniform(-0.5, 0.5), height + rng.uniform(0.4, 0.9))
        stem = spline(np.array([(0.0, 0.0, 0.1), (0.0, 0.0, height), top]), 12)
        parts.append(painted(tube(stem, 0.03, columns=8), green))
        leaf = place(ball((0.16, 0.05, 0.07), 7), (0.14, 0, 0))
        parts += [place(painted(p, petals), top) for p in around(leaf, 5)]
        parts.append(place(painted(ball(0.1, 8), plain(rng, palette.light)), top))
    return parts


def mug(rng: np.random.Generator) -> list[Part]:
    """A cup with one ear."""
    palette, height = draw_palette(rng), rng.uniform(0.9, 1.7)
    low, middle, top = rng.uniform(0.4, 0.75), rng.uniform(0.5, 0.8), rng.uniform(0.5, 0.85)
    profile = spline(np.array([(low, 0), (middle, height / 2), (top, height)]), 14)
    body = vessel(profile, 0.06, section(rng, 44) if chance(rng, 0.3) else None)
    inside = plain(rng, pick(rng, [palette.light, palette.accent, palette.main]))
    parts = [painted(body, wall_print(rng, palette, body), inside)]
    side = -1 if chance(rng, 0.3) else 1
    ear = handle(0.93 * min(low, middle), 0.22 * height, 0.8 * height, rng.uniform(0.35, 0.6), rng.uniform(0.05, 0.09))
    parts.append(place(painted(ear, plain(rng, pick(rng, list(palette)))), turn=(0, 0, 0 if side == 1 else 180)))
    if chance(rng, 0.4):
        drink = plain(rng, colour(rng.uniform(0.03, 0.12), 0.7, rng.uniform(0.2, 0.7)))
        inner = 0.93 * np.interp(0.85 * height, profile[:, 1], profile[:, 0])
        parts.append(place(painted(cylinder(0.9 * inner, inner, 0.05), drink), (0, 0, 0.8 * height)))
    return parts


def bottle(rng: np.random.Generator) -> list[Part]:
    """Body, shoulder, neck and cap; the label is on the body."""
    palette = draw_palette(rng)
    radius, body, neck = rng.uniform(0.3, 0.6), rng.uniform(0.7, 1.4), rng.uniform(0.09, 0.2)
    shoulder, throat = rng.uniform(0.15, 0.6), rng.uniform(0.1, 0.4)
    waist = radius * rng.uniform(0.8, 1.05)
    stops = np.array([(radius, 0.06), (waist, body / 2), (radius, body)])
    bulge = np.array([(radius, body), ((radius + neck) / 2 + 0.04, body + 0.7 * shoulder), (neck, body + shoulder)])
    top = body + shoulder + throat
    profile = np.concatenate(
        [[(0, 0), (radius - 0.06, 0)], spline(stops, 10), spline(bulge, 8)[1:], [(neck, top), (0, top)]]
    )
    slots = np.array([1, 1, *[0] * 9, *[1] * (len(profile) - 12)])
    body_part = lathe(profile, slots, section(rng, 44) if chance(rng, 0.3) else None)
    glass = plain(rng, pick(rng, [palette.main, palette.light, colour(0.33, 0.6, 0.3), colour(0.07, 0.7, 0.35)]))
    parts = [painted(body_part, label(rng, palette, aspect(body_part)), glass)]
    cap = cylinder(1.25 * neck, 1.2 * neck, rng.uniform(0.12, 0.3), 0.02)
    parts.append(place(painted(cap, plain(rng, palette.accent)), (0, 0, top - 0.08)))
    return parts


def bowl(rng: np.random.Generator) -> list[Part]:
    """A bowl or a plate, empty or with fruit."""
    palette, height, wide = (
        draw_palette(rng),
        pick(rng, [0.15, 0.5, 0.8]) * rng.uniform(0.8, 1.2),
        rng.uniform(0.9, 1.3),
    )
    foot = wide * rng.uniform(0.3, 0.6)
    profile = spline(np.array([(foot, 0), (0.5 * (foot + wide) + 0.12, 0.4 * height), (wide, height)]), 14)
    dish = vessel(profile, 0.06, section(rng) if chance(rng, 0.3) else None)
    parts = [painted(dish, coat(rng, palette, 0.3), coat(rng, palette._replace(main=palette.light), 0.5))]
    if chance(rng, 0.55):
        for k in range(count(rng, 2, 6)):
            size = rng.uniform(0.2, 0.34)
            angle, away = 2.4 * k, 0.5 * wide * np.sqrt(k / 6)
            skin = plain(rng, colour(pick(rng, [0.0, 0.08, 0.15, 0.28, 0.8]), 0.8, 0.85))
            spot = (away * np.cos(angle), away * np.sin(angle), 0.12 + 0.8 * size + 0.15 * away * height)
            parts.append(place(painted(ripple(ball(size, 14), draw_waves(rng, 0.02, 3)), skin), spot))
    return parts


def teapot(rng: np.random.Generator) -> list[Part]:
    """A round body with spout, ear and lid."""
    palette, tall = draw_palette(rng), rng.uniform(0.5, 0.85)
    body = superquadric(rng.uniform(0.6, 1.1), 1, (0.8, 0.8, tall), 24, 40)
    skin, trim = coat(rng, palette, 0.25), plain(rng, palette.accent)
    path = np.array([(0.6, 0, -0.3 * tall), (1.1, 0, -0.05), (1.2, 0, 0.5 * tall), (1.45, 0, 0.85 * tall)])
    spout = tube(spline(path, 16), np.linspace(0.2, 0.08, 16))
    ear = place(handle(0.7, -0.5 * tall, 0.55 * tall, rng.uniform(0.4, 0.7), 0.08), turn=(0, 0, 180))
    lid = place(superquadric(1, 1, (0.42, 0.42, 0.2), 12, 24), (0, 0, 0.92 * tall))
    knob = place(ball(0.11, 10), (0, 0, 0.92 * tall + 0.26))
    foot = place(cylinder(0.45, 0.4, 0.2, 0.03), (0, 0, -tall - 0.02))
    parts = [painted(body, skin), painted(spout, skin), painted(ear, trim), painted(foot, trim)]
    return [*parts, painted(lid, plain(rng, palette.second)), painted(knob, trim)]


def can(rng: np.random.Generator) -> list[Part]:
    """A tin, a jar with a lid, or a tub, with a printed wall."""
    palette, radius, height = draw_palette(rng), rng.uniform(0.35, 0.8), rng.uniform(0.5, 1.8)
    body = cylinder(radius, radius * rng.uniform(0.85, 1.15), height, 0.04, 40)
    body = painted(body, label(rng, palette, aspect(body)), metal(rng))
    top = float(body.vertices[np.isclose(body.vertices[:, 2], height), 0].max())
    if chance(rng, 0.4):
        rim = plain(rng, colour(0, 0, 0.7))
        return [body, *(painted(place(torus(top, 0.035, 40, 8), (0, 0, z)), rim) for z in (0.97 * height,))]
    lid = cylinder(1.08 * top + 0.02, 1.05 * top + 0.02, rng.uniform(0.15, 0.3), 0.03, 36)
    return [
        body,
        painted(place(lid, (0, 0, 0.97 * height)), coat(rng, palette._replace(main=palette.accent), 0.6)),
    ]


def goblet(rng: np.random.Generator) -> list[Part]:
    """A cup, a candlestick or a trophy on a turned stem."""
    palette, stem = draw_palette(rng), rng.uniform(0.05, 0.12)
    base, cup, top = rng.uniform(0.35, 0.6), rng.uniform(0.3, 0.65), rng.uniform(1.6, 2.3)
    knobs = [(stem * rng.uniform(1, 2.6), z) for z in np.linspace(0.25, 0.9, 5)]
    outside = spline(
        np.array([(base, 0), (0.8 * base, 0.08), *knobs, (cup, 1.3), (cup * rng.uniform(0.8, 1.2), top)]), 36
    )
    outside[:, 0] = np.maximum(outside[:, 0], 0.04)
    skin = metal(rng) if chance(rng, 0.4) else coat(rng, palette, 0.3)
    parts = [painted(vessel(outside, 0.04), skin, plain(rng, palette.dark))]
    if chance(rng, 0.3):
        wax = cylinder(0.7 * cup, 0.7 * cup, rng.uniform(0.4, 1.0), 0.03)
        parts.append(painted(place(wax, (0, 0, 1.2)), plain(rng, palette.light)))
    elif chance(rng, 0.5):
        ear = handle(0.85 * cup, 1.25, 0.5 * (1.3 + top), rng.uniform(0.25, 0.45), 0.05)
        parts += pair(painted(ear, metal(rng)))
    return parts


def plant(rng: np.random.Generator) -> list[Part]:
    """A pot with soil and leaves, a cactus or a small bush."""
    palette = draw_palette(rng)
    profile = np.array([(0.4, 0), (0.5, 0.4), (0.58, 0.8), (0.66, 0.8), (0.66, 0.95)])
    pot = vessel(profile, 0.07, section(rng) if chance(rng, 0.3) else None)
    soil = place(painted(cylinder(0.5, 0.5, 0.1), plain(rng, colour(0.07, 0.5, 0.25))), (0, 0, 0.72))
    parts = [painted(pot, wall_print(rng, palette, pot), plain(rng, shade(palette.main, 0.7))), soil]
    green = colour(rng.uniform(0.2, 0.42), rng.uniform(0.4, 0.8), rng.uniform(0.3, 0.7))
    leaf_paint = coat(rng, palette._replace(main=green, second=shade(green, 0.6), accent=shade(green, 1.5)), 0.4)
    if chance(rng, 0.35):
        return parts + _cactus(rng, leaf_paint, palette)
    number, length = count(rng, 6, 14), rng.uniform(0.8, 1.5)
    blade = place(ball((rng.uniform(0.09, 0.24), 0.025, length / 2), 10), (0, 0, length / 2))
    blade = painted(bend(blade, rng.uniform(0.2, 1.1), -np.pi / 2), leaf_paint)
    for k in range(number):
        tilt = rng.uniform(5, 60)
        parts.append(place(place(blade, turn=(tilt, 0, 137.5 * k), scale=rng.uniform(0.7, 1.1)), (0, 0, 0.75)))
    return parts


def _cactus(rng: np.random.Generator, skin: Paint, palette: Palette) -> list[Part]:
    """A ribbed column with arms and a flower."""
    ribs = 1 + 0.08 * np.cos(10 * 2 * np.pi * np.arange(60) / 60)
    tall = rng.uniform(0.8, 1.6)
    outline = np.array(
        [(0, 0.7), *[(0.32 * np.cos(a) ** 0.5, 0.8 + tall * np.sin(a)) for a in np.linspace(0, 1.5, 12)]]
    )
    column = lathe(np.concatenate([outline, [(0, 0.8 + tall)]]), section=ribs)
    parts = [
        painted(column, skin),
        painted(place(ball(0.12, 9), (0, 0, 0.82 + tall)), plain(rng, palette.accent)),
    ]
    for side in (-1, 1):
        if chance(rng, 0.6):
            z = 0.8 + tall * rng.uniform(0.25, 0.5)
            path = np.array([(0, 0, z), (side * 0.5, 0, z + 0.05), (side * 0.58, 0, z + rng.uniform(0.3, 0.6))])
            parts.append(painted(tube(spline(path, 14), 0.12), skin))
    return parts


def bucket(rng: np.random.Generator) -> list[Part]:
    """A pail or a basket with a hoop to carry it by."""
    palette, height, top = draw_palette(rng), rng.uniform(0.8, 1.3), rng.uniform(0.6, 0.85)
    pail = vessel(spline(np.array([(top * rng.uniform(0.6, 0.9), 0), (top, height)]), 8), 0.05)
    angle = np.linspace(0, np.pi, 24)
    hoop = np.stack([top * np.cos(angle), 0 * angle, height - 0.05 + rng.uniform(0.4, 0.9) * np.sin(angle)], axis=1)
    rim = place(torus(top, 0.05, 40, 10), (0, 0, height))
    trim = plain(rng, palette.accent)
    parts = [painted(pail, wall_print(rng, palette, pail), plain(rng, shade(palette.main, 0.6)))]
    return [*parts, painted(tube(hoop, 0.04, columns=10), trim), painted(rim, trim)]
