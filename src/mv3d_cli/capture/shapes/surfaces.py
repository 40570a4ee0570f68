"""Closed surfaces laid out on a grid: lathes, superquadrics, swept tubes. Axes as in `scene.conventions`.

A grid's columns run counter-clockwise round its axis seen from the tip, its rows run up the axis, so that
faces look outwards. Columns start at the back (+Y), the front (-Y) lies at u = 0.5; v runs down, both by arc
length.
Lengths are arbitrary: an object is some 2 units tall.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from mv3d_cli.capture.shapes.draws import Number
from mv3d_cli.scene.mesh import Material

Vector = tuple[Number, Number, Number]

SHARP = np.cos(np.radians(38))
"""Cosine of the turn above which an edge is shaded as a corner."""


@dataclass(frozen=True)
class Part:
    """A closed surface in the making.

    smooth     vertices with the same number share a shading normal
    slots      which of the part's surfaces (wall, cap, front ...) a face belongs to
    materials  one per slot; empty until painted
    """

    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    uvs: Float[np.ndarray, "vertices 2"]
    smooth: Int[np.ndarray, "vertices"]
    slots: Int[np.ndarray, "faces"]
    materials: tuple[Material, ...] = ()


def spline(points: Float[np.ndarray, "points axes"], count: int, loop: bool = False) -> Float[np.ndarray, "count axes"]:
    """`count` points of the uniform Catmull-Rom curve through `points`, ends included (or a closed loop)."""
    if loop:
        padded = np.concatenate([points[-1:], points, points[:2]])
    else:
        padded = np.concatenate([2 * points[:1] - points[1:2], points, 2 * points[-1:] - points[-2:-1]])
    spans = len(padded) - 3
    t = np.linspace(0, spans, count, endpoint=not loop)
    k = np.minimum(t.astype(int), spans - 1)
    t = (t - k)[:, None]
    a, b, c, d = (padded[k + i] for i in range(4))
    return 0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * (b - c) + d - a) * t**3)


def grid(
    points: Float[np.ndarray, "rows columns 3"],
    sharp_rows: Bool[np.ndarray, "rows"] | None = None,
    sharp_columns: Bool[np.ndarray, "columns"] | None = None,
    ring: bool = False,
) -> Part:
    """A part from points whose columns wrap; rows end in a pole (equal points) or, with `ring`, wrap too.

    Sharp rows and columns are laid twice, so that the shading breaks there.
    """
    rows, columns = points.shape[:2]
    row_of = np.repeat(np.arange(rows), 1 if sharp_rows is None else 1 + sharp_rows)
    row_of = np.append(row_of, 0) if ring else row_of
    twice = np.zeros(columns, int) if sharp_columns is None else sharp_columns.astype(int)
    column_of = np.append(np.repeat(np.arange(columns), 1 + twice)[twice[0] :], 0)
    laid = points[row_of][:, column_of]
    smooth_row, smooth_column = np.arange(len(row_of)), np.arange(len(column_of))
    smooth_row[-1] *= not ring
    smooth_column[-1] *= bool(twice[0])
    smooth = smooth_row[:, None] * len(column_of) + smooth_column
    pole = np.ptp(points, axis=1).max(axis=1)[row_of] < 1e-9
    if not twice.any():
        smooth[pole] = smooth[pole, :1]
    u = _travelled(np.linalg.norm(np.diff(laid, axis=1), axis=2).mean(axis=0))
    v = 1 - _travelled(np.linalg.norm(np.diff(laid, axis=0), axis=2).mean(axis=1))
    uvs = np.stack(np.broadcast_arrays(u[None, :], v[:, None]), axis=2).reshape(-1, 2)
    faces = _grid_faces(np.diff(row_of) != 0, np.diff(column_of) != 0, pole)
    return Part(laid.reshape(-1, 3), faces, uvs, smooth.ravel(), np.zeros(len(faces), int))


def _travelled(steps: Float[np.ndarray, "steps"]) -> Float[np.ndarray, "steps+1"]:
    """The fraction of the way covered before each stop."""
    way = np.concatenate([[0.0], np.cumsum(steps)])
    return way / max(way[-1], 1e-12)


def _grid_faces(
    row_steps: Bool[np.ndarray, "bands"],
    column_steps: Bool[np.ndarray, "sectors"],
    pole: Bool[np.ndarray, "rows"],
) -> Int[np.ndarray, "faces 3"]:
    """Two triangles per cell, one next to a pole, none between the two copies of a sharp row or column."""
    width = len(column_steps) + 1
    band, sector = np.flatnonzero(row_steps)[:, None], np.flatnonzero(column_steps)[None, :]
    corner = band * width + sector
    lower = np.stack([corner, corner + 1, corner + width + 1], axis=2)[~pole[band[:, 0]]]
    upper = np.stack([corner, corner + width + 1, corner + width], axis=2)[~pole[band[:, 0] + 1]]
    return np.concatenate([lower.reshape(-1, 3), upper.reshape(-1, 3)])


def lathe(
    profile: Float[np.ndarray, "rows 2"],
    slots: Int[np.ndarray, "rows-1"] | None = None,
    section: Float[np.ndarray, "columns"] | None = None,
    columns: int = 40,
) -> Part:
    """The solid that a profile of (radius, z) sweeps round +Z, from the axis below to the axis above.

    `section` multiplies the radius round the axis (a square bottle, a fluted vase). Each run of equal `slots`
    has a texture of its own: wrapped round by arc length, or seen from above where the run is a flat disc.
    """
    slots = np.zeros(len(profile) - 1, int) if slots is None else slots
    section = np.ones(columns) if section is None else section
    around = 2 * np.pi * np.arange(len(section)) / len(section)
    ring = np.stack([-np.sin(around), np.cos(around)], axis=1) * section[:, None]
    points = np.empty((len(profile), len(section), 3))
    points[..., :2] = profile[:, :1, None] * ring
    points[..., 2] = profile[:, 1:]
    step = np.diff(profile, axis=0)
    step /= np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-12)
    sharp = np.zeros(len(profile), bool)
    sharp[1:-1] = ((step[1:] * step[:-1]).sum(axis=1) < SHARP) | (slots[1:] != slots[:-1])
    return _with_runs(grid(points, sharp), profile, slots, sharp)


def _with_runs(part: Part, profile: np.ndarray, slots: np.ndarray, sharp: np.ndarray) -> Part:
    """The lathed part with a slot per band and, for each run of bands of one slot, a texture of its own."""
    first = np.arange(len(profile)) + np.concatenate([[0], np.cumsum(sharp)[:-1]])  # laid row of each profile row
    last = first + sharp
    width = len(part.vertices) // (last[-1] + 1)
    uvs = part.uvs.reshape(-1, width, 2).copy()
    places = part.vertices.reshape(-1, width, 3)
    starts = np.flatnonzero(np.diff(slots, prepend=slots[0] - 1))
    for start, stop in zip(starts, np.append(starts[1:], len(slots)), strict=True):
        rows = slice(last[start], first[stop] + 1)
        way = profile[stop] - profile[start]
        if abs(way[1]) < 0.2 * abs(way[0]):
            reach = 2 * profile[start : stop + 1, 0].max()
            uvs[rows] = 0.5 + places[rows, :, :2] / reach * [-np.sign(way[0]), -1]
        else:
            v = uvs[rows, :1, 1]
            uvs[rows, :, 1] = (v - v[-1]) / max(float((v[0] - v[-1]).item()), 1e-12)
    slot_of_row = np.zeros(last[-1] + 1, int)
    slot_of_row[last[:-1]] = slots
    return replace(part, uvs=uvs.reshape(-1, 2), slots=slot_of_row[part.faces.min(axis=1) // width])


def superquadric(
    vertical: Number = 1.0,
    horizontal: Number = 1.0,
    half: Vector = (1, 1, 1),
    rows: int = 20,
    columns: int = 32,
) -> Part:
    """Barr's superellipsoid of half-axes `half`; exponents 1: ellipsoid, near 0: box, 2: octahedron."""
    rise = np.linspace(-np.pi / 2, np.pi / 2, rows + 1)[:, None]
    around = 2 * np.pi * np.arange(columns)[None, :] / columns
    radius, height = _signed_power(np.cos(rise), vertical), _signed_power(np.sin(rise), vertical)
    x = radius * -_signed_power(np.sin(around), horizontal)
    y = radius * _signed_power(np.cos(around), horizontal)
    points = np.stack(np.broadcast_arrays(x * half[0], y * half[1], height * half[2]), axis=2)
    points[[0, -1], :, :2] = 0
    return grid(points)


