"""Furniture and what stands on it. Each family: random generator -> parts."""

from __future__ import annotations

import numpy as np

from mv3d_cli.capture.shapes.assembly import around, aspect, painted, pair, place
from mv3d_cli.capture.shapes.draws import chance, count, pick
from mv3d_cli.capture.shapes.extrusions import box, extrusion, polygon, rounded_rectangle
from mv3d_cli.capture.shapes.prints import cover, dial, screen
from mv3d_cli.capture.shapes.surfaces import Part, ball, cylinder, lathe, spline, superquadric, tube, vessel
from mv3d_cli.capture.shapes.textures import Paint, coat, draw_palette, metal, plain, timber


def _stuff(rng: np.random.Generator) -> tuple[Paint, Paint]:
    """What a piece is made of: timber, or painted; and its trim."""
    palette = draw_palette(rng)
    body = timber(rng) if chance(rng, 0.5) else coat(rng, palette, 0.5)
    return body, pick(rng, [metal, timber])(rng) if chance(rng, 0.4) else plain(rng, palette.accent)


def _leg(rng: np.random.Generator, height: float) -> Part:
    """A leg from the floor up: square, round, tapered or turned."""
    thick = rng.uniform(0.05, 0.11)
    match count(rng, 0, 2):
        case 0:
            return place(box((1.6 * thick, 1.6 * thick, height), 0.02), (0, 0, height / 2))
        case 1:
            return cylinder(thick * rng.uniform(0.4, 1), thick, height, 0.02, 16)
        case _:
            stops = np.stack([thick * rng.uniform(0.5, 1.4, 7), np.linspace(0, height, 7)], axis=1)
            outline = np.maximum(spline(stops, 22), 0)
            return lathe(np.concatenate([[(0, 0)], outline, [(0, outline[-1, 1])]]), columns=16)


def _four(leg: Part, x: float, y: float, splay: float = 0.0) -> list[Part]:
    """A leg at each corner of a rectangle, spread out by `splay` degrees."""
    return [place(leg, (sx * x, sy * y, 0), (sy * splay, -sx * splay, 0)) for sx in (-1, 1) for sy in (-1, 1)]


def table(rng: np.random.Generator) -> list[Part]:
    """A top on four legs or a pedestal, with a drawer or a thing on it."""
    body, trim = _stuff(rng)
    height, wide, deep = rng.uniform(0.6, 1.5), rng.uniform(0.7, 1.3), rng.uniform(0.5, 0.9)
    thick = rng.uniform(0.06, 0.2)
    if chance(rng, 0.4):
        top = place(cylinder(wide, wide, thick, 0.03, 40), (0, 0, height))
    else:
        top = place(box((2 * wide, 2 * deep, thick), 0.03), (0, 0, height + thick / 2))
    parts = [painted(top, body)]
    if chance(rng, 0.3):
        foot = np.array([(0.6 * deep, 0), (0.5 * deep, 0.08), (0.12, 0.3), (0.1, 0.7 * height), (0.3, height)])
        stem = spline(foot, 24)
        parts.append(painted(lathe(np.concatenate([[(0, 0)], stem, [(0, height)]])), trim))
    else:
        reach = 0.68 if chance(rng, 0.5) else 0.85
        leg = painted(_leg(rng, height + 0.02), pick(rng, [body, trim]))
        parts += _four(leg, reach * 0.8 * wide, reach * 0.8 * min(deep, wide), rng.uniform(0, 8))
    if chance(rng, 0.5):
        parts += [place(part, (rng.uniform(-0.3, 0.3), 0, height + thick)) for part in _trinket(rng)]
    return parts


def _trinket(rng: np.random.Generator) -> list[Part]:
    """Something small that stands at z = 0."""
    palette = draw_palette(rng)
    match count(rng, 0, 2):
        case 0:
            return [painted(place(ball(0.2, 12), (0, 0, 0.19)), coat(rng, palette, 0.3))]
        case 1:
            size = (0.5, 0.36, 0.1)
            book = box(size, 0.01)
            side = plain(rng, palette.light)
            return [painted(place(book, (0, 0, 0.05)), side, side, side, side, cover(rng, palette, aspect(book, 4)))]
        case _:
            cup = vessel(spline(np.array([(0.12, 0), (0.2, 0.2), (0.14, 0.45)]), 10), 0.03)
            return [painted(cup, coat(rng, palette, 0.3))]


