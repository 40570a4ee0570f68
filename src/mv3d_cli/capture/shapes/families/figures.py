"""Dolls, robots, monsters: figures that look to the front. Each family: random generator -> parts."""

from __future__ import annotations

import numpy as np

from mv3d_cli.capture.shapes.assembly import aspect, painted, pair, place
from mv3d_cli.capture.shapes.deformations import bend, draw_waves, ripple, taper
from mv3d_cli.capture.shapes.draws import chance, count, pick
from mv3d_cli.capture.shapes.extrusions import box, extrusion, polygon
from mv3d_cli.capture.shapes.families.creatures import ears, limb
from mv3d_cli.capture.shapes.prints import eyeball, face, label, screen
from mv3d_cli.capture.shapes.surfaces import (
    Part,
    Vector,
    ball,
    cylinder,
    lathe,
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
    metal,
    plain,
    shade,
)


def doll(rng: np.random.Generator) -> list[Part]:
    """A plush animal, a person or a snowman: trunk, head with a face, arms, legs."""
    palette = draw_palette(rng)
    skin = coat(rng, palette, 0.5)
    belly, size = rng.uniform(0.4, 0.7), rng.uniform(0.4, 0.7)
    tall = rng.uniform(0.55, 0.9)
    body = superquadric(rng.uniform(0.7, 1.0), 1, (belly, 0.8 * belly, tall), 18, 30)
    body = place(taper(body, rng.uniform(-0.35, 0.1)), (0, 0, 0.45 + tall))
    z = 0.45 + 1.75 * tall + 0.6 * size
    skull = superquadric(rng.uniform(0.7, 1), 1, (size * rng.uniform(0.9, 1.2), size, size), 20, 34)
    look = face(
        rng,
        palette._replace(main=pick(rng, [palette.main, palette.light, colour(0.07, 0.35, 0.9)])),
        aspect(skull),
        0.5,
    )
    clothes = coat(rng, palette._replace(main=palette.second), 0.3)
    parts = [painted(body, clothes), painted(place(skull, (0, 0, z)), look)]
    up = rng.uniform(-0.7, 0.7)
    shoulder = (0.7 * belly, 0, 0.45 + 1.5 * tall)
    hand = (belly + 0.45, -0.2, 0.45 + 1.2 * tall + up)
    arm = limb([shoulder, (belly + 0.2, 0, 0.45 + 1.4 * tall + 0.4 * up), hand], 0.17, 0.12)
    leg = limb([(0.45 * belly, 0, 0.75), (0.5 * belly, -0.02, 0.4), (0.55 * belly, -0.05, 0.14)], 0.22, 0.17)
    foot = place(superquadric(0.7, 1, (0.2, 0.32, 0.14), 10, 18), (0.55 * belly, -0.15, 0.13))
    shoes = plain(rng, palette.dark)
    parts += [painted(p, clothes) for p in pair(arm)] + [painted(p, skin) for p in pair(leg)]
    parts += [painted(p, shoes) for p in pair(foot)] + [painted(p, skin) for p in pair(place(ball(0.16, 10), hand))]
    return parts + _headgear(rng, palette, (0, 0, z), size)


def _headgear(rng: np.random.Generator, palette: Palette, head: Vector, size: float) -> list[Part]:
    """Ears, hair or a hat."""
    z = head[2]
    trim = plain(rng, pick(rng, [palette.accent, palette.dark, palette.second]))
    kind = count(rng, 0, 2)
    if kind == 0:
        return [painted(ear, trim) for ear in ears(rng, head, size)]
    if kind == 1:
        hair = ripple(ball((1.08 * size, 1.05 * size, 0.8 * size), 16), draw_waves(rng, 0.05, 6))
        return [painted(place(hair, (0, 0.28 * size, z + 0.35 * size)), trim)]
    brim, crown = (
        cylinder(1.1 * size, 1.1 * size, 0.06, 0.02, 32),
        cylinder(0.7 * size, pick(rng, [0.05, 0.6]) * size, 0.7 * size),
    )
    return [painted(place(part, (0, 0, z + 0.75 * size)), trim) for part in (brim, crown)]


def robot(rng: np.random.Generator) -> list[Part]:
    """Boxes and cylinders: head with a screen or eyes, chest plate, jointed arms, legs or wheels."""
    palette = draw_palette(rng)
    shell, joint = plain(rng, palette.main) if chance(rng, 0.5) else coat(rng, palette, 0), metal(rng)
    wide, tall = rng.uniform(0.7, 1.1), rng.uniform(0.7, 1.1)
    chest = box((wide, 0.6, tall), rng.uniform(0.03, 0.25))
    chest = taper(chest, rng.uniform(-0.3, 0.3)) if chance(rng, 0.5) else chest
    base = 0.75
    plate = label(rng, palette, aspect(chest), around=False)
    parts = [place(painted(chest, plate, shell), (0, 0, base + tall / 2))]
    side = rng.uniform(0.5, 0.8)
    skull = box((side, 0.55, 0.5), rng.uniform(0.03, 0.25))
    top = base + tall + 0.36
    look = face(rng, palette, aspect(skull), 0.8) if chance(rng, 0.6) else screen(rng, palette, aspect(skull))
    parts.append(place(painted(skull, look, shell), (0, 0, top)))
    neck = place(cylinder(0.14, 0.14, 0.4, columns=16), (0, 0, base + tall - 0.1))
    parts += [painted(neck, joint), *_robot_arms(rng, palette, joint, (wide / 2 + 0.1, base, tall))]
    parts += _robot_legs(rng, palette, (shell, joint), wide)
    if chance(rng, 0.6):
        mast = place(cylinder(0.03, 0.03, 0.4, columns=10), (0, 0, top + 0.2))
        bulb = place(ball(0.09, 9), (0, 0, top + 0.62))
        parts += [painted(mast, joint), painted(bulb, plain(rng, palette.accent))]
    return parts


