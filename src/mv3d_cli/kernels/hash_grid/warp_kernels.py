"""Warp source of the hash grid: features interpolated in the cells of every level, and the two gradients of that.

A launch over (levels, blocks of points) is walked level by level on a CPU, so that one level's table stays in the
cache. A thread takes a block of points, since it unpacks its arguments anew each time. An entry of a table is a vector
of 1, 2 or 4 features; corners of a cell are numbered with x fastest.
"""

from __future__ import annotations

from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False})

vec1 = wp.types.vector(length=1, dtype=wp.float32)
vec8u = wp.types.vector(length=8, dtype=wp.uint32)

PRIME_Y = wp.constant(wp.uint32(2654435761))
PRIME_Z = wp.constant(wp.uint32(805459861))


@wp.struct
class Level:
    """One grid: cells along an axis, its first entry, and the mask of its hash (0: dense)."""

    resolution: wp.int32
    first: wp.uint32
    mask: wp.uint32


@wp.struct
class Cell:
    """Where a point falls: the entries of its cell's corners, and its place between them in [0, 1]^3."""

    corners: vec8u
    share: wp.vec3


@wp.func
def entry(cell: Cell, corner: int) -> int:
    """Index of a corner's entry; seen to be positive, so that the compiler drops Warp's wrap of negative indices."""
    return int(cell.corners[corner] & wp.uint32(0x7FFFFFFF))


@wp.func
def dense_corners(level: Level, x: wp.uint32, y: wp.uint32, z: wp.uint32) -> vec8u:
    one = wp.uint32(1)
    row = wp.uint32(level.resolution) + one
    low = level.first + x + row * (y + row * z)
    high = low + row * row
    return vec8u(low, low + one, low + row, low + row + one, high, high + one, high + row, high + row + one)


@wp.func
def hashed_corners(level: Level, x: wp.uint32, y: wp.uint32, z: wp.uint32) -> vec8u:
    """The spatial hash of Müller et al. 2022, eq. 4."""
    right = x + wp.uint32(1)
    front = y * PRIME_Y
    back = front + PRIME_Y
    low = z * PRIME_Z
    high = low + PRIME_Z
    return vec8u(
        level.first + ((x ^ front ^ low) & level.mask),
        level.first + ((right ^ front ^ low) & level.mask),
        level.first + ((x ^ back ^ low) & level.mask),
        level.first + ((right ^ back ^ low) & level.mask),
        level.first + ((x ^ front ^ high) & level.mask),
        level.first + ((right ^ front ^ high) & level.mask),
        level.first + ((x ^ back ^ high) & level.mask),
        level.first + ((right ^ back ^ high) & level.mask),
    )


@wp.func
def cell_at(level: Level, point: wp.vec3) -> Cell:
    """The cell that holds a point, which is clamped to the grid; the grid's far faces belong to its last cells."""
    cells = float(level.resolution)
    px = wp.clamp(point[0], 0.0, 1.0) * cells
    py = wp.clamp(point[1], 0.0, 1.0) * cells
    pz = wp.clamp(point[2], 0.0, 1.0) * cells
    last = level.resolution - 1
    x = wp.clamp(int(px), 0, last)
    y = wp.clamp(int(py), 0, last)
    z = wp.clamp(int(pz), 0, last)
    cell = Cell()
    if level.mask == wp.uint32(0):
        cell.corners = dense_corners(level, wp.uint32(x), wp.uint32(y), wp.uint32(z))
    else:
        cell.corners = hashed_corners(level, wp.uint32(x), wp.uint32(y), wp.uint32(z))
    cell.share = wp.vec3(px - float(x), py - float(y), pz - float(z))
    return cell


@wp.func
def between(low: Any, high: Any, share: float):
    return low + (high - low) * share


@wp.kernel
def encode(
    levels: wp.array(dtype=Level),
    first_level: int,
    span: wp.vec2i,
    block: int,
    points: wp.array(dtype=wp.vec3),
    tables: wp.array(dtype=Any),
    features: wp.array2d(dtype=Any),
):
    """Features (points, levels) of the points `span`, trilinear."""
    nth, part = wp.tid()
    index = first_level + nth
    level = levels[index]
    start = span[0] + part * block
    for i in range(start, wp.min(start + block, span[1])):
        cell = cell_at(level, points[i])
        x, y, z = cell.share[0], cell.share[1], cell.share[2]
        low_front = between(tables[entry(cell, 0)], tables[entry(cell, 1)], x)
        low_back = between(tables[entry(cell, 2)], tables[entry(cell, 3)], x)
        high_front = between(tables[entry(cell, 4)], tables[entry(cell, 5)], x)
        high_back = between(tables[entry(cell, 6)], tables[entry(cell, 7)], x)
        features[i, index] = between(between(low_front, low_back, y), between(high_front, high_back, y), z)