def chair(rng: np.random.Generator) -> list[Part]:
    """Seat, legs and a back of slats, a panel or a hoop; sometimes arms."""
    body, trim = _stuff(rng)
    high, half, rise = rng.uniform(0.6, 1.0), rng.uniform(0.4, 0.55), rng.uniform(0.6, 1.1)
    round_seat = chance(rng, 0.3)
    seat = (
        cylinder(half, half, 0.14, 0.05, 32)
        if round_seat
        else place(box((2 * half, 2 * half, 0.14), 0.05), (0, 0, 0.07))
    )
    parts = [painted(place(seat, (0, 0, high)), trim)]
    parts += _four(painted(_leg(rng, high + 0.03), body), 0.72 * half, 0.72 * half, rng.uniform(0, 8))
    parts += [place(part, (0, 0.8 * half, high + 0.05)) for part in _chair_back(rng, (body, trim), half, rise)]
    if chance(rng, 0.35):
        arm = place(box((0.12, 1.7 * half, 0.09), 0.03), (0.95 * half, 0, high + 0.42))
        prop = place(box((0.08, 0.08, 0.45), 0.01), (0.95 * half, -0.6 * half, high + 0.24))
        parts += [painted(part, body) for part in (*pair(arm), *pair(prop))]
    return parts


def _chair_back(rng: np.random.Generator, paints: tuple[Paint, Paint], half: float, rise: float) -> list[Part]:
    """A back from z = 0 up: slats, a panel, or a hoop with bars; `paints`: frame and upholstery."""
    body, trim = paints
    match count(rng, 0, 2):
        case 0:
            post = place(cylinder(0.05, 0.04, rise, 0.02, 14), (0.8 * half, 0, 0))
            slat = painted(box((1.7 * half, 0.06, 0.13), 0.02), body)
            slats = [place(slat, (0, 0, rise - 0.05 - 0.24 * k)) for k in range(count(rng, 2, 4))]
            return [*(painted(part, body) for part in pair(post)), *slats]
        case 1:
            panel = extrusion(rounded_rectangle(1.9 * half, rise, rng.uniform(0.02, 0.4)), 0.1, 0.03)
            return [painted(place(panel, (0, 0.05 * half, 0.05 + rise / 2)), trim, body)]
        case _:
            arc = np.linspace(0, np.pi, 20)
            hoop = np.stack([0.85 * half * np.cos(arc), 0 * arc, rise * np.sin(arc)], axis=1)
            bar = painted(cylinder(0.03, 0.03, 0.85 * rise, columns=10), body)
            bars = [place(bar, (x, 0, 0.03)) for x in np.linspace(-0.5, 0.5, 4) * half]
            return [painted(tube(hoop, 0.05, columns=10), body), *bars]


def lamp(rng: np.random.Generator) -> list[Part]:
    """Foot, stem and shade."""
    palette, tall = draw_palette(rng), rng.uniform(0.7, 1.6)
    low, high = rng.uniform(0.45, 0.8), rng.uniform(0.2, 0.5)
    hood = vessel(np.array([(low, 0), ((low + high) / 2, 0.35), (high, 0.7)]), 0.03, columns=36)
    parts = [painted(place(hood, (0, 0, tall)), coat(rng, palette, 0.3), plain(rng, palette.light))]
    if chance(rng, 0.5):
        stops = np.stack([rng.uniform(0.06, 0.4, 5), np.linspace(0.05, tall, 5)], axis=1)
        stem = np.maximum(spline(stops, 26), [0.05, 0])
        stem = lathe(np.concatenate([[(0, 0), (0.4, 0)], stem, [(0.05, tall + 0.3), (0, tall + 0.3)]]))
    else:
        parts.append(painted(cylinder(0.5, 0.45, 0.1, 0.03, 32), plain(rng, palette.dark)))
        stem = cylinder(0.05, 0.05, tall + 0.3, columns=14)
    second = palette._replace(main=palette.second)
    return [*parts, painted(stem, metal(rng) if chance(rng, 0.4) else coat(rng, second, 0.3))]


