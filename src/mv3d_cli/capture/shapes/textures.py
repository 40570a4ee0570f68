"""Palettes and procedural patterns, which tile without a seam in u and v. Colours are sRGB in [0, 1].

A pattern is a scalar field in [0, 1] over the texture, read through a ramp of colours.
"""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from mv3d_cli.capture.shapes.draws import SIZE, Field, Number, chance, count, fractal, noise, pick
from mv3d_cli.scene.mesh import Material, Texture

Colour = Float[np.ndarray, "3"]
Picture = UInt8[np.ndarray, "size size 4"]


class Palette(NamedTuple):
    """Colours that go together."""

    main: np.ndarray
    second: np.ndarray
    accent: np.ndarray
    light: np.ndarray
    dark: np.ndarray


@dataclass(frozen=True)
class Paint:
    """A material, and how long one tile of its texture is on the surface (None: spread once over it)."""

    material: Material
    tile: Number | None = None


def colour(hue: Number, saturation: Number, value: Number) -> Colour:
    """An sRGB colour from hue (any real), saturation and value in [0, 1]."""
    return np.array(colorsys.hsv_to_rgb(hue % 1, min(max(saturation, 0), 1), min(max(value, 0), 1)), float)


def draw_palette(rng: np.random.Generator) -> Palette:
    """A random harmony: one hue, neighbours, opposites or triads; vivid, muted or grey."""
    hue = rng.random()
    offsets = pick(rng, [(0, 0.06, 0.5), (0, 0.33, 0.67), (0, 0.08, -0.08), (0, 0.5, 0.12), (0, 0.02, 0.45)])
    low, high = pick(rng, [(0.55, 0.95), (0.25, 0.6), (0.0, 0.12)], [0.6, 0.3, 0.1])
    three = [colour(hue + o, rng.uniform(low, high), rng.uniform(0.35, 0.95)) for o in offsets]
    if chance(rng, 0.2):
        three[0] = colour(hue, rng.uniform(0, 0.1), pick(rng, [0.93, 0.75, 0.5, 0.18]))
    if chance(rng, 0.2):
        three[2] = colour(rng.random(), 0.85, 0.9)
    light = colour(hue + rng.uniform(-0.1, 0.1), rng.uniform(0, 0.18), rng.uniform(0.85, 0.98))
    dark = colour(hue + rng.uniform(-0.1, 0.1), rng.uniform(0, 0.5), rng.uniform(0.07, 0.26))
    return Palette(three[0], three[1], three[2], light, dark)


def shade(base: Colour, factor: Number) -> Colour:
    """The colour darker (below 1) or lighter (above 1, towards white)."""
    return base * factor if factor <= 1 else 1 - (1 - base) / factor


def _texels(size: int = SIZE) -> tuple[np.ndarray, np.ndarray]:
    at = (np.arange(size) + 0.5) / size
    return at[None, :], at[:, None]


def _triangle_wave(phase: np.ndarray) -> np.ndarray:
    return np.abs(2 * (phase % 1) - 1)


def _edge(value: np.ndarray, softness: Number = 0.04) -> np.ndarray:
    return np.clip(0.5 + value / softness, 0, 1)


def stripes(rng: np.random.Generator) -> Field:
    """Bands along u, v or a diagonal, of unequal width, sometimes wavy."""
    u, v = _texels()
    number = count(rng, 2, 7)
    along, across = pick(rng, [(number, 0), (0, number), (number, number), (count(rng, 1, 3), number)])
    wave = rng.uniform(0, 0.15) * np.sin(2 * np.pi * count(rng, 1, 3) * (u if across else v)) if chance(rng, 0.4) else 0
    return np.clip((_triangle_wave(along * u + across * v + wave) - rng.uniform(0.3, 0.7)) * 8 + 0.5, 0, 1)


def checker(rng: np.random.Generator) -> Field:
    """Squares, sometimes diamonds."""
    u, v = _texels()
    n = count(rng, 2, 4)
    a, b = (n * (u + v), n * (u - v)) if chance(rng, 0.3) else (n * u, n * v)
    return _edge(np.sin(2 * np.pi * a) * np.sin(2 * np.pi * b), 0.3)


