"""Pictures with a right way up: labels with words, faces, book covers, dials, windows.

A print spreads once over its surface, its middle in front. `aspect` is the surface's width over its height.
"""

from __future__ import annotations

import numpy as np

from mv3d_cli.capture.shapes.drawing import Sheet, disc, panel, printed, sheet, stroke, write
from mv3d_cli.capture.shapes.draws import Number, chance, count, pick
from mv3d_cli.capture.shapes.textures import Colour, Paint, Palette, Picture, colour, pattern, shade

WORDS = "BA CO DI FE GU HA JO KI LU MA NE OX PI RO SA TE UM VI WA XE YO ZU AL TRI SUN MAX"
SYLLABLES = tuple(WORDS.split())


def word(rng: np.random.Generator) -> str:
    """A name that nobody has trademarked."""
    return "".join(pick(rng, SYLLABLES) for _ in range(count(rng, 1, 3)))[:6]


def _emblem(rng: np.random.Generator, page: Sheet, y: float, size: float, palette: Palette) -> None:
    """A logo: a mark on a disc or panel, a bunch of fruit, or a sun."""
    kind = count(rng, 0, 4)
    if kind < 3:
        (disc if chance(rng, 0.6) else panel)(page, 0, y, (size, size), palette.accent)
    match kind:
        case 0:
            disc(page, 0, y, (size / 2, size / 2), palette.light)
        case 1:
            peak = [(-0.6 * size, y + 0.4 * size), (0, y - 0.5 * size), (0.6 * size, y + 0.4 * size)]
            stroke(page, peak, size / 4, palette.light)
        case 2:
            write(page, word(rng)[0], 0, y, (size, 1.2 * size), palette.light)
        case 3:
            for k, ink in enumerate((palette.accent, palette.main, palette.second)):
                disc(page, 0.55 * size * (k - 1), y + 0.3 * size * (k % 2), (0.5 * size, 0.5 * size), ink)
            stroke(page, [(0, y), (0.2 * size, y - 0.8 * size)], 0.12 * size, palette.dark)
        case _:
            for turn in np.arange(6) * np.pi / 6:
                x, rise = size * np.cos(turn), size * np.sin(turn)
                stroke(page, [(-x, y - rise), (x, y + rise)], 0.14 * size, palette.second)
            disc(page, 0, y, (0.6 * size, 0.6 * size), palette.accent)


def _ground(rng: np.random.Generator, page: Sheet, half: tuple[float, float], palette: Palette) -> None:
    """What a label is printed on: a panel, a band all round, an oval."""
    match count(rng, 0, 4):
        case 0:
            panel(page, 0, 0, (9, half[1]), palette.light, 0)
        case 1:
            disc(page, 0, 0, (1.25 * half[0], 1.12 * half[1]), palette.accent)
            disc(page, 0, 0, (1.2 * half[0], 1.07 * half[1]), palette.light)
        case _:
            panel(page, 0, 0, half, palette.light, rng.uniform(0.01, 0.1))
    if chance(rng, 0.5):
        panel(page, 0, half[1] - 0.05, (half[0], 0.04), palette.second, 0.01)


def _lines(rng: np.random.Generator, page: Sheet, y: float, half: tuple[float, float], ink: Colour) -> None:
    """Small print: a few short bars."""
    for k in range(count(rng, 2, 4)):
        width = half[0] * rng.uniform(0.5, 1)
        panel(page, 0, y + 1.6 * half[1] * k, (width, 0.35 * half[1]), ink, 0)


def _barcode(rng: np.random.Generator, page: Sheet, x: float, y: float, half: tuple[float, float]) -> None:
    panel(page, x, y, (1.15 * half[0], 1.2 * half[1]), colour(0, 0, 0.97))
    places = np.linspace(-half[0], half[0], 17)
    for place in places[rng.random(17) < 0.7]:
        panel(page, x + place, y, (half[0] / 34 * count(rng, 1, 2), half[1]), colour(0, 0, 0.08), 0)


def _background(rng: np.random.Generator, palette: Palette) -> Colour | Picture:
    if chance(rng, 0.45):
        return palette.main
    return pattern(rng, palette.main, pick(rng, [palette.second, palette.dark, shade(palette.main, 0.75)]))


