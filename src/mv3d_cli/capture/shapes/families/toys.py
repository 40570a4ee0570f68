"""Toys, instruments and objects of no name: signs, balls, rings, solids put together with a plan.

Each family: random generator -> parts.
"""

from __future__ import annotations

import numpy as np

from mv3d_cli.capture.shapes.assembly import around, aspect, mirrored, painted, pair, place
from mv3d_cli.capture.shapes.deformations import bend, draw_waves, ripple, taper, twist
from mv3d_cli.capture.shapes.draws import chance, count, pick
from mv3d_cli.capture.shapes.extrusions import blocky, box, extrusion, gear, heart, polygon, rounded_rectangle
from mv3d_cli.capture.shapes.prints import face, label, pips
from mv3d_cli.capture.shapes.surfaces import (
    Part,
    ball,
    cylinder,
    lathe,
    loop,
    spline,
    superquadric,
    torus,
)
from mv3d_cli.capture.shapes.textures import (
    Paint,
    coat,
    draw_palette,
    metal,
    plain,
    shade,
    timber,
)

LETTERS = (
    ("###..", "#....", "####.", "#....", "###.."),
    ("#...", "#...", "#...", "####"),
    ("#####", "#####", ".###.", ".###.", ".###."),
    ("#.#", "#.#", "###", "#.#", "#.#"),
    ("####.", "#....", "#....", "#....", "####."),
    ("..#..", ".###.", "#####", "..#..", "..#.."),
    ("#...", "##..", "###.", "####"),
    ("#..#", "#..#", "#..#", "####"),
    (".##.", "####", "####", ".##."),
    ("####", "...#", "..##", ".##.", "##.."),
    ("###", "#..", "###", "..#", "###"),
    ("#...#", "#...#", "##.##", ".###.", "..#.."),
)


def guitar(rng: np.random.Generator) -> list[Part]:
    """A stringed instrument: waisted body, neck, pegs."""
    palette = draw_palette(rng)
    wide, waist, shoulder = rng.uniform(0.5, 0.75), rng.uniform(0.25, 0.6), rng.uniform(0.35, 0.6)
    half = spline(np.array([(0.1, -0.75), (wide, -0.4), (waist, 0.1), (shoulder, 0.45), (0.1, 0.68)]), 22)
    outline = np.concatenate([half, half[::-1] * [-1, 1]])
    wood = timber(rng) if chance(rng, 0.5) else coat(rng, palette, 0.2)
    body = painted(extrusion(outline, 0.24, 0.05), wood, plain(rng, palette.dark), wood)
    hole = place(cylinder(0.17, 0.17, 0.04, columns=28), (0, -0.11, 0.08), (90, 0, 0))
    neck = place(box((0.16, 0.1, 1.4), 0.03), (0, -0.14, 1.05))
    head = place(box((0.26, 0.1, 0.36), 0.03), (0, -0.13, 1.85), (8, 0, 0))
    bridge = place(box((0.4, 0.06, 0.08), 0.02), (0, -0.14, -0.3))
    dark = plain(rng, shade(palette.dark, 1.2))
    pegs = [place(ball((0.1, 0.04, 0.04), 7), (0.17, -0.13, 1.75 + 0.12 * k)) for k in range(3)]
    parts = [body, *(painted(part, dark) for part in (hole, neck, bridge)), painted(head, wood)]
    return parts + [painted(q, metal(rng)) for p in pegs for q in (p, mirrored(p))]


def sign(rng: np.random.Generator) -> list[Part]:
    """A flat extruded figure: star, heart, gear, letter, badge; alone or on a stand."""
    palette = draw_palette(rng)
    shapes = [
        polygon(count(rng, 5, 8), rng.uniform(0.4, 0.7)),
        heart(),
        gear(count(rng, 7, 14), rng.uniform(0.12, 0.3)),
        blocky(pick(rng, LETTERS)),
        blocky(pick(rng, LETTERS)),
        rounded_rectangle(2, rng.uniform(1, 2), 0.4),
        polygon(count(rng, 3, 8)),
    ]
    figure = extrusion(pick(rng, shapes), rng.uniform(0.12, 0.8), rng.uniform(0, 0.08))
    rim = plain(rng, pick(rng, [palette.dark, palette.second, palette.light]))
    front = face(rng, palette, 1.0, 0.6) if chance(rng, 0.3) else coat(rng, palette, 0.2)
    parts = [painted(figure, front, rim, coat(rng, palette, 0.6))]
    if chance(rng, 0.35):
        parts.append(painted(place(cylinder(0.07, 0.07, 1.0, columns=14), (0, 0, -1.7)), rim))
        parts.append(painted(place(cylinder(0.5, 0.4, 0.12, 0.03), (0, 0, -1.8)), timber(rng)))
    elif chance(rng, 0.3):
        boss = place(cylinder(0.3, 0.24, 0.9, 0.05), (0, 0.45, 0), (90, 0, 0))
        parts.append(painted(boss, metal(rng)))
    return parts