def dots(rng: np.random.Generator) -> Field:
    """Polka dots in staggered rows, or rings."""
    u, v = _texels()
    n = count(rng, 2, 5)
    row = np.floor(2 * n * v)
    x = (n * u + 0.5 * (row % 2)) % 1 - 0.5
    distance = np.hypot(x, ((2 * n * v) % 1 - 0.5) / 2)
    radius = rng.uniform(0.12, 0.22)
    return _edge(radius - (np.abs(distance - radius / 2) + radius / 4 if chance(rng, 0.2) else distance), 0.08)


def plaid(rng: np.random.Generator) -> Field:
    """Crossing bands that darken each other."""
    u, v = _texels()
    n = count(rng, 2, 4)
    bands = [_edge(_triangle_wave(n * t) - rng.uniform(0.35, 0.65), 0.2) for t in (u, v)]
    thin = [_edge(_triangle_wave(n * t + 0.5) - 0.93, 0.1) for t in (u, v)]
    return np.clip(0.4 * (bands[0] + bands[1]) + 0.6 * np.maximum(thin[0], thin[1]), 0, 1)


def zigzag(rng: np.random.Generator) -> Field:
    """Chevrons."""
    u, v = _texels()
    n = count(rng, 2, 5)
    return _edge(_triangle_wave(n * v + rng.uniform(0.3, 0.7) * _triangle_wave(count(rng, 2, 5) * u)) - 0.5, 0.25)


def gradient(rng: np.random.Generator) -> Field:
    """From foot to top and back, a little uneven."""
    v = _texels()[1]
    return np.clip(_triangle_wave(v + 0.03 * noise(rng, 4, 4)), 0, 1)


def wood(rng: np.random.Generator) -> Field:
    """Grain along v with knots."""
    u = _texels()[0]
    rings = count(rng, 3, 6) * u + 0.5 * noise(rng, 3, 2) + 0.04 * noise(rng, 40, 4)
    return np.clip(0.75 * _triangle_wave(rings) ** 1.5 + 0.12 * noise(rng, 90, 6) + 0.15, 0, 1)


def marble(rng: np.random.Generator) -> Field:
    """Veins of warped sine."""
    u, v = _texels()
    vein = np.abs(np.sin(np.pi * (count(rng, 1, 2) * u + count(rng, 1, 2) * v + 2.2 * (fractal(rng, 3, 4) - 0.5))))
    return 1 - np.clip(vein * rng.uniform(1.2, 3), 0, 1) ** 0.6


def bricks(rng: np.random.Generator) -> Field:
    """Staggered bricks in mortar (the ramp's end), each of its own shade."""
    u, v = _texels()
    n = count(rng, 2, 4)
    row = np.floor(2 * n * v).astype(int)
    x = n * u + 0.5 * (row % 2)
    shades = rng.uniform(0, 0.6, (2 * n, n))[row % (2 * n), np.floor(x).astype(int) % n]
    gap = np.minimum(0.5 - np.abs(x % 1 - 0.5), 0.5 * (0.5 - np.abs((2 * n * v) % 1 - 0.5)))
    return np.maximum(shades, _edge(0.045 - gap, 0.03))


def cells(rng: np.random.Generator, size: int = 128) -> Field:
    """Voronoi cells, each of its own shade, or their borders (cobbles, giraffes, scales)."""
    n = count(rng, 3, 7)
    seeds = rng.uniform(0.1, 0.9, (n, n, 2))
    shades = rng.random((n, n))
    u, v = (n * t for t in _texels(size))
    column, row = np.floor(u).astype(int), np.floor(v).astype(int)
    first = np.full((size, size), 9.0)
    second, shade_of = first.copy(), np.zeros((size, size))
    for dy, dx in np.ndindex(3, 3):
        i, j = row + dy - 1, column + dx - 1
        seed = seeds[i % n, j % n]
        distance = (u - j - seed[..., 0]) ** 2 + (v - i - seed[..., 1]) ** 2
        nearer = distance < first
        second = np.where(nearer, first, np.minimum(second, distance))
        shade_of = np.where(nearer, shades[i % n, j % n], shade_of)
        first = np.where(nearer, distance, first)
    if chance(rng, 0.5):
        return _edge(np.sqrt(second) - np.sqrt(first) - rng.uniform(0.1, 0.3), 0.08)
    return shade_of


def camouflage(rng: np.random.Generator) -> Field:
    """Blots of a few flat shades."""
    field = 4 * fractal(rng, count(rng, 2, 4), 3)
    return (np.floor(field) + _edge(field % 1 - 0.5, 0.15)) / 4