def _signed_power(value: np.ndarray, exponent: Number) -> np.ndarray:
    return np.sign(value) * np.abs(value) ** exponent


def ball(half: Vector | Number = 1.0, rows: int = 16) -> Part:
    """An ellipsoid of half-axes `half`."""
    axes = half if isinstance(half, tuple) else (half, half, half)
    return superquadric(1, 1, axes, rows, int(1.6 * rows))


def cylinder(bottom: Number, top: Number, height: Number, bevel: Number = 0.0, columns: int = 28) -> Part:
    """A cylinder or cone frustum from z = 0 up. Slots: 0 the wall, 1 the caps."""
    b = min(bevel, 0.45 * height, 0.8 * min(bottom, top))
    wall = [(bottom, b), (top, height - b)] if b else [(bottom, 0), (top, height)]
    foot, head = ([(bottom - b, 0)], [(top - b, height)]) if b else ([], [])
    profile = np.array([(0, 0), *foot, *wall, *head, (0, height)], dtype=float)
    slots = np.array([1, *([0] * (len(profile) - 3)), 1])
    if top == 0:
        profile, slots = profile[:-1], slots[:-1]
    return lathe(_subdivided(profile), np.repeat(slots, 3), columns=columns)


def _subdivided(profile: np.ndarray) -> np.ndarray:
    """Each step of the profile in three, so that deformations have something to bend."""
    fine = np.arange(3 * len(profile) - 2) / 3
    knots = np.arange(len(profile))
    return np.stack([np.interp(fine, knots, profile[:, 0]), np.interp(fine, knots, profile[:, 1])], axis=1)


