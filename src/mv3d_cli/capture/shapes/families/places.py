"""Buildings and vegetation. Each family: random generator -> parts."""

from __future__ import annotations

import numpy as np

from mv3d_cli.capture.shapes.assembly import around, aspect, painted, pair, place
from mv3d_cli.capture.shapes.deformations import bend, draw_waves, ripple, taper, warp
from mv3d_cli.capture.shapes.draws import chance, count, pick
from mv3d_cli.capture.shapes.extrusions import box, extrusion
from mv3d_cli.capture.shapes.prints import facade, face, label
from mv3d_cli.capture.shapes.surfaces import (
    Part,
    ball,
    cylinder,
    lathe,
    spline,
    tube,
)
from mv3d_cli.capture.shapes.textures import (
    Colour,
    Paint,
    Palette,
    bricks,
    coat,
    colour,
    draw_palette,
    paint_field,
    patterned,
    plain,
    shade,
    timber,
)


def house(rng: np.random.Generator) -> list[Part]:
    """Walls with windows and a door, a roof, a chimney, sometimes a wing."""
    palette = draw_palette(rng)
    half, deep, tall = rng.uniform(0.5, 0.9), rng.uniform(0.45, 0.8), rng.uniform(0.6, 1.4)
    body = box((2 * half, 2 * deep, tall), 0.01)
    walls = [facade(rng, palette, aspect(body, side), door=side == 0) for side in (0, 1)]
    parts = [place(painted(body, walls[0], walls[1], walls[1], walls[1]), (0, 0, tall / 2))]
    parts.append(place(_roof(rng, palette, half, deep), (0, 0, tall - 0.02)))
    chimney = place(box((0.2, 0.2, 0.8), 0.01), (0.5 * half, 0.3 * deep, tall + 0.3))
    lawn = box((2.5 * half, 2.5 * deep, 0.08), 0.02)
    parts += [painted(chimney, _masonry(rng, palette.accent, palette.light, 0.5))]
    parts += [painted(lawn, plain(rng, colour(0.3, 0.45, 0.5)))]
    if chance(rng, 0.4):
        wing = box((0.8 * half, 0.7 * deep, 0.6 * tall), 0.01)
        porch = facade(rng, palette, aspect(wing), door=False)
        parts.append(place(painted(wing, porch), (1.2 * half, -0.2 * deep, 0.3 * tall)))
    return parts


def _masonry(rng: np.random.Generator, stone: Colour, mortar: Colour, tile: float) -> Paint:
    """Bricks or roof tiles."""
    return paint_field(bricks(rng), [stone, shade(stone, 0.65), mortar], tile)


def _roof(rng: np.random.Generator, palette: Palette, half: float, deep: float) -> Part:
    """A gabled or hipped roof over a house of that half width and half depth, from z = 0 up."""
    tiles, wall = _masonry(rng, palette.second, palette.dark, 0.7), plain(rng, palette.light)
    rise, over = rng.uniform(0.3, 0.9), 1.15
    if chance(rng, 0.35):
        block = place(box((2 * over * half, 2 * over * deep, rise), 0), (0, 0, rise / 2))
        return painted(taper(block, -rng.uniform(0.6, 0.97) / rise), tiles)
    across = chance(rng, 0.5)
    x, y = (deep, half) if across else (half, deep)
    gable = np.array([(-over * x, 0), (over * x, 0), (0, rise)])
    return place(painted(extrusion(gable, 2 * over * y, 0.01), wall, tiles, wall), turn=(0, 0, 90 if across else 0))


