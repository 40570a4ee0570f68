"""Solids with flat sides: boxes and extruded outlines.

An outline lies in the (x, z) plane, counter-clockwise as the viewer in front of the object (at -Y) sees it.
Its extrusion is centred on y = 0 and shows the outline upright to that viewer.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from jaxtyping import Float, Int

from mv3d_cli.capture.shapes.draws import Number
from mv3d_cli.capture.shapes.surfaces import SHARP, Part, Vector, grid

Outline = TypeVar("Outline", bound=np.ndarray)

# right, up and outward axes of the faces of a box, as someone who looks at that face sees them
BOX_SIDES = (
    ((1, 0, 0), (0, 0, 1), (0, -1, 0)),  # front
    ((0, 1, 0), (0, 0, 1), (1, 0, 0)),  # right
    ((-1, 0, 0), (0, 0, 1), (0, 1, 0)),  # back
    ((0, -1, 0), (0, 0, 1), (-1, 0, 0)),  # left
    ((1, 0, 0), (0, 1, 0), (0, 0, 1)),  # top
    ((1, 0, 0), (0, -1, 0), (0, 0, -1)),  # bottom
)


CELL = 0.4
"""The longest uncut stretch on the side of a box."""


def box(size: Vector, bevel: Number = 0.0) -> Part:
    """A box with rounded edges, centred on the origin.

    Slots: front, right, back, left, top, bottom, each with uv from 0 to 1 as its viewer reads it.
    Long sides are cut, so that deformations have something to bend.
    """
    half = np.asarray(size, float) / 2
    radius = float(min(bevel, 0.98 * half.min()))
    sides = [_box_side(np.array(axes, float), half, radius) for axes in BOX_SIDES]
    vertices = np.concatenate([side[0] for side in sides])
    offsets = np.cumsum([0] + [len(side[0]) for side in sides])[:-1]
    faces = np.concatenate([side[2] + offset for side, offset in zip(sides, offsets, strict=True)])
    smooth = np.arange(len(vertices))
    if radius > 0:  # the sides meet in a round edge: one normal for what lies together
        keys = np.round((vertices + half) * 1e5).astype(np.int64) @ np.array([1, 1 << 21, 1 << 42])
        smooth = np.unique(keys, return_inverse=True)[1].reshape(-1)
    slots = np.repeat(np.arange(6), [len(side[2]) for side in sides])
    return Part(vertices, faces, np.concatenate([side[1] for side in sides]), smooth, slots)


def _box_side(
    axes: Float[np.ndarray, "3 3"], half: Float[np.ndarray, "3"], radius: float
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 2"], Int[np.ndarray, "m 3"]]:
    """Vertices, uvs and faces of one side: a patch of the full box, pulled in to the rounded one."""
    reach = np.abs(axes) @ half
    s, t = (_box_lines(reach[k], radius) for k in range(2))
    flat = s[None, :, None] * axes[0] + t[:, None, None] * axes[1] + reach[2] * axes[2]
    core = np.clip(flat, radius - half, half - radius)
    away = flat - core
    length = np.linalg.norm(away, axis=2, keepdims=True)
    vertices = core + radius * away / np.maximum(length, 1e-12) if radius > 0 else flat
    uv = np.stack(np.broadcast_arrays(s[None, :] / (2 * reach[0]) + 0.5, 0.5 - t[:, None] / (2 * reach[1])), axis=2)
    width = len(s)
    corner = (np.arange(len(t) - 1)[:, None] * width + np.arange(width - 1)[None, :]).ravel()
    quads = [(corner, corner + 1, corner + width + 1), (corner, corner + width + 1, corner + width)]
    return (
        vertices.reshape(-1, 3),
        uv.reshape(-1, 2),
        np.concatenate([np.stack(quad, axis=1) for quad in quads]),
    )


def _box_lines(reach: float, radius: float) -> Float[np.ndarray, "lines"]:
    """Where a side is cut: evenly in the middle, and every 22.5 degrees of the round edge."""
    cells = max(1, int(np.ceil(2 * (reach - radius) / CELL)))
    inner = np.linspace(radius - reach, reach - radius, cells + 1)
    if radius == 0:
        return inner
    edge = reach - radius + radius * np.tan(np.radians([22.5, 45]))
    return np.concatenate([-edge[::-1], inner, edge])


def extrusion(outline: Float[np.ndarray, "corners 2"], depth: Number, bevel: Number = 0.0, cells: int = 2) -> Part:
    """An outline made solid. Slots: 0 the front, 1 the rim with the bevel, 2 the back, upright too."""
    b = min(bevel, 0.45 * depth)
    inner = _inset(outline, b)
    ys = np.linspace(depth / 2 - b, b - depth / 2, cells + 1)
    layers = [(outline, y) for y in ys]
    if b > 0:
        layers = [(inner, depth / 2), *layers, (inner, -depth / 2)]
    points = np.stack([np.stack([ring[:, 0], np.full(len(ring), y), ring[:, 1]], axis=1) for ring, y in layers])
    step = np.roll(outline, -1, axis=0) - outline
    step /= np.linalg.norm(step, axis=1, keepdims=True)
    sharp_columns = (step * np.roll(step, 1, axis=0)).sum(axis=1) < SHARP
    sharp_rows = np.zeros(len(points), bool)
    sharp_rows[[1, -2]] = b > 0
    rim = grid(points, sharp_rows, sharp_columns)
    return _capped(rim, points[-1], points[0])


def _capped(rim: Part, front: Float[np.ndarray, "corners 3"], back: Float[np.ndarray, "corners 3"]) -> Part:
    """The rim closed by two flat caps with a texture each."""
    corners, base = len(front), len(rim.vertices)
    triangles = triangulated(front[:, [0, 2]])
    low, high = front[:, [0, 2]].min(axis=0), front[:, [0, 2]].max(axis=0)
    uv = (front[:, [0, 2]] - low) / (high - low)
    uvs = [
        rim.uvs,
        np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1),
        np.stack([1 - uv[:, 0], 1 - uv[:, 1]], axis=1),
    ]
    smooth = np.repeat(rim.smooth.max() + 1 + np.arange(2), corners)
    faces = [rim.faces, base + triangles, base + corners + triangles[:, ::-1]]
    slots = np.repeat([1, 0, 2], [len(rim.faces), len(triangles), len(triangles)])
    return Part(
        np.concatenate([rim.vertices, front, back]),
        np.concatenate(faces),
        np.concatenate(uvs),
        np.concatenate([rim.smooth, smooth]),
        slots,
    )


def _inset(outline: np.ndarray, distance: float) -> np.ndarray:
    """The outline with every edge moved inwards (mitred, held back at acute corners)."""
    step = np.roll(outline, -1, axis=0) - outline
    normal = np.stack([step[:, 1], -step[:, 0]], axis=1) / np.linalg.norm(step, axis=1, keepdims=True)
    before = np.roll(normal, 1, axis=0)
    spread = np.maximum(1 + (normal * before).sum(axis=1, keepdims=True), 0.5)
    return outline - distance * (normal + before) / spread


def triangulated(outline: Float[np.ndarray, "corners 2"]) -> Int[np.ndarray, "corners-2 3"]:
    """Triangles of a simple counter-clockwise outline, by cutting ears (a convex one is a fan)."""
    left = list(range(len(outline)))
    triangles: list[tuple[int, int, int]] = []
    while len(left) > 3:
        ear = _find_ear(outline[left])
        triangles.append((left[ear - 1], left[ear], left[(ear + 1) % len(left)]))
        left.pop(ear)
    return np.array([*triangles, tuple(left)])


def _find_ear(polygon: Float[np.ndarray, "corners 2"]) -> int:
    """The convex corner with the widest angle whose triangle holds no other corner."""
    before, after = np.roll(polygon, 1, axis=0), np.roll(polygon, -1, axis=0)
    turn = _cross(polygon - before, after - polygon)
    area = turn / np.maximum(((after - before) ** 2).sum(axis=1), 1e-12)
    for corner in np.argsort(np.where(turn > 1e-12, area, np.inf), kind="stable"):
        a, b, c = before[corner], polygon[corner], after[corner]
        inside = np.minimum.reduce([_cross(q - p, polygon - p) for p, q in ((a, b), (b, c), (c, a))]) > -1e-12
        inside[[corner - 1, corner, (corner + 1) % len(polygon)]] = False
        if not inside.any():
            return int(corner)
    return int(np.argmax(turn))


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def polygon(corners: int, inner: Number = 1.0, phase: Number = 0.0) -> Float[np.ndarray, "n 2"]:
    """A regular polygon of radius 1, or with `inner` < 1 a star of that many points; the first is on top."""
    total = corners if inner == 1 else 2 * corners
    angle = np.pi / 2 + phase + 2 * np.pi * np.arange(total) / total
    radius = np.where((np.arange(total) % 2 == 1) & (inner != 1), inner, 1.0)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def gear(teeth: int, depth: Number) -> Float[np.ndarray, "n 2"]:
    """A gear wheel of radius 1 with teeth of that depth."""
    offsets = np.array([-0.32, -0.17, 0.17, 0.32])
    angle = ((np.arange(teeth)[:, None] + offsets) * 2 * np.pi / teeth).ravel()
    radius = np.tile([1 - depth, 1, 1, 1 - depth], teeth)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def rounded_rectangle(width: Number, height: Number, radius: Number, steps: int = 5) -> Float[np.ndarray, "n 2"]:
    """A rectangle with round corners, centred on the origin."""
    r = min(radius, 0.49 * width, 0.49 * height)
    angle = np.linspace(0, np.pi / 2, steps)
    quarter = r * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    corner = np.array([width / 2 - r, height / 2 - r])
    turns = [np.array([[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]]) for a in np.pi / 2 * np.arange(4)]
    signs = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    return np.round(np.concatenate([quarter @ turns[k] + signs[k] * corner for k in range(4)]), 9)


def heart() -> Float[np.ndarray, "n 2"]:
    """A heart about 2 units tall."""
    t = np.linspace(0, 2 * np.pi, 36, endpoint=False) + 0.05
    x = np.sin(t) ** 3
    z = (13 * np.cos(t) - 5 * np.cos(2 * t) - 2 * np.cos(3 * t) - np.cos(4 * t)) / 16
    return np.stack([x, z], axis=1)[::-1]


def blocky(rows: tuple[str, ...]) -> Float[np.ndarray, "n 2"]:
    """The outline of a connected picture of `#` cells without holes: letters, arrows, steps. 2 units tall."""
    cells = {(x, -z) for z, row in enumerate(rows) for x, mark in enumerate(row) if mark == "#"}
    follows = {}
    for x, z in cells:
        sides = {(0, -1): ((x, z), (x + 1, z)), (1, 0): ((x + 1, z), (x + 1, z + 1))}
        sides |= {(0, 1): ((x + 1, z + 1), (x, z + 1)), (-1, 0): ((x, z + 1), (x, z))}
        follows |= {start: end for (dx, dz), (start, end) in sides.items() if (x + dx, z + dz) not in cells}
    path = [min(follows)]
    while follows[path[-1]] != path[0]:
        path.append(follows[path[-1]])
    corners = np.array(path, float)
    straight = _cross(corners - np.roll(corners, 1, axis=0), np.roll(corners, -1, axis=0) - corners) == 0
    corners = corners[~straight]
    centre = (corners.min(axis=0) + corners.max(axis=0)) / 2
    return (corners - centre) * 2 / len(rows)
