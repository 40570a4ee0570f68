"""Animals: bilateral bodies whose eyes look ahead. Each family: random generator -> parts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mv3d_cli.capture.shapes.assembly import around, painted, pair, place
from mv3d_cli.capture.shapes.draws import chance, count, pick
from mv3d_cli.capture.shapes.extrusions import extrusion
from mv3d_cli.capture.shapes.prints import eyeball
from mv3d_cli.capture.shapes.surfaces import (
    Part,
    Vector,
    ball,
    cylinder,
    spline,
    superquadric,
    tube,
)
from mv3d_cli.capture.shapes.textures import (
    Paint,
    Palette,
    coat,
    colour,
    draw_palette,
    plain,
)


def eyes(rng: np.random.Generator, palette: Palette, at: Vector, size: float) -> list[Part]:
    """Two balls that look ahead, mirrored about x = 0."""
    iris = pick(rng, [palette.dark, palette.accent, colour(rng.random(), 0.7, 0.5)])
    print_of_eye = eyeball(rng, iris) if chance(rng, 0.8) else plain(rng, palette.dark)
    return pair(place(painted(ball(size, 12), print_of_eye), at))


def limb(points: Sequence[Vector], radius: float, end: float) -> Part:
    """A soft limb along a curve, from one thickness to another."""
    return tube(spline(np.array(points, float), 12), np.linspace(radius, end, 12), columns=12)


def ears(rng: np.random.Generator, head: Vector, size: float) -> list[Part]:
    """Pointed, round, floppy or long ears on a head of that size, or horns."""
    x, y, z = head
    match count(rng, 0, 4):
        case 0:
            ear = place(cylinder(0.36 * size, 0.02, 0.75 * size, columns=14), scale=(1, 0.5, 1))
            return pair(place(ear, (x + 0.55 * size, y, z + 0.6 * size), (0, 22, 0)))
        case 1:
            return pair(place(ball((0.36 * size, 0.16 * size, 0.36 * size), 10), (x + 0.72 * size, y, z + 0.68 * size)))
        case 2:
            ear = place(
                ball((0.16 * size, 0.3 * size, 0.6 * size), 10),
                (x + 0.95 * size, y, z - 0.05 * size),
                (0, -14, 0),
            )
            return pair(ear)
        case 3:
            ear = place(
                ball((0.2 * size, 0.12 * size, 0.8 * size), 12),
                (x + 0.4 * size, y, z + 1.4 * size),
                (0, 12, 0),
            )
            return pair(ear)
        case _:
            s = size
            horn = [
                (x + 0.5 * s, y, z + 0.6 * s),
                (x + 0.9 * s, y, z + 1.0 * s),
                (x + 0.8 * s, y - 0.2 * s, z + 1.5 * s),
            ]
            return pair(limb(horn, 0.18 * s, 0.03 * s))


def quadruped(rng: np.random.Generator) -> list[Part]:
    """Four legs, a trunk, a neck, a head with muzzle and ears, a tail. It looks to the front, or sideways."""
    palette = draw_palette(rng)
    skin = coat(rng, palette, 0.25)
    length, girth, leg = rng.uniform(0.5, 1.0), rng.uniform(0.28, 0.5), rng.uniform(0.3, 1.0)
    back = leg + 0.8 * girth
    trunk = superquadric(rng.uniform(0.7, 1), 1, (girth, length, girth), 18, 30)
    parts = [painted(place(trunk, (0, 0, back)), skin)]
    thick = rng.uniform(0.09, 0.16)
    for y in (-0.65 * length, 0.65 * length):
        leg_part = cylinder(thick, 1.3 * thick, back, 0.03, 16)
        hoof = place(
            superquadric(0.7, 1, (1.4 * thick, 1.6 * thick, thick), 8, 16),
            (0.55 * girth, y - 0.04, 0.8 * thick),
        )
        parts += [painted(part, skin) for part in pair(place(leg_part, (0.55 * girth, y, 0.02)))]
        parts += [painted(part, plain(rng, palette.dark)) for part in pair(hoof)]
    size = rng.uniform(0.26, 0.45)
    rise = rng.uniform(0.1, 1.3) if chance(rng, 0.4) else rng.uniform(0.1, 0.4)
    head: Vector = (0, -length - 0.25, back + 0.4 * girth + rise)
    neck = limb([(0, -0.7 * length, back), (0, -length, back + 0.3 * rise), head], 0.7 * girth, 0.6 * size)
    parts += [painted(neck, skin), *_animal_head(rng, palette, skin, head, size)]
    tip = (0, length + rng.uniform(0.2, 0.7), back + rng.uniform(-0.4, 0.6))
    tail = limb([(0, 0.9 * length, back), (0, length + 0.2, back + 0.2), tip], rng.uniform(0.05, 0.12), 0.04)
    parts.append(painted(tail, plain(rng, palette.second)))
    turn = pick(rng, [0, 0, 35, 60, -35])
    return [place(part, turn=(0, 0, turn)) for part in parts]


def _animal_head(rng: np.random.Generator, palette: Palette, skin: Paint, head: Vector, size: float) -> list[Part]:
    """Skull, muzzle or trunk, nose, eyes and ears."""
    x, y, z = head
    parts = [painted(place(ball((size, 0.95 * size, 0.95 * size), 16), head), skin)]
    reach = rng.uniform(0.5, 1.0) * size
    pale = plain(rng, pick(rng, [palette.light, palette.second]))
    if chance(rng, 0.15):
        trunk = [(0, y - 0.7 * size, z - 0.1), (0, y - 1.7 * size, z - 0.5), (0, y - 1.9 * size, z - 1.1)]
        parts.append(painted(limb(trunk, 0.36 * size, 0.2 * size), skin))
    else:
        muzzle = ball((0.55 * size, reach, 0.45 * size), 12)
        nose = ball(0.17 * size, 8)
        parts.append(painted(place(muzzle, (x, y - 0.7 * size, z - 0.25 * size)), pale))
        parts.append(painted(place(nose, (x, y - 0.68 * size - reach, z - 0.15 * size)), plain(rng, palette.dark)))
    parts += eyes(rng, palette, (0.42 * size, y - 0.78 * size, z + 0.32 * size), rng.uniform(0.15, 0.24) * size)
    return parts + [painted(ear, pick(rng, [skin, pale])) for ear in ears(rng, head, size)]


def bird(rng: np.random.Generator) -> list[Part]:
    """Body, head, beak, wings, tail and feet."""
    palette = draw_palette(rng)
    skin = coat(rng, palette, 0.3)
    body = superquadric(1, 1, (0.5, 0.7, rng.uniform(0.45, 0.75)), 18, 30)
    body = place(body, (0, 0, 0.9), (rng.uniform(-45, -5), 0, 0))
    size, y, z = rng.uniform(0.28, 0.4), rng.uniform(-0.6, -0.3), rng.uniform(1.5, 2.1)
    neck = limb([(0, -0.25, 1.1), (0, y + 0.05, 0.5 * (z + 1.1)), (0, y, z)], 0.3, 0.7 * size)
    beak = place(
        cylinder(0.4 * size, 0.02, rng.uniform(0.6, 1.8) * size, columns=14),
        (0, y - 0.8 * size, z - 0.05),
        (90, 0, 0),
    )
    orange = plain(rng, colour(rng.uniform(0.05, 0.13), 0.85, 0.95))
    wing = superquadric(1, 1, (0.07, rng.uniform(0.5, 0.8), 0.32), 12, 24)
    wing = place(wing, (0.5, 0.1, 1.0), (rng.uniform(-40, 0), rng.uniform(-60, 10), 0))
    tail = place(ball((0.28, 0.5, 0.07), 10), (0, 0.9, 0.85), (rng.uniform(-20, 40), 0, 0))
    leg = place(cylinder(0.05, 0.06, 0.7, columns=10), (0.2, 0, 0.02))
    toes = place(ball((0.16, 0.26, 0.05), 8), (0.2, -0.1, 0.04))
    second = coat(rng, palette._replace(main=palette.second), 0.4)
    parts = [
        painted(body, skin),
        painted(neck, skin),
        painted(place(ball(size, 14), (0, y, z)), skin),
        painted(beak, orange),
    ]
    parts += [painted(part, second) for part in (*pair(wing), tail)]
    parts += [painted(part, orange) for part in (*pair(leg), *pair(toes))]
    parts += eyes(rng, palette, (0.6 * size, y - 0.55 * size, z + 0.3 * size), 0.24 * size)
    if chance(rng, 0.4):
        crest = place(ball((0.05, 0.14, 0.25), 8), (0, y + 0.05, z + size), (-30, 0, 0))
        parts.append(painted(crest, plain(rng, palette.accent)))
    return parts


def fish(rng: np.random.Generator) -> list[Part]:
    """A fish or a whale, swimming sideways or ahead."""
    palette = draw_palette(rng)
    long, high, thick = rng.uniform(0.8, 1.2), rng.uniform(0.35, 0.8), rng.uniform(0.2, 0.45)
    body = superquadric(1, 1, (thick, long, high), 24, 40)
    parts = [painted(body, coat(rng, palette, 0.0))]
    fin = plain(rng, palette.accent)
    fork = rng.uniform(0.2, 0.5)
    tail = np.array([(-0.15, 0), (0.7, -0.7), (0.7 - fork, 0), (0.7, 0.7)]) * rng.uniform(0.6, 1)
    tail_part = place(extrusion(tail, 0.08, 0.03), (0, 0.88 * long, 0), (0, 0, 90))
    dorsal = np.array([(-0.5, 0), (0.5, 0), (0.6, rng.uniform(0.3, 0.6)), (0.1, rng.uniform(0.3, 0.6))])
    dorsal_part = place(extrusion(dorsal, 0.07, 0.02), (0, 0, 0.85 * high), (0, 0, 90))
    side = place(ball((0.3, 0.16, 0.03), 10), (thick + 0.15, -0.2 * long, -0.2), (0, 35, 25))
    parts += [painted(part, fin) for part in (tail_part, dorsal_part, *pair(side))]
    parts += eyes(rng, palette, (0.72 * thick, -0.72 * long, 0.2 * high), rng.uniform(0.1, 0.17))
    lips = place(ball((0.12, 0.08, 0.08), 8), (0, -long, -0.05))
    parts.append(painted(lips, plain(rng, palette.second)))
    turn = pick(rng, [90, 60, 45, -90, 0])
    return [place(part, turn=(0, 0, turn)) for part in parts]


def crawler(rng: np.random.Generator) -> list[Part]:
    """An insect, a caterpillar, a crab or an octopus: many limbs or segments."""
    palette = draw_palette(rng)
    skin, trim = coat(rng, palette, 0.25), plain(rng, palette.second)
    if chance(rng, 0.35):
        return _octopus(rng, palette, skin)
    segments, parts = count(rng, 2, 5), []
    y = 0.0
    for k in range(segments):
        size = rng.uniform(0.32, 0.45)
        y += 0.75 * size * (k > 0)
        parts.append(
            painted(
                place(ball((size, size, 0.9 * size), 14), (0, y, 0.6)),
                skin if k % 2 else coat(rng, palette, 0.4),
            )
        )
        reach = rng.uniform(0.6, 0.9)
        stops = [(0.25, y, 0.6), (reach, y - 0.05, rng.uniform(0.6, 1.0)), (reach + 0.2, y - 0.1, 0.02)]
        parts += [painted(part, trim) for part in pair(limb(stops, 0.07, 0.04))]
        y += 0.75 * size
    head = painted(place(ball(0.4, 14), (0, -0.55, 0.75)), skin)
    feeler = limb([(0.15, -0.6, 1.05), (0.3, -0.75, 1.4), (0.45, -1.0, 1.45)], 0.035, 0.06)
    parts += [head, *(painted(part, trim) for part in pair(feeler))]
    parts += eyes(rng, palette, (0.19, -0.86, 0.88), 0.13)
    if chance(rng, 0.5):
        wing = place(ball((0.75, 0.42, 0.03), 12), (0.7, 0.25, 1.1), (0, -25, 30))
        parts += [painted(part, coat(rng, palette._replace(main=palette.light), 0)) for part in pair(wing)]
    return parts


def _octopus(rng: np.random.Generator, palette: Palette, skin: Paint) -> list[Part]:
    """A round head on six to eight curling arms."""
    high = rng.uniform(0.6, 0.9)
    parts = [painted(place(superquadric(0.9, 1, (0.6, 0.6, high), 18, 30), (0, 0, 0.5 + high)), skin)]
    reach, curl = rng.uniform(0.8, 1.3), rng.uniform(0.1, 0.6)
    arm = limb([(0.2, 0, 0.7), (0.6 * reach, 0, 0.25), (reach, 0, 0.12), (reach + 0.15, 0, 0.12 + curl)], 0.2, 0.06)
    parts += around(painted(arm, skin), count(rng, 6, 8), 22.5)
    return parts + eyes(rng, palette, (0.22, -0.5, 0.6 + high), 0.15)