def label(rng: np.random.Generator, palette: Palette, aspect: Number, around: bool = True) -> Paint:
    """A package's print: a name, a logo, small print; with `around`, in front only and a barcode behind."""
    page = sheet(_background(rng, palette), aspect)
    half = (min(rng.uniform(0.16, 0.24) * aspect, 0.6) if around else 0.42 * aspect, rng.uniform(0.26, 0.42))
    _ground(rng, page, half, palette)
    top = chance(rng, 0.5)
    size = min(0.6 * half[0], 0.45 * half[1])
    _emblem(rng, page, (-0.45 if top else 0.1) * half[1], size, palette)
    write(page, word(rng), 0, (0.3 if top else -0.62) * half[1], (1.7 * half[0], 0.45 * half[1]), palette.dark)
    _lines(rng, page, 0.68 * half[1], (0.8 * half[0], 0.09 * half[1]), shade(palette.dark, 1.3))
    if around:
        _barcode(rng, page, -0.44 * aspect, 0.1, (0.04 * aspect, 0.12))
        panel(page, 0.47 * aspect, -0.1, (0.02 * aspect, 0.2), palette.accent)
    return printed(page)


def face(rng: np.random.Generator, palette: Palette, aspect: Number, width: Number = 0.5) -> Paint:
    """Eyes, brows, nose, mouth and cheeks in the middle; `width` is the face's, in sheet heights."""
    page = sheet(_background(rng, palette), aspect)
    if chance(rng, 0.4):
        disc(page, 0, 0.02, (0.62 * width, rng.uniform(0.3, 0.4)), palette.light)
    apart, radius = width * rng.uniform(0.22, 0.32), width * rng.uniform(0.09, 0.17)
    eye_y, tall = rng.uniform(-0.16, -0.04), rng.uniform(0.9, 1.6)
    iris, white = pick(rng, [palette.dark, colour(rng.random(), 0.8, 0.6)]), chance(rng, 0.65)
    brow = rng.uniform(-0.06, 0.06)
    gaze = rng.uniform(-0.3, 0.3) * radius
    cheeks = chance(rng, 0.4)
    for side in (-1, 1):
        if white:
            disc(page, side * apart, eye_y, (radius, radius * tall), colour(0, 0, 0.97))
        disc(page, side * apart + gaze, eye_y, (0.55 * radius, 0.55 * radius * tall), iris)
        disc(page, side * apart + gaze, eye_y, (0.28 * radius, 0.28 * radius * tall), palette.dark)
        disc(
            page,
            side * apart + gaze + 0.2 * radius,
            eye_y - 0.2 * radius,
            (0.13 * radius, 0.13 * radius),
            colour(0, 0, 1),
        )
        lid = eye_y - radius * tall - 0.03
        stroke(
            page,
            [(side * (apart - radius), lid - brow), (side * (apart + radius), lid + brow)],
            0.025,
            palette.dark,
        )
        if cheeks:
            disc(page, side * 1.35 * apart, eye_y + 0.2, (0.6 * radius, 0.5 * radius), colour(0.98, 0.5, 0.95))
    _mouth(rng, page, eye_y + rng.uniform(0.22, 0.32), width, palette)
    return printed(page)


def _mouth(rng: np.random.Generator, page: Sheet, y: float, width: float, palette: Palette) -> None:
    half, sag = width * rng.uniform(0.12, 0.3), rng.uniform(-0.02, 0.08)
    if chance(rng, 0.25):
        disc(page, 0, y, (0.6 * half, 0.5 * half), palette.dark)
        disc(page, 0, y + 0.2 * half, (0.35 * half, 0.2 * half), colour(0.98, 0.7, 0.85))
        return
    bow = [(half * t, y - sag * (2 * t * t - 1)) for t in np.linspace(-1, 1, 7)]
    stroke(page, bow, rng.uniform(0.02, 0.04), pick(rng, [palette.dark, colour(0.99, 0.8, 0.6)]))
    if chance(rng, 0.5):
        disc(page, 0, y - 0.11, (0.05 * width, 0.04 * width), palette.accent)


def eyeball(rng: np.random.Generator, iris: Colour) -> Paint:
    """The print of a ball that looks ahead."""
    page = sheet(colour(0, 0, 0.97), 2.0)
    size = rng.uniform(0.13, 0.2)
    for radius, ink in ((size, iris), (0.55 * size, colour(0, 0, 0.05))):
        disc(page, 0, 0, (radius, radius), ink)
    disc(page, 0.3 * size, -0.35 * size, (0.25 * size, 0.25 * size), colour(0, 0, 1))
    return printed(page)