def castle(rng: np.random.Generator) -> list[Part]:
    """A lighthouse, or a keep with four towers."""
    palette = draw_palette(rng)
    stone = _masonry(rng, palette.main, palette.dark, rng.uniform(0.6, 1.0))
    roof = coat(rng, palette._replace(main=palette.accent), 0.5)
    if chance(rng, 0.45):
        return _lighthouse(rng, palette, stone, roof)
    keep = box((1.3, 1.1, 0.9), 0.01)
    parts = [place(painted(keep, facade(rng, palette, aspect(keep)), stone), (0, 0, 0.45))]
    tall, radius = rng.uniform(0.9, 1.5), rng.uniform(0.2, 0.3)
    tower = painted(cylinder(radius, radius, tall, columns=22), stone)
    cone, slab = (1.3 * radius, 0.02, 0.7, 0, 22), (1.25 * radius, 1.25 * radius, 0.2, 0.02, 22)
    top = painted(cylinder(*(cone if chance(rng, 0.6) else slab)), roof)
    for x, y in ((0.65, -0.55), (0.65, 0.55), (-0.65, -0.55), (-0.65, 0.55)):
        parts += [place(tower, (x, y, 0)), place(top, (x, y, tall - 0.03))]
    merlon = painted(box((0.14, 0.14, 0.2)), stone)
    return parts + [place(merlon, (x, -0.48, 0.96)) for x in np.linspace(-0.4, 0.4, 4)]


def _lighthouse(rng: np.random.Generator, palette: Palette, stone: Paint, roof: Paint) -> list[Part]:
    """A tapering shaft with a gallery, a lantern and a cap."""
    low, high, tall = rng.uniform(0.4, 0.6), rng.uniform(0.25, 0.45), rng.uniform(1.2, 2.2)
    shaft = cylinder(low, high, tall, columns=36)
    look = facade(rng, palette, aspect(shaft)) if chance(rng, 0.5) else stone
    gallery = place(cylinder(1.3 * high, 1.4 * high, 0.14, 0.03, 32), (0, 0, tall))
    lantern = place(cylinder(0.8 * high, 0.8 * high, 0.4, columns=24), (0, 0, tall))
    cap = place(cylinder(1.2 * high, 0.03, rng.uniform(0.3, 0.8), columns=28), (0, 0, tall + 0.35))
    glow = plain(rng, colour(0.14, 0.4, 0.95))
    return [painted(shaft, look, stone), painted(gallery, roof), painted(lantern, glow), painted(cap, roof)]


def tree(rng: np.random.Generator) -> list[Part]:
    """A trunk with a crown: a ball, clumps, tiers of cones, or palm leaves; sometimes fruit."""
    palette = draw_palette(rng)
    tall = rng.uniform(0.6, 1.5)
    bark = timber(rng)
    path = np.array([(0, 0, 0), (rng.uniform(-0.15, 0.15), 0, tall / 2), (0, rng.uniform(-0.1, 0.1), tall)])
    parts = [painted(tube(spline(path, 12), np.linspace(rng.uniform(0.14, 0.24), 0.1, 12), flat=True), bark)]
    hue = pick(rng, [0.26, 0.32, 0.38, 0.1, 0.93])
    green = colour(hue, rng.uniform(0.4, 0.8), rng.uniform(0.3, 0.75))
    shades = (green, shade(green, 0.6), shade(green, 1.4))
    leaves = patterned(rng, *shades) if chance(rng, 0.7) else plain(rng, green, 0.2)
    parts += [painted(part, leaves) for part in _crown(rng, tall)]
    if chance(rng, 0.4):
        berry = painted(place(ball(0.12, 9), (0.35, 0, tall - 0.05)), plain(rng, palette.accent))
        parts += around(berry, 5, -90)
    return parts


def _crown(rng: np.random.Generator, z: float) -> list[Part]:
    """The leaves on a trunk that ends at height z."""
    match count(rng, 0, 2):
        case 0:
            tiers = [cylinder(0.8 - 0.13 * k, 0.03, 0.75, columns=28) for k in range(count(rng, 3, 5))]
            tiers = [warp(tier, draw_waves(rng, 0.02, 5)) for tier in tiers]
            return [place(tier, (0, 0, 0.75 * z + 0.36 * k)) for k, tier in enumerate(tiers)]
        case 1:
            clumps = []
            for k in range(count(rng, 1, 6)):
                size, away = rng.uniform(0.35, 0.6) + 0.25 * (k == 0), 0.5 * (k > 0)
                spot = (away * np.cos(2.4 * k), away * np.sin(2.4 * k), z + 0.3 + 0.15 * (k % 3))
                clumps.append(place(ripple(ball(size, 18), draw_waves(rng, 0.03, 5)), spot))
            return clumps
        case _:
            leaf = place(ball((0.17, 0.03, 0.6), 12), (0, 0, 0.6))
            leaf = bend(leaf, rng.uniform(0.9, 1.5), -np.pi / 2)
            return around(place(leaf, (0, 0, z - 0.05), (rng.uniform(15, 40), 0, 0)), count(rng, 6, 9))