def speckle(rng: np.random.Generator) -> Field:
    """Small scattered blots, few or many."""
    hills = count(rng, 14, 30)
    return _edge(noise(rng, hills, hills) - rng.uniform(0.6, 1.6), 0.5)


def cloud(rng: np.random.Generator) -> Field:
    """Soft fractal noise."""
    return fractal(rng, count(rng, 2, 4), 4)


def brushed(rng: np.random.Generator) -> Field:
    """Fine lines along u, as on lathed metal."""
    return np.clip(0.5 + 0.12 * noise(rng, 3, 120) + 0.1 * noise(rng, 6, 40), 0, 1)


def patchwork(rng: np.random.Generator) -> Field:
    """Squares of random shades with seams."""
    n = count(rng, 2, 5)
    at = np.arange(SIZE) * n // SIZE
    shades = rng.random((n, n))[at[:, None], at[None, :]]
    u, v = _texels()
    seam = np.maximum(_triangle_wave(n * u), _triangle_wave(n * v))
    return np.where(seam > 0.96, 1.0, shades)


PATTERNS = (
    *(stripes, checker, dots, plaid, zigzag, gradient, wood, marble, bricks),
    *(cells, camouflage, speckle, cloud, brushed, patchwork),
)


def ramp(field: Field, colours: Sequence[Colour]) -> Picture:
    """The field's picture: colours evenly spread over [0, 1], opaque."""
    stops = np.linspace(0, 1, len(colours))
    table = np.full((256, 4), 255, np.uint8)
    for channel in range(3):
        values = np.interp(np.linspace(0, 1, 256), stops, [c[channel] for c in colours])
        table[:, channel] = np.round(255 * np.clip(values, 0, 1))
    return table[(field * 255).astype(np.uint8)]


def paint_field(field: Field, colours: Sequence[Colour], tile: Number | None = 1.0) -> Paint:
    """A paint from a field in [0, 1] and the colours it runs through."""
    return Paint(Material(texture=Texture(ramp(field, colours))), tile)


def plain(rng: np.random.Generator, base: Colour, mottle: Number = 0.06) -> Paint:
    """One colour, very slightly uneven."""
    field = np.clip(0.5 + 0.2 * noise(rng, 7, 7, 64) + 0.1 * noise(rng, 24, 24, 64), 0, 1)
    return paint_field(field, [shade(base, 1 - mottle), shade(base, 1 + mottle)])


def pattern(rng: np.random.Generator, first: Colour, second: Colour, third: Colour | None = None) -> Picture:
    """A random pattern of two or three colours."""
    colours = [first, second] if third is None or chance(rng, 0.5) else [first, second, third]
    return ramp(pick(rng, PATTERNS)(rng), colours)


def patterned(rng: np.random.Generator, first: Colour, second: Colour, third: Colour | None = None) -> Paint:
    """A paint of such a pattern, at a random scale."""
    picture = pattern(rng, first, second, third)
    return Paint(Material(texture=Texture(picture)), rng.uniform(0.7, 1.6))


def coat(rng: np.random.Generator, palette: Palette, plainness: Number = 0.4) -> Paint:
    """The usual way to paint a part: plain, or patterned in the palette's colours."""
    if chance(rng, plainness):
        return plain(rng, palette.main, 0.04)
    other = pick(rng, [palette.second, palette.accent, palette.light, palette.dark, shade(palette.main, 0.7)])
    return patterned(rng, palette.main, other, palette.second)


def timber(rng: np.random.Generator) -> Paint:
    """Wood of a natural or painted tint."""
    hue, value = rng.uniform(0.05, 0.11), rng.uniform(0.35, 0.85)
    pale = colour(hue, rng.uniform(0.25, 0.65), value)
    return paint_field(wood(rng), [shade(pale, 0.6), pale, shade(pale, 1.2)], rng.uniform(0.8, 1.6))


def metal(rng: np.random.Generator) -> Paint:
    """Brushed steel, brass or copper."""
    base = pick(rng, [colour(0.6, 0.04, 0.75), colour(0.12, 0.45, 0.8), colour(0.05, 0.5, 0.7), colour(0, 0, 0.35)])
    return paint_field(brushed(rng), [shade(base, 0.7), base, shade(base, 1.6)])