def cabinet(rng: np.random.Generator) -> list[Part]:
    """A body with doors or drawers, or open shelves full of books."""
    palette, (body, trim) = draw_palette(rng), _stuff(rng)
    half, deep, tall = rng.uniform(0.5, 0.9), rng.uniform(0.3, 0.5), rng.uniform(0.9, 2.2)
    parts = _four(painted(_leg(rng, 0.25), trim), 0.8 * half, 0.7 * deep)
    back = place(box((2 * half, 0.06, tall), 0.01), (0, deep, 0.2 + tall / 2))
    side = place(box((0.07, 2 * deep, tall), 0.01), (half, 0, 0.2 + tall / 2))
    rows = count(rng, 2, 4)
    boards = [place(box((2 * half, 2 * deep, 0.07), 0.01), (0, 0, 0.2 + tall * k / rows)) for k in range(rows + 1)]
    parts += [painted(part, body) for part in (back, *pair(side), *boards)]
    filling = count(rng, 0, 2)
    for row in range(rows):
        z, space = 0.2 + tall * row / rows, tall / rows
        if filling == 0:
            parts += [place(part, (0, 0, z + 0.03)) for part in _books(rng, 1.8 * half, deep, space - 0.1)]
            continue
        columns = filling
        for column in range(columns):
            width = 2 * half / columns
            front = place(box((0.9 * width, 0.08, 0.88 * space), 0.02), (0, -deep, z + space / 2))
            x = width * (column + 0.5) - half
            knob = place(ball(0.06, 8), (0, -deep - 0.07, z + space / 2))
            paint = pick(rng, [body, plain(rng, palette.main), plain(rng, palette.light)])
            parts += [painted(place(front, (x, 0, 0)), paint), painted(place(knob, (x, 0, 0)), trim)]
    return parts


def _books(rng: np.random.Generator, wide: float, deep: float, tall: float) -> list[Part]:
    """A row of upright books along x, some left out."""
    parts, x = [], -wide / 2
    paints = [plain(rng, shade) for shade in draw_palette(rng)]
    while True:
        thick = rng.uniform(0.1, 0.24)
        if x + thick > wide / 2:
            return parts
        high = tall * rng.uniform(0.65, 0.95)
        if chance(rng, 0.85):
            book = box((0.95 * thick, 1.4 * deep, high), 0.01)
            parts.append(painted(place(book, (x + thick / 2, -0.1 * deep, high / 2)), pick(rng, paints)))
        x += thick


def sofa(rng: np.random.Generator) -> list[Part]:
    """A sofa, an armchair or a bed, with cushions."""
    palette = draw_palette(rng)
    cloth, other = coat(rng, palette, 0.35), coat(rng, palette._replace(main=palette.second), 0.4)
    half, deep, rise = rng.uniform(0.45, 1.2), rng.uniform(0.45, 0.6), rng.uniform(0.5, 0.9)
    base = place(box((2 * half, 2 * deep, 0.4), 0.1), (0, 0, 0.38))
    back = place(box((2 * half, 0.3, rise), 0.12), (0, deep - 0.1, 0.45 + rise / 2), (-6, 0, 0))
    arm = place(box((0.28, 2 * deep, 0.45), 0.13), (half + 0.05, 0, 0.6))
    parts = [painted(part, cloth) for part in (base, back, *pair(arm))]
    seats = max(1, round(half / 0.45))
    for k in range(seats):
        width = 1.9 * half / seats
        cushion = superquadric(0.45, 0.35, (0.5 * width, 0.85 * deep, 0.13), 12, 28)
        parts.append(painted(place(cushion, (width * (k + 0.5) - 0.95 * half, -0.1, 0.66)), other))
    if chance(rng, 0.6):
        pillow = superquadric(1, 0.4, (0.24, 0.1, 0.24), 12, 24)
        parts.append(
            painted(place(pillow, (0.5 * half, deep - 0.4, 0.98), (-15, 10, 0)), coat(rng, draw_palette(rng), 0))
        )
    legs = painted(cylinder(0.05, 0.07, 0.25, columns=12), timber(rng))
    return parts + _four(legs, 0.85 * half, 0.8 * deep)