def mushroom(rng: np.random.Generator) -> list[Part]:
    """One to three mushrooms: stem, cap, sometimes a face."""
    palette = draw_palette(rng)
    parts: list[Part] = []
    for k in range(pick(rng, [1, 1, 3])):
        scale = 1.0 if k == 0 else rng.uniform(0.4, 0.65)
        tall, wide, high = rng.uniform(0.7, 1.4), rng.uniform(0.5, 1.0), rng.uniform(0.3, 0.8)
        stops = np.array([(0.28, 0), (0.18, 0.5 * tall), (0.16, tall + 0.1)])
        stem = lathe(np.concatenate([[(0, 0)], spline(stops, 12), [(0, tall + 0.1)]]), columns=24)
        angle = np.linspace(0, np.pi / 2, 12)
        dome = np.stack([wide * np.cos(angle), tall + high * np.sin(angle) ** rng.uniform(0.8, 1.5)], axis=1)
        cap = lathe(np.concatenate([[(0, tall + 0.1), (0.8 * wide, tall - 0.02)], dome]), np.array([1, 1, *[0] * 11]))
        print_of_cap = coat(rng, palette, 0.1)
        look = (
            face(rng, palette._replace(main=palette.light), aspect(stem), 0.5)
            if chance(rng, 0.4)
            else plain(rng, palette.light)
        )
        shift = (0.0, 0.0, 0.0) if k == 0 else (0.7 * np.cos(2.2 * k + 3.5), 0.7 * np.sin(2.2 * k + 3.5), 0.0)
        whole = [painted(stem, look), painted(cap, print_of_cap, plain(rng, shade(palette.light, 0.85)))]
        parts += [place(part, shift, scale=scale) for part in whole]
    return parts


def flower(rng: np.random.Generator) -> list[Part]:
    """A big flower with a face or a windmill's vanes, on a stalk with leaves."""
    palette, tall = draw_palette(rng), rng.uniform(0.9, 1.5)
    stem = tube(spline(np.array([(0, 0, 0), (0.06, 0, tall / 2), (0, 0, tall)]), 12), 0.06, columns=12)
    green = plain(rng, colour(0.3, 0.6, 0.5))
    leaf = bend(place(ball((0.14, 0.03, 0.35), 10), (0, 0, 0.35)), 0.9, 0)
    leaf = place(leaf, (0, 0, 0.3), (0, 35, 0))
    parts = [painted(stem, green), *(painted(part, green) for part in pair(leaf))]
    number, long, wide = count(rng, 5, 12), rng.uniform(0.4, 0.75), rng.uniform(0.12, 0.26)
    petal = bend(place(ball((wide, 0.05, long / 2), 10), (0, 0, 0.25 + long / 2)), rng.uniform(-0.5, 0.5), np.pi / 2)
    colours = [plain(rng, palette.main), plain(rng, palette.second if chance(rng, 0.4) else palette.main)]
    for k in range(number):
        parts.append(place(painted(petal, colours[k % 2]), (0, 0, tall), (0, 360 * k / number, 0)))
    heart = ball((0.32, 0.16, 0.32), 14)
    look = face(rng, palette._replace(main=palette.accent), aspect(heart), 0.5)
    parts.append(place(painted(heart, look), (0, -0.04, tall)))
    if chance(rng, 0.5):
        pot = cylinder(0.3, 0.45, 0.6, 0.03, 32)
        parts.append(place(painted(pot, label(rng, palette, aspect(pot))), (0, 0, -0.5)))
    return parts