def vessel(
    profile: Float[np.ndarray, "rows 2"],
    wall: Number,
    section: Float[np.ndarray, "columns"] | None = None,
    columns: int = 40,
) -> Part:
    """A hollow vessel; `profile` is its outside, foot to rim. Slots: 0 outside, 1 inside and base."""
    floor = profile[0, 1] + wall
    inside = np.stack([np.maximum(profile[:, 0] - wall, 0.4 * profile[:, 0]), profile[:, 1]], axis=1)[::-1]
    inside = inside[inside[:, 1] > floor + 0.5 * wall]
    inside = np.concatenate([inside, [[inside[-1, 0], floor]]])
    base, bottom = [[0, profile[0, 1]]], [[0, floor]]
    rows = np.concatenate([base, profile, inside, bottom])
    slots = np.ones(len(rows) - 1, int)
    slots[1 : len(profile)] = 0
    return lathe(rows, slots, section, columns)


def tube(
    path: Float[np.ndarray, "rows 3"],
    radius: Float[np.ndarray, "rows"] | Number,
    flat: bool = False,
    columns: int = 14,
) -> Part:
    """A round tube along a path, with rounded (or flat) ends; `radius` may change along it."""
    radii = np.maximum(np.broadcast_to(np.asarray(radius, float), len(path)), 2e-3)
    frames = _transported_frames(_tangents(path, ring=False))
    angle = np.array([0.0]) if flat else np.linspace(0, np.pi / 2, 4, endpoint=False)
    out = np.sin(angle)
    ends = [
        -radii[0] * np.append(1 - flat, out[:0:-1]),
        np.zeros(len(path)),
        radii[-1] * np.append(out[1:], 1 - flat),
    ]
    shrink = [np.append(0, np.cos(angle[:0:-1])), np.ones(len(path)), np.append(np.cos(angle[1:]), 0)]
    extra = [len(end) for end in (ends[0], ends[2])]
    index = np.concatenate([np.zeros(extra[0], int), np.arange(len(path)), np.full(extra[1], len(path) - 1)])
    centres = path[index] + np.concatenate(ends)[:, None] * frames[index, 2]
    sharp = np.zeros(len(index), bool)
    sharp[[1, -2]] = flat
    return grid(_rings(centres, radii[index] * np.concatenate(shrink), frames[index], columns), sharp)


def loop(path: Float[np.ndarray, "rows 3"], radius: Number, columns: int = 16) -> Part:
    """A round tube along a closed path (its end is not repeated): a torus from a circle, or a knot."""
    frames = _transported_frames(_tangents(path, ring=True), ring=True)
    return grid(_rings(path, np.full(len(path), float(radius)), frames, columns), ring=True)


def torus(major: Number, minor: Number, rows: int = 40, columns: int = 16) -> Part:
    """A torus round +Z through the origin."""
    around = 2 * np.pi * np.arange(rows) / rows
    circle = major * np.stack([-np.sin(around), np.cos(around), 0 * around], axis=1)
    return loop(circle, minor, columns)


def _tangents(path: np.ndarray, ring: bool) -> np.ndarray:
    change = np.roll(path, -1, axis=0) - np.roll(path, 1, axis=0) if ring else np.gradient(path, axis=0)
    return change / np.linalg.norm(change, axis=1, keepdims=True)


def _transported_frames(tangents: np.ndarray, ring: bool = False) -> Float[np.ndarray, "rows 3 3"]:
    """Frames (side, up, tangent) that turn as little as possible; a ring spreads the leftover turn evenly."""
    side = np.cross(tangents[0], np.eye(3)[np.abs(tangents[0]).argmin()])
    sides = np.empty_like(tangents)
    for row, tangent in enumerate(tangents):
        side = side - tangent * (side @ tangent)
        side = side / np.linalg.norm(side)
        sides[row] = side
    ups = np.cross(tangents, sides)
    if ring:
        end = sides[-1] - tangents[0] * (sides[-1] @ tangents[0])
        turn = -np.arctan2(end @ ups[0], end @ sides[0]) * np.arange(len(sides)) / len(sides)
        cos, sin = np.cos(turn)[:, None], np.sin(turn)[:, None]
        sides, ups = cos * sides + sin * ups, cos * ups - sin * sides
    return np.stack([sides, ups, tangents], axis=1)


def _rings(centres: np.ndarray, radii: np.ndarray, frames: np.ndarray, columns: int) -> np.ndarray:
    around = 2 * np.pi * np.arange(columns) / columns
    wheel = np.stack([np.cos(around), np.sin(around)], axis=1)
    return centres[:, None] + radii[:, None, None] * np.einsum("ck,rkx->rcx", wheel, frames[:, :2])