def dial(rng: np.random.Generator, palette: Palette) -> Paint:
    """A clock face."""
    page = sheet(palette.light, 1.0)
    for k in range(12):
        x, y = np.sin(k * np.pi / 6), -np.cos(k * np.pi / 6)
        stroke(page, [(0.38 * x, 0.38 * y), (0.44 * x, 0.44 * y)], 0.015 if k % 3 else 0.035, palette.dark)
    for length, width in ((0.22, 0.04), (0.33, 0.025)):
        turn = rng.uniform(0, 2 * np.pi)
        stroke(page, [(0, 0), (length * np.sin(turn), -length * np.cos(turn))], width, palette.dark)
    disc(page, 0, 0, (0.035, 0.035), palette.accent)
    return printed(page)


def cover(rng: np.random.Generator, palette: Palette, aspect: Number) -> Paint:
    """A book's front: title, rule, picture."""
    page = sheet(_background(rng, palette), aspect)
    ink = pick(rng, [palette.light, palette.accent])
    panel(page, 0, -0.27, (0.42 * aspect, 0.14), palette.dark, 0.02)
    write(page, word(rng), 0, -0.32, (0.74 * aspect, 0.1), palette.light)
    write(page, word(rng), 0, -0.2, (0.5 * aspect, 0.06), ink)
    panel(page, 0, 0.15, (0.36 * aspect, 0.2), palette.light, 0.02)
    _emblem(rng, page, 0.15, min(0.15, 0.3 * aspect), palette)
    panel(page, 0, 0.43, (0.3 * aspect, 0.015), ink)
    return printed(page)


def facade(rng: np.random.Generator, palette: Palette, aspect: Number, door: bool = True) -> Paint:
    """A wall with rows of windows and, in front, a door."""
    page = sheet(_background(rng, palette), aspect)
    floors = count(rng, 1, 3)
    columns = min(6, max(1, round(floors * aspect * rng.uniform(0.7, 1.1))))
    glass = pick(rng, [colour(0.57, 0.4, 0.75), palette.dark, colour(0.13, 0.5, 0.95)])
    half = (0.28 * aspect / columns, 0.26 / floors)
    for row, column in np.ndindex(floors, columns):
        x, y = aspect * ((column + 0.5) / columns - 0.5), (row + 0.45) / floors - 0.5
        panel(page, x, y, (1.2 * half[0], 1.15 * half[1]), palette.light)
        panel(page, x, y, half, glass)
        panel(page, x, y, (0.08 * half[0], half[1]), palette.light, 0)
    if door:
        wide, tall = 0.12 * min(aspect, 1.2), rng.uniform(0.36, 0.5) / min(floors, 2)
        panel(page, 0, 0.5 - tall / 2, (1.25 * wide, 0.56 * tall), palette.light)
        panel(page, 0, 0.5 - tall / 2, (wide, 0.5 * tall), palette.accent)
        disc(page, 0.6 * wide, 0.5 - 0.45 * tall, (0.015, 0.015), palette.dark)
    return printed(page)


def pips(number: int, ground: Colour, ink: Colour) -> Paint:
    """One side of a die."""
    page = sheet(ground, 1.0)
    far = 0.26
    spots = [(0.0, 0.0)] if number % 2 else []
    spots += [(-far, -far), (far, far)] if number > 1 else []
    spots += [(-far, far), (far, -far)] if number > 3 else []
    spots += [(-far, 0.0), (far, 0.0)] if number == 6 else []
    for x, y in spots:
        disc(page, x, y, (0.1, 0.1), ink)
    return printed(page)


def screen(rng: np.random.Generator, palette: Palette, aspect: Number) -> Paint:
    """A lit display in a dark frame with a few tiles or a picture."""
    page = sheet(palette.dark, aspect)
    panel(page, 0, 0, (0.46 * aspect, 0.45), palette.main, 0.03)
    for x, y in np.ndindex(3, 3):
        if chance(rng, 0.8):
            ink = pick(rng, [palette.second, palette.accent, palette.light])
            panel(page, 0.28 * aspect * (x - 1), 0.27 * (y - 1), (0.11 * aspect, 0.1), ink, 0.02)
    return printed(page)