def badge(rng: np.random.Generator) -> Part:
    """A small flat figure that faces the front, to stick on other objects."""
    palette = draw_palette(rng)
    outline = pick(rng, [polygon(5, 0.5), polygon(24), heart(), rounded_rectangle(2, 1.4, 0.3), gear(9, 0.25)])
    figure = extrusion(rng.uniform(0.14, 0.3) * outline, 0.12, 0.02)
    look = pick(rng, [face, label])(rng, palette, aspect(figure)) if chance(rng, 0.5) else coat(rng, palette, 0.5)
    return painted(figure, look, plain(rng, palette.accent))


def die(rng: np.random.Generator) -> list[Part]:
    """A die, or a cube with a face."""
    palette = draw_palette(rng)
    cube = box((1.5, 1.5, 1.5), rng.uniform(0.05, 0.5))
    if chance(rng, 0.5):
        ink = palette.light if palette.main.mean() < 0.6 else palette.dark
        return [painted(cube, *(pips(int(n), palette.main, ink) for n in rng.permutation(6) + 1))]
    side = coat(rng, palette, 0.3)
    return [painted(cube, face(rng, palette, 1.0, 0.7), side)]


def ball_toy(rng: np.random.Generator) -> list[Part]:
    """A ball, an egg or a gem, patterned; or with a face and feet."""
    palette = draw_palette(rng)
    exponents = pick(rng, [(1, 1), (1, 1), (0.4, 0.4), (1.9, 1), (1, 2), (0.3, 1)])
    body = superquadric(*exponents, (0.9, 0.9, rng.uniform(0.7, 1.2)), 28, 44)
    if chance(rng, 0.45):
        return [painted(body, coat(rng, palette, 0.0))]
    foot = place(superquadric(0.8, 1, (0.26, 0.4, 0.16), 10, 20), (0.38, -0.12, -0.92))
    hand = place(ball((0.16, 0.18, 0.22), 10), (0.95, -0.15, -0.1))
    trim = plain(rng, palette.second)
    parts = [painted(body, face(rng, palette, aspect(body), 0.42))]
    return parts + [painted(part, trim) for part in (*pair(foot), *pair(hand))]


def ring_stand(rng: np.random.Generator) -> list[Part]:
    """Tori: a doughnut, a stacking toy, a knot on a foot."""
    palette = draw_palette(rng)
    colours = [palette.main, palette.second, palette.accent, palette.light]
    kind = count(rng, 0, 2)
    if kind == 0:
        minor = rng.uniform(0.2, 0.38)
        dough = place(torus(0.7, minor, 48, 22), turn=(pick(rng, [0, 60, 90]), 0, 0))
        return [painted(dough, coat(rng, palette, 0.15))]
    if kind == 1:
        parts = [painted(cylinder(0.7, 0.7, 0.15, 0.04), plain(rng, palette.dark))]
        parts.append(painted(cylinder(0.12, 0.08, 2.0, 0.03), plain(rng, palette.light)))
        for k in range(count(rng, 3, 5)):
            minor = 0.2 - 0.015 * k
            paint = plain(rng, colours[k % 4]) if chance(rng, 0.7) else coat(rng, palette, 0)
            parts.append(painted(place(torus(0.55 - 0.08 * k, minor, 36, 16), (0, 0, 0.32 + 0.34 * k)), paint))
        return parts
    p, q = pick(rng, [(2, 3), (3, 2), (2, 5), (3, 4)])
    t = np.linspace(0, 2 * np.pi, 160, endpoint=False)
    away = 0.75 + 0.3 * np.cos(q * t)
    path = np.stack([away * np.cos(p * t), 0.3 * np.sin(q * t), away * np.sin(p * t)], axis=1)
    knot = painted(loop(path, rng.uniform(0.09, 0.15), 14), coat(rng, palette, 0.2))
    return [knot, painted(place(cylinder(0.5, 0.4, 0.25, 0.05), (0, 0, -1.25)), plain(rng, palette.second))]


