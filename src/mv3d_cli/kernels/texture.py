"""Textures for kernels: all mip levels of all textures in one buffer, and how they are sampled.

A texel is four sRGB bytes with straight alpha in one 32-bit word; filtering happens in linear light, through a table.
Level L of a texture has half the size of level L-1, down to one texel. uv as in `conventions`.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

REPEAT = wp.constant(0)
CLAMP = wp.constant(1)
MIRROR = wp.constant(2)


@wp.struct
class Texels:
    """words: every texel; levels: (offset, width, height, 0) of every level; pages: (first level, levels, wraps)."""

    words: wp.array(dtype=wp.uint32)
    levels: wp.array(dtype=wp.vec4i)
    pages: wp.array(dtype=wp.vec4i)
    linear: wp.array(dtype=wp.float32)


@wp.func
def wrapped(i: int, size: int, mode: int) -> int:
    """A texel's index brought into the texture."""
    if i >= 0 and i < size:
        return i
    if mode == CLAMP:
        return wp.clamp(i, 0, size - 1)
    if mode == REPEAT:
        j = i % size
        return wp.where(j < 0, j + size, j)
    j = i % (2 * size)
    j = wp.where(j < 0, j + 2 * size, j)
    return wp.where(j < size, j, 2 * size - 1 - j)


@wp.func
def texel(t: Texels, offset: int, index: int) -> wp.vec4:
    """One texel, linear RGB and alpha in [0, 1]."""
    word = t.words[offset + index]
    return wp.vec4(
        t.linear[int(word & wp.uint32(255))],
        t.linear[int((word >> wp.uint32(8)) & wp.uint32(255))],
        t.linear[int((word >> wp.uint32(16)) & wp.uint32(255))],
        float(word >> wp.uint32(24)) * (1.0 / 255.0),
    )


@wp.func
def sample_level(t: Texels, page: wp.vec4i, level: int, uv: wp.vec2) -> wp.vec4:
    """Bilinear sample of one mip level."""
    place = t.levels[page[0] + level]
    x = uv[0] * float(place[1]) - 0.5
    y = uv[1] * float(place[2]) - 0.5
    x0 = int(wp.floor(x))
    y0 = int(wp.floor(y))
    fx = x - float(x0)
    fy = y - float(y0)
    left = wrapped(x0, place[1], page[2])
    right = wrapped(x0 + 1, place[1], page[2])
    upper = wrapped(y0, place[2], page[3]) * place[1]
    lower = wrapped(y0 + 1, place[2], page[3]) * place[1]
    above = wp.lerp(texel(t, place[0], upper + left), texel(t, place[0], upper + right), fx)
    below = wp.lerp(texel(t, place[0], lower + left), texel(t, place[0], lower + right), fx)
    return wp.lerp(above, below, fy)


@wp.func
def taps_of(extent: wp.vec2, along_x: wp.vec2, along_y: wp.vec2) -> wp.vec4:
    """(step u, step v, taps, mip level) for a footprint given by the uv steps of one pixel in the picture.

    Up to four taps lie along the footprint's longer axis; the mip level fits a tap (EXT_texture_filter_anisotropic).
    """
    length_x = wp.length(wp.cw_mul(along_x, extent))
    length_y = wp.length(wp.cw_mul(along_y, extent))
    longer = wp.where(length_x > length_y, along_x, along_y)
    major = wp.max(length_x, length_y)
    minor = wp.min(length_x, length_y)
    taps = wp.clamp(wp.floor(major / wp.max(minor, 1.0) + 0.5), 1.0, 4.0)
    return wp.vec4(longer[0] / taps, longer[1] / taps, taps, wp.log2(wp.max(major / taps, 1.0)))


@wp.func
def sample(t: Texels, texture: int, uv: wp.vec2, along_x: wp.vec2, along_y: wp.vec2) -> wp.vec4:
    """Anisotropic trilinear sample; `along_x`, `along_y` as in `taps_of`."""
    page = t.pages[texture]
    base = t.levels[page[0]]
    plan = taps_of(wp.vec2(float(base[1]), float(base[2])), along_x, along_y)
    step = wp.vec2(plan[0], plan[1])
    lod = wp.min(plan[3], float(page[1] - 1))
    level = int(lod)
    blend = wp.clamp(2.0 * (lod - float(level)) - 0.5, 0.0, 1.0)  # close to a level, that level alone
    total = wp.vec4()
    first = uv - step * (0.5 * (plan[2] - 1.0))
    for k in range(int(plan[2])):
        place = first + step * float(k)
        color = sample_level(t, page, level, place)
        if blend > 0.0:
            color = wp.lerp(color, sample_level(t, page, wp.min(level + 1, page[1] - 1), place), blend)
        total += color
    return total / plan[2]


@wp.func
def sample_alpha(t: Texels, texture: int, uv: wp.vec2) -> float:
    """Alpha of the full-size texture; 1 where the face has no texture."""
    if texture < 0:
        return 1.0
    return sample_level(t, t.pages[texture], 0, uv)[3]