@wp.kernel
def add_table_gradient(
    levels: wp.array(dtype=Level),
    first_level: int,
    span: wp.vec2i,
    block: int,
    points: wp.array(dtype=wp.vec3),
    gradient: wp.array2d(dtype=Any),
    table_gradient: wp.array(dtype=Any),
):
    """The points `span` add their shares of the gradient (points, levels) to the corners of their cells."""
    nth, part = wp.tid()
    index = first_level + nth
    level = levels[index]
    start = span[0] + part * block
    for i in range(start, wp.min(start + block, span[1])):
        cell = cell_at(level, points[i])
        x, y, z = cell.share[0], cell.share[1], cell.share[2]
        high = gradient[i, index] * z
        low = gradient[i, index] - high
        low_back = low * y
        low_front = low - low_back
        high_back = high * y
        high_front = high - high_back
        wp.atomic_add(table_gradient, entry(cell, 0), low_front * (1.0 - x))
        wp.atomic_add(table_gradient, entry(cell, 1), low_front * x)
        wp.atomic_add(table_gradient, entry(cell, 2), low_back * (1.0 - x))
        wp.atomic_add(table_gradient, entry(cell, 3), low_back * x)
        wp.atomic_add(table_gradient, entry(cell, 4), high_front * (1.0 - x))
        wp.atomic_add(table_gradient, entry(cell, 5), high_front * x)
        wp.atomic_add(table_gradient, entry(cell, 6), high_back * (1.0 - x))
        wp.atomic_add(table_gradient, entry(cell, 7), high_back * x)


@wp.func
def slope(coordinate: float, cells: int) -> float:
    """Cells per unit along an axis; 0 where the point is clamped."""
    return wp.where(coordinate >= 0.0 and coordinate <= 1.0, float(cells), 0.0)


@wp.kernel
def add_point_gradient(
    levels: wp.array(dtype=Level),
    first_level: int,
    span: wp.vec2i,
    block: int,
    points: wp.array(dtype=wp.vec3),
    gradient: wp.array2d(dtype=Any),
    tables: wp.array(dtype=Any),
    point_gradient: wp.array(dtype=wp.vec3),
):
    """Every level adds its gradient to the points `span`: the derivatives of the trilinear form, along each axis."""
    nth, part = wp.tid()
    index = first_level + nth
    level = levels[index]
    start = span[0] + part * block
    for i in range(start, wp.min(start + block, span[1])):
        point = points[i]
        cell = cell_at(level, point)
        x, y, z = cell.share[0], cell.share[1], cell.share[2]
        g = gradient[i, index]
        a, b = wp.dot(g, tables[entry(cell, 0)]), wp.dot(g, tables[entry(cell, 1)])
        c, d = wp.dot(g, tables[entry(cell, 2)]), wp.dot(g, tables[entry(cell, 3)])
        e, f = wp.dot(g, tables[entry(cell, 4)]), wp.dot(g, tables[entry(cell, 5)])
        p, q = wp.dot(g, tables[entry(cell, 6)]), wp.dot(g, tables[entry(cell, 7)])
        along_x = between(between(b - a, d - c, y), between(f - e, q - p, y), z)
        along_y = between(between(c - a, d - b, x), between(p - e, q - f, x), z)
        along_z = between(between(e - a, f - b, x), between(p - c, q - d, x), y)
        n = level.resolution
        step = wp.vec3(slope(point[0], n) * along_x, slope(point[1], n) * along_y, slope(point[2], n) * along_z)
        wp.atomic_add(point_gradient, i, step)


ENTRY = {1: vec1, 2: wp.vec2, 4: wp.vec4}

for vector in ENTRY.values():
    table, per_level = wp.array(dtype=vector), wp.array2d(dtype=vector)
    wp.overload(encode, {"tables": table, "features": per_level})
    wp.overload(add_table_gradient, {"gradient": per_level, "table_gradient": table})
    wp.overload(add_point_gradient, {"tables": table, "gradient": per_level})