def clock(rng: np.random.Generator) -> list[Part]:
    """A clock with bells, feet or a case."""
    palette = draw_palette(rng)
    sides = pick(rng, [40, 40, 6, 8])
    case = extrusion(polygon(sides, phase=np.pi / sides) * 0.9, rng.uniform(0.25, 0.7), 0.06)
    skin, trim = plain(rng, palette.main), plain(rng, palette.accent)
    parts = [place(painted(case, dial(rng, palette), skin, skin), (0, 0, 1.05))]
    foot = place(cylinder(0.06, 0.09, 0.4, columns=12), (0.5, 0, 0), (0, -20, 0))
    parts += [painted(part, trim) for part in pair(foot)]
    if chance(rng, 0.6):
        bell = place(ball((0.3, 0.26, 0.22), 12), (0.5, 0, 1.95), (0, 35, 0))
        parts += [painted(part, trim) for part in pair(bell)]
        parts.append(painted(place(cylinder(0.05, 0.08, 0.3, 0.02, 12), (0, 0, 1.9)), metal(rng)))
    return parts


def television(rng: np.random.Generator) -> list[Part]:
    """A display on a foot: television, monitor, laptop."""
    palette = draw_palette(rng)
    wide, tall, deep = rng.uniform(1.2, 2.2), rng.uniform(0.9, 1.4), pick(rng, [0.08, 0.15, 0.8])
    case = box((wide, deep, tall), 0.04)
    skin = plain(rng, pick(rng, [palette.dark, palette.light, palette.main]))
    picture = screen(rng, palette, aspect(case))
    parts = [painted(place(case, (0, 0, 0.35 + tall / 2)), picture, skin)]
    if deep < 0.1 and chance(rng, 0.5):
        keys = box((wide, 0.9 * tall, 0.08), 0.03)
        board = screen(rng, palette._replace(main=palette.dark), aspect(keys, 4))
        return [*parts, painted(place(keys, (0, -0.43 * tall, 0.35)), skin, skin, skin, skin, board, skin)]
    stem = place(box((0.16, 0.1, 0.5), 0.02), (0, 0, 0.25))
    parts += [painted(stem, metal(rng)), painted(cylinder(0.45, 0.4, 0.07, 0.02, 32), skin)]
    if chance(rng, 0.3):
        antenna = tube(np.array([(0.0, 0, 0), (0.2, 0, 0.3), (0.45, 0, 0.7)]), 0.025, columns=8)
        parts += [painted(place(part, (0, 0, 0.3 + tall)), metal(rng)) for part in pair(antenna)]
    return parts


def stool(rng: np.random.Generator) -> list[Part]:
    """A round seat on three to six spread legs, with rings; or a drum."""
    palette, (body, trim) = draw_palette(rng), _stuff(rng)
    if chance(rng, 0.4):
        tall, radius = rng.uniform(0.7, 1.5), rng.uniform(0.6, 0.9)
        shell = cylinder(radius * rng.uniform(0.7, 1), radius, tall, columns=40)
        rim = [place(cylinder(1.04 * radius, 1.04 * radius, 0.12, 0.03, 40), (0, 0, z)) for z in (0.0, tall - 0.1)]
        parts = [painted(shell, coat(rng, palette, 0.1), plain(rng, palette.light))]
        return parts + [painted(r, trim, plain(rng, palette.light)) for r in rim]
    tall = rng.uniform(0.8, 1.8)
    leg = place(_leg(rng, tall), (0.35 + 0.17 * tall, 0, 0), (0, -10, 0))
    seat = place(cylinder(0.6, 0.6, 0.18, 0.07, 36), (0, 0, 0.95 * tall))
    return [painted(seat, trim, body), *around(painted(leg, body), count(rng, 3, 6))]
