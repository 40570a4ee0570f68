"""Goods, tools and food. Each family: random generator -> parts."""

from __future__ import annotations

import numpy as np

from mv3d_cli.capture.shapes.assembly import around, aspect, painted, pair, place
from mv3d_cli.capture.shapes.deformations import bend, draw_waves, ripple, taper, warp
from mv3d_cli.capture.shapes.draws import chance, count, pick
from mv3d_cli.capture.shapes.extrusions import box, extrusion, polygon, rounded_rectangle
from mv3d_cli.capture.shapes.prints import cover, label, screen
from mv3d_cli.capture.shapes.surfaces import (
    Part,
    ball,
    cylinder,
    lathe,
    spline,
    superquadric,
    torus,
    tube,
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


def package(rng: np.random.Generator) -> list[Part]:
    """A printed box, tall, flat or long, sometimes with a ribbon."""
    palette = draw_palette(rng)
    size = (rng.uniform(0.5, 1.6), rng.uniform(0.2, 1.2), rng.uniform(0.3, 2.0))
    body = box(size, rng.uniform(0.005, 0.08))
    front = label(rng, palette, aspect(body), around=False)
    side, top = coat(rng, palette, 0.3), plain(rng, pick(rng, [palette.second, palette.light, palette.main]))
    parts = [painted(body, front, side, side, side, top)]
    if chance(rng, 0.3):
        ribbon = plain(rng, palette.accent)
        x, y, z = (length + 0.03 for length in size)
        band = [box((0.2, y, z), 0.01), box((x, y, 0.16), 0.01)]
        loop_size = (0.2 * x + 0.06, 0.1, 0.1)
        bow = place(superquadric(1, 1, loop_size, 10, 16), (0.8 * loop_size[0], 0, z / 2 + 0.04), (0, -20, 0))
        parts += [painted(part, ribbon) for part in (*band, *pair(bow))]
    return parts


def stack(rng: np.random.Generator) -> list[Part]:
    """A tower of boxes, books, dice or toy blocks, each turned a little."""
    parts, z, flat = [], 0.0, chance(rng, 0.5)
    wide = rng.uniform(0.6, 1.0)
    for _ in range(count(rng, 2, 5)):
        palette = draw_palette(rng)
        tall = rng.uniform(0.12, 0.3) if flat else rng.uniform(0.4, 0.7)
        size = (wide * rng.uniform(1.2, 1.5), wide * rng.uniform(0.9, 1.3), tall)
        body = box(size, 0.02 if flat else 0.06)
        side = plain(rng, palette.light) if flat else coat(rng, palette, 0.1)
        front = label(rng, palette, aspect(body), around=False)
        top = cover(rng, palette, aspect(body, 4)) if flat else side
        body = painted(body, front, side, side, side, top)
        parts.append(
            place(
                body,
                (rng.uniform(-0.08, 0.08), rng.uniform(-0.08, 0.08), z + tall / 2),
                (0, 0, rng.uniform(-20, 20)),
            )
        )
        z += tall
        wide *= rng.uniform(0.8, 1.0)
    return parts


def book(rng: np.random.Generator) -> list[Part]:
    """A standing book: covers, spine, pages."""
    palette = draw_palette(rng)
    wide, tall, thick = rng.uniform(0.9, 1.5), rng.uniform(1.2, 2.0), rng.uniform(0.1, 0.5)
    board = box((wide, 0.04, tall), 0.01)
    skin = plain(rng, palette.main)
    front = painted(place(board, (0, -thick / 2, 0)), cover(rng, palette, aspect(board)), skin)
    spine = box((0.05, thick + 0.03, tall), 0.015)
    title = label(rng, palette, aspect(spine, 3), around=False)
    back = painted(place(board, (0, thick / 2, 0)), skin, skin, patterned(rng, palette.main, palette.second), skin)
    pages = box((wide - 0.08, thick, tall - 0.1))
    spine = painted(place(spine, (-wide / 2, 0, 0)), skin, skin, skin, title, skin)
    return [front, back, spine, painted(pages, plain(rng, colour(0.12, 0.1, 0.94)))]


def tool(rng: np.random.Generator) -> list[Part]:
    """Something with a grip and a head: hammer, screwdriver, brush, spoon, axe, mallet."""
    palette, long = draw_palette(rng), rng.uniform(1.0, 1.8)
    stops = np.stack([rng.uniform(0.08, 0.17, 5), np.linspace(0, long, 5)], axis=1)
    grip = spline(stops, 20)
    grip = lathe(np.concatenate([[(0, -0.03)], grip, [(0, long + 0.03)]]), columns=20)
    grip = painted(grip, timber(rng) if chance(rng, 0.5) else coat(rng, palette, 0.2))
    lean = pick(rng, [0, 0, 30, 90])
    return [place(part, turn=(0, lean, 0)) for part in (grip, *_tool_head(rng, palette, long))]


def _tool_head(rng: np.random.Generator, palette: Palette, z: float) -> list[Part]:
    """What a grip that ends at height z holds."""
    steel = metal(rng) if chance(rng, 0.6) else plain(rng, palette.second)
    match count(rng, 0, 4):
        case 0:
            head = place(cylinder(0.2, 0.22, 0.9, 0.05), (-0.45, 0, z), (0, 90, 0))
            claw = bend(taper(place(box((0.3, 0.2, 0.7), 0.04), (0, 0, 0.35)), -0.8), 1.0)
            return [painted(head, steel), painted(place(claw, (0.3, 0, z), (0, 90, 0)), steel)]
        case 1:
            shaft = place(cylinder(0.06, 0.05, 1.0, columns=14), (0, 0, z - 0.05))
            tip = place(box((0.24, 0.04, 0.2), 0.01), (0, 0, z + 0.95))
            return [painted(shaft, steel), painted(tip, steel)]
        case 2:
            root = place(box((0.9, 0.24, 0.3), 0.06), (0, 0, z + 0.1))
            hair = taper(box((0.8, 0.2, 0.6), 0.03), rng.uniform(-0.5, 0.4))
            bristles = patterned(rng, palette.dark, palette.light)
            return [painted(root, steel), painted(place(hair, (0, 0, z + 0.5)), bristles)]
        case 3:
            scoop = superquadric(1, 1, (0.38, 0.09, 0.52), 16, 28)
            return [painted(place(scoop, (0, 0, z + 0.45)), steel)]
        case _:
            blade = [
                (0.1, -0.2),
                (0.85, -0.45),
                (0.95, 0),
                (0.85, 0.45),
                (0.1, 0.2),
                (-0.3, 0.15),
                (-0.3, -0.15),
            ]
            return [painted(place(extrusion(np.array(blade), 0.12, 0.05), (0, 0, z - 0.15)), steel)]


def fruit(rng: np.random.Generator) -> list[Part]:
    """Apple, pear, pumpkin, banana, carrot, pineapple: a lathed body, a stalk and leaves."""
    skin = draw_palette(rng)
    if chance(rng, 0.7):
        hue = pick(rng, [0.0, 0.07, 0.13, 0.22, 0.3, 0.78])
        skin = skin._replace(main=colour(hue, 0.8, 0.85), second=colour(hue + 0.06, 0.7, 0.75))
    kind = count(rng, 0, 3)
    green = plain(rng, colour(0.28, 0.6, rng.uniform(0.3, 0.6)))
    profiles = {
        0: [(0.05, 0.1), (0.5, 0.02), (0.85, 0.6), (0.6, 1.25), (0.06, 1.1)],
        1: [(0.05, 0.05), (0.6, 0.15), (0.75, 0.6), (0.4, 1.2), (0.28, 1.6), (0.05, 1.72)],
        2: [(0.02, 0.0), (0.16, 0.5), (0.3, 1.2), (0.34, 1.6), (0.06, 1.75)],
    }
    if kind == 3:
        path = np.stack([np.linspace(-1, 1, 20), np.zeros(20), 0.5 * np.linspace(-1, 1, 20) ** 2], axis=1)
        return [painted(tube(path, 0.26 * (1 - np.linspace(-0.9, 0.9, 20) ** 4) + 0.03), coat(rng, skin, 0.3))]
    outline = spline(np.array(profiles[kind]), 26)
    outline[:, 0] = np.maximum(outline[:, 0], 0.01)
    ribs = 1 + rng.uniform(0.02, 0.08) * np.cos(count(rng, 5, 9) * 2 * np.pi * np.arange(48) / 48)
    closed = np.concatenate([[(0, outline[0, 1])], outline, [(0, outline[-1, 1])]])
    body = lathe(closed, section=ribs if chance(rng, 0.5) else np.ones(48))
    top = outline[-1, 1]
    stalk = tube(spline(np.array([(0, 0, top - 0.1), (0, 0, top + 0.2), (0.1, 0, top + 0.4)]), 10), 0.05, columns=8)
    parts = [painted(warp(body, draw_waves(rng, 0.03, 2)), coat(rng, skin, 0.25))]
    parts.append(painted(stalk, plain(rng, colour(0.08, 0.5, 0.3))))
    leaf = bend(place(ball((0.12, 0.02, 0.3), 10), (0, 0, 0.3)), 1.0, np.pi / 2)
    leaf = place(leaf, (0, 0, top), (pick(rng, [-30, -60]), 0, 0))
    return parts + [painted(part, green) for part in around(leaf, pick(rng, [1, 2, 6]), 60)]


def cake(rng: np.random.Generator) -> list[Part]:
    """Layers with icing and berries, a burger, or an ice cream."""
    palette = draw_palette(rng)
    layers = [palette.main, palette.light, palette.second, palette.accent]
    if chance(rng, 0.35):
        cone = painted(
            cylinder(0.08, 0.5, 1.2, columns=32),
            patterned(rng, colour(0.09, 0.55, 0.85), colour(0.08, 0.7, 0.6)),
        )
        parts = [cone]
        for k in range(count(rng, 1, 3)):
            scoop = ripple(ball(0.52 - 0.05 * k, 18), draw_waves(rng, 0.03, 7))
            parts.append(place(painted(scoop, coat(rng, palette._replace(main=layers[k]), 0.4)), (0, 0, 1.3 + 0.6 * k)))
        return parts
    parts, z, radius = [], 0.0, rng.uniform(0.7, 1.1)
    for k in range(count(rng, 2, 5)):
        tall = rng.uniform(0.15, 0.5)
        slab = warp(cylinder(radius, radius, tall, 0.06, 40), draw_waves(rng, 0.02, 4))
        parts.append(painted(place(slab, (0, 0, z)), coat(rng, palette._replace(main=layers[k % 4]), 0.5)))
        z += 0.92 * tall
        radius *= rng.uniform(0.7, 1.05)
    number = count(rng, 3, 9)
    berry = painted(place(ball(0.12, 9), (0.75 * radius, 0, z + 0.04)), plain(rng, palette.accent))
    if chance(rng, 0.5):
        return [*parts, *around(berry, number)]
    bun = place(superquadric(0.8, 1, (1.05 * radius, 1.05 * radius, 0.4), 16, 32), (0, 0, z + 0.1))
    return [*parts, painted(bun, coat(rng, palette, 0.4))]


def shoe(rng: np.random.Generator) -> list[Part]:
    """A shoe that points to the front: sole, upper, shaft, laces."""
    palette = draw_palette(rng)
    print_of_foot = superquadric(0.2, 0.8, (0.42, 1.05, 0.12), 10, 36)
    y = print_of_foot.vertices[:, 1:2]
    waist = np.array([1, 0, 0]) * (0.8 + 0.2 * np.cos(2.5 * y + 1.5)) + [0, 1, 1]
    parts = [
        painted(
            place(_shaped(print_of_foot, waist), (0, 0, 0.12)),
            plain(rng, pick(rng, [palette.light, palette.dark])),
        )
    ]
    upper = superquadric(0.7, 0.8, (0.38, 0.98, 0.5), 20, 36)
    y, z = upper.vertices[:, 1:2], upper.vertices[:, 2:]
    slope = np.array([0, 0, 1]) * np.where(z > 0, 0.75 + 0.35 * y, 0.3) + [1, 1, 0] * np.ones_like(y)
    parts.append(painted(place(_shaped(upper, slope), (0, 0, 0.3)), coat(rng, palette, 0.3)))
    tall = rng.uniform(0.3, 1.4)
    shaft = superquadric(0.25, 0.9, (0.34, 0.42, tall / 2), 14, 32)
    parts.append(painted(place(shaft, (0, 0.5, 0.5 + tall / 2)), coat(rng, palette, 0.4)))
    parts.append(
        painted(
            place(torus(0.36, 0.06, 32, 10), (0, 0.5, 0.5 + tall), scale=(0.95, 1.15, 1)),
            plain(rng, palette.accent),
        )
    )
    lace = plain(rng, palette.light)
    for k in range(count(rng, 2, 4)):
        band = place(ball((0.24, 0.045, 0.05), 8), (0, -0.38 + 0.16 * k, 0.58 + 0.06 * k), (20, 0, 0))
        parts.append(painted(band, lace))
    turn = pick(rng, [0, 0, 0, 40, 90, -60])
    if chance(rng, 0.15):
        return [q for part in parts for q in pair(place(part, (0.5, 0, 0)))]
    return [place(part, turn=(0, 0, turn)) for part in parts]


def _shaped(part: Part, factors: np.ndarray) -> Part:
    """The part with every vertex multiplied by its own factors."""
    return Part(part.vertices * factors, part.faces, part.uvs, part.smooth, part.slots)


def hat(rng: np.random.Generator) -> list[Part]:
    """Crown, brim and band; a top hat, a cap, a wizard's or a party hat."""
    palette, tall = draw_palette(rng), rng.uniform(0.4, 1.6)
    low, high = rng.uniform(0.5, 0.7), pick(rng, [0.02, 0.4, 0.6])
    crown = spline(np.array([(low, 0), ((low + high) / 2 + rng.uniform(-0.1, 0.2), tall / 2), (high, tall)]), 16)
    crown = lathe(np.concatenate([[(0, 0)], crown, [(0, tall + 0.1)]]))
    brim = cylinder(low * 1.9, low * 1.9, 0.08, 0.03, 44)
    brim = (
        bend(brim, rng.uniform(0, 0.01) + 1e-3, 0)
        if chance(rng, 0.5)
        else place(brim, (0, -0.3, 0), scale=(0.6, 0.7, 1))
    )
    band = place(cylinder(low * 1.04, low * 1.02, 0.16, 0.02, 40), (0, 0, 0.06))
    badge = place(extrusion(polygon(5, 0.5) * 0.2, 0.1, 0.02), (0, -low * 1.02, 0.25), (10, 0, 0))
    skin = coat(rng, palette, 0.3)
    parts = [painted(crown, skin), painted(brim, skin), painted(band, plain(rng, palette.accent))]
    parts.append(painted(badge, plain(rng, palette.light)))
    if high < 0.1:
        parts.append(painted(place(ball(0.16, 10), (0, 0, tall + 0.08)), plain(rng, palette.second)))
    return parts


def gadget(rng: np.random.Generator) -> list[Part]:
    """A telephone, a tablet, a camera or a radio."""
    palette = draw_palette(rng)
    skin, trim = plain(rng, palette.main), plain(rng, pick(rng, [palette.dark, palette.accent]))
    if chance(rng, 0.4):
        outline = rounded_rectangle(rng.uniform(0.8, 1.6), 2.0, 0.15)
        slab = extrusion(outline, rng.uniform(0.08, 0.25), 0.03)
        lens = place(cylinder(0.13, 0.12, 0.3, 0.02, 20), (0.3, 0.3, 0.6), (90, 0, 0))
        return [painted(slab, screen(rng, palette, aspect(slab)), trim, skin), painted(lens, trim)]
    wide, tall = rng.uniform(1.5, 2.1), rng.uniform(0.9, 1.2)
    case = box((wide, 0.5, tall), 0.1)
    parts = [painted(case, coat(rng, palette, 0.4))]
    x = rng.uniform(-0.35, 0.0)
    rings = [(0.48, 0.35, trim), (0.4, 0.55, metal(rng)), (0.3, 0.58, plain(rng, palette.dark))]
    for radius, reach, paint in rings:
        ring = place(cylinder(radius * tall, radius * tall, reach, 0.03, 36), (x, 0, -0.05), (90, 0, 0))
        parts.append(painted(ring, paint))
    parts.append(painted(place(box((0.5, 0.4, 0.3), 0.06), (x, 0, tall / 2 + 0.08)), skin))
    for k in range(count(rng, 1, 3)):
        knob = place(cylinder(0.1, 0.09, 0.2, 0.02, 18), (wide / 2 - 0.25 - 0.26 * k, 0, tall / 2 - 0.04))
        parts.append(painted(knob, plain(rng, palette.accent)))
    plate = box((0.4, 0.1, 0.2), 0.02)
    badge = place(plate, (wide / 2 - 0.3, -0.25, 0.2))
    return [*parts, painted(badge, label(rng, palette, aspect(plate), around=False))]