def _robot_arms(rng: np.random.Generator, palette: Palette, joint: Paint, side: Vector) -> list[Part]:
    """Shoulders, arms and fists; `side` is where the chest ends in x, begins in z, and how tall it is."""
    x, base, tall = side
    shoulder = (x, 0.0, base + 0.85 * tall)
    elbow = (x + 0.14, rng.uniform(-0.2, 0.1), base + rng.uniform(0.2, 0.6) * tall)
    wrist = (x + 0.1, -0.35, base + rng.uniform(0.1, 1.1) * tall)
    arm = tube(spline(np.array([shoulder, elbow, wrist]), 14), 0.1, flat=True, columns=12)
    fist = place(box((0.24, 0.24, 0.24), 0.06), wrist)
    parts = [painted(part, joint) for part in (*pair(place(ball(0.17, 10), shoulder)), *pair(arm))]
    return parts + [painted(part, plain(rng, palette.accent)) for part in pair(fist)]


def _robot_legs(rng: np.random.Generator, palette: Palette, skin: tuple[Paint, Paint], wide: float) -> list[Part]:
    """Legs with feet, or two wheels; `skin` is that of the shell and of the joints."""
    if chance(rng, 0.35):
        wheel = place(cylinder(0.36, 0.36, 0.24, 0.05, 30), (0.28, 0, 0.36), (0, 90, 0))
        axle = place(box((0.5, 0.4, 0.5), 0.05), (0, 0, 0.6))
        return [painted(part, plain(rng, palette.dark)) for part in (*pair(wheel), axle)]
    leg = place(cylinder(0.15, 0.13, 0.7, columns=16), (0.26 * wide, 0, 0.1))
    foot = place(box((0.32, 0.5, 0.2), 0.05), (0.26 * wide, -0.08, 0.1))
    return [painted(part, skin[1]) for part in pair(leg)] + [painted(part, skin[0]) for part in pair(foot)]


def monster(rng: np.random.Generator) -> list[Part]:
    """A lumpy blob with one to three eyes, teeth, spikes and stubby limbs."""
    palette = draw_palette(rng)
    skin, trim = coat(rng, palette, 0.2), plain(rng, palette.accent)
    body = superquadric(rng.uniform(0.6, 1), rng.uniform(0.7, 1), (0.75, 0.6, rng.uniform(0.7, 1.1)), 26, 40)
    parts = [painted(ripple(body, draw_waves(rng, 0.04, 3)), skin)]
    number = count(rng, 1, 3)
    size = rng.uniform(0.16, 0.28)
    for k in range(number):
        x = 0.42 * (k - (number - 1) / 2)
        eye = place(painted(ball(size, 12), eyeball(rng, palette.second)), (x, -0.56 + 0.25 * x * x, 0.35))
        parts.append(eye)
    maw = place(superquadric(1, 1, (0.36, 0.08, rng.uniform(0.05, 0.16)), 10, 24), (0, -0.6, -0.15))
    parts.append(painted(maw, plain(rng, shade(palette.dark, 0.7))))
    for x in np.linspace(-0.2, 0.2, count(rng, 2, 4)):
        tooth = place(cylinder(0.06, 0.01, 0.14, columns=10), (x, -0.66, -0.06), (180, 0, 0))
        parts.append(painted(tooth, plain(rng, palette.light)))
    arm = limb([(0.65, 0, 0), (1.0, -0.1, 0.1), (1.15, -0.2, rng.uniform(-0.3, 0.6))], 0.15, 0.1)
    foot = place(superquadric(0.7, 1, (0.24, 0.38, 0.15), 10, 18), (0.35, -0.12, -0.85))
    parts += [painted(part, skin) for part in pair(arm)] + [painted(part, trim) for part in pair(foot)]
    spike = bend(cylinder(0.13, 0.02, rng.uniform(0.25, 0.6), columns=12), 0.8, np.pi / 2)
    for k in range(count(rng, 0, 4)):
        parts.append(painted(place(spike, (0, 0.1 + 0.14 * k, 0.75 - 0.25 * k), (-20 - 25 * k, 0, 0)), trim))
    return parts + [painted(horn, trim) for horn in (ears(rng, (0, 0, 0.35), 0.6) if chance(rng, 0.6) else [])]


def chess_piece(rng: np.random.Generator) -> list[Part]:
    """A turned figure: pawn, king, nesting doll or bell."""
    palette = draw_palette(rng)
    radii = [0.6, 0.62, 0.45, rng.uniform(0.2, 0.45), rng.uniform(0.2, 0.4), 0.32, 0.18]
    heights = [0, 0.15, 0.3, 0.8, 1.3, 1.45, 1.6]
    outline = spline(np.stack([radii, heights], axis=1), 30)
    body = lathe(np.concatenate([[(0, 0)], outline, [(0, 1.6)]]))
    parts = [painted(body, face(rng, palette, aspect(body), 0.3) if chance(rng, 0.3) else coat(rng, palette, 0.3))]
    head = superquadric(pick(rng, [1, 1, 0.4, 1.8]), 1, (0.36, 0.36, rng.uniform(0.3, 0.5)), 18, 28)
    look = face(rng, palette, aspect(head), 0.5) if chance(rng, 0.5) else coat(rng, palette, 0.3)
    parts.append(place(painted(head, look), (0, 0, 1.9)))
    if chance(rng, 0.5):
        crown = extrusion(polygon(count(rng, 4, 6), 0.45) * 0.24, 0.12, 0.03)
        parts.append(painted(place(crown, (0, 0, 2.4)), plain(rng, palette.accent)))
    return parts