def assembly_of_solids(rng: np.random.Generator) -> list[Part]:
    """A core with mirrored, ringed or stacked attachments."""
    palette = draw_palette(rng)
    core = place(_solid(rng, True), scale=tuple(rng.uniform(0.5, 1.1, 3)))
    skin = coat(rng, palette, 0.1)
    front: Paint = face(rng, palette, aspect(core), 0.45) if chance(rng, 0.2) else skin
    parts = [painted(core, front, skin)]
    half = np.abs(core.vertices).max(axis=0)
    for _ in range(count(rng, 1, 3)):
        solid = _solid(rng, False)
        small = place(solid, turn=tuple(rng.uniform(-40, 40, 3)), scale=tuple(rng.uniform(0.2, 0.55, 3)))
        paint = coat(rng, palette._replace(main=pick(rng, [palette.second, palette.accent, palette.light])), 0.4)
        match count(rng, 0, 3):
            case 0:
                at = (0.9 * half[0], rng.uniform(-0.5, 0.5) * half[1], rng.uniform(-0.8, 0.8) * half[2])
                parts += [painted(part, paint) for part in pair(place(small, at))]
            case 1:
                ringed = place(small, (0.9 * half[:2].max(), 0, rng.uniform(-0.7, 0.7) * half[2]), scale=0.8)
                parts += [painted(part, paint) for part in around(ringed, count(rng, 3, 6))]
            case 2:
                parts.append(painted(place(small, (0, 0, half[2] + 0.1)), paint))
            case _:
                parts.append(painted(place(small, (0, -0.85 * half[1], rng.uniform(-0.4, 0.4) * half[2])), paint))
    if chance(rng, 0.4):
        foot = place(cylinder(0.6, 0.5, 0.25, 0.05), (0, 0, -half[2] - 0.12))
        parts.append(painted(foot, plain(rng, palette.dark)))
    return parts


def totem(rng: np.random.Generator) -> list[Part]:
    """Unlike solids on top of each other, one of them with a print in front."""
    parts: list[Part] = []
    z = 0.0
    for _ in range(count(rng, 3, 5)):
        solid = place(_solid(rng, False), scale=(*rng.uniform(0.5, 1.0, 2), rng.uniform(0.3, 0.8)))
        low, high = solid.vertices[:, 2].min(), solid.vertices[:, 2].max()
        solid = place(solid, (0, 0, z - low))
        z += 0.93 * (high - low)
        if chance(rng, 0.25):
            look = pick(rng, [face, label])(rng, draw_palette(rng), aspect(solid))
            parts.append(painted(solid, look))
        else:
            parts.append(_finish(rng, solid))
    if chance(rng, 0.4):
        parts.append(_finish(rng, place(ball(0.25, 12), (0, 0, z + 0.15))))
    return parts


def _solid(rng: np.random.Generator, fine: bool) -> Part:
    """A random solid within about a unit of the origin, deformed as a whole."""
    rows = 22 if fine else 12
    match count(rng, 0, 6):
        case 0 | 1:
            exponents = rng.uniform(0.25, 1.8, 2)
            solid = superquadric(float(exponents[0]), float(exponents[1]), (0.8, 0.8, 0.8), rows, 2 * rows)
        case 2:
            solid = box((1.4, 1.4, 1.4), rng.uniform(0.02, 0.4))
        case 3:
            solid = place(cylinder(rng.uniform(0.3, 0.8), rng.uniform(0.3, 0.8), 1.4, 0.06, 2 * rows), (0, 0, -0.7))
        case 4:
            stops = np.stack([rng.uniform(0.2, 0.8, 5), np.linspace(-0.7, 0.7, 5)], axis=1)
            outline = np.maximum(spline(stops, rows), [0.1, -9])
            solid = lathe(np.concatenate([[(0, -0.7)], outline, [(0, 0.7)]]), columns=2 * rows)
        case 5:
            outline = [
                polygon(count(rng, 3, 8), pick(rng, [1, 0.6])),
                gear(9, 0.2),
                rounded_rectangle(1.6, 1.2, 0.3),
            ]
            solid = extrusion(0.8 * pick(rng, outline), rng.uniform(0.4, 1.2), 0.06, 4)
        case _:
            solid = place(torus(0.6, rng.uniform(0.14, 0.28), 2 * rows, 14), turn=(pick(rng, [0, 90]), 0, 0))
    return _deformed(rng, solid)


def _deformed(rng: np.random.Generator, solid: Part) -> Part:
    """One deformation, or none."""
    match count(rng, 0, 5):
        case 0:
            return taper(solid, rng.uniform(-0.7, 0.7))
        case 1:
            return twist(solid, rng.uniform(-1.2, 1.2))
        case 2:
            return bend(solid, rng.uniform(-0.7, 0.7), rng.uniform(0, np.pi))
        case 3:
            return ripple(solid, draw_waves(rng, 0.05, 3))
        case _:
            return solid


def _finish(rng: np.random.Generator, part: Part) -> Part:
    """The part in the colours of a palette of its own or in a material."""
    kind = rng.random()
    if kind < 0.15:
        return painted(part, pick(rng, [metal, timber])(rng))
    return painted(part, coat(rng, draw_palette(rng), 0.3), coat(rng, draw_palette(rng), 0.6))
