"""Warp source of the light at a point.

Second-order spherical harmonics (Ramamoorthi & Hanrahan, 2001), one directional light with a shadow map
(percentage-closer filtering, Reeves et al., 1987), and a Blinn-Phong highlight. Linear light, world axes.
"""

from __future__ import annotations

import warp as wp

from mv3d_cli.kernels.rasterize.footprint import Eye, in_camera, in_picture
from mv3d_cli.kernels.rasterize.warp_kernels import depth_from

wp.set_module_options({"enable_backward": False})


@wp.struct
class Lights:
    """lit = 0: albedo. ambient: 9 coefficients, already convolved with the cosine and divided by pi."""

    lit: wp.int32
    ambient: wp.array(dtype=wp.vec3)
    sun_direction: wp.vec3
    sun_color: wp.vec3
    specular: wp.float32
    shadow_eye: Eye
    shadow_words: wp.array2d(dtype=wp.int64)
    shadow_softness: wp.float32


@wp.func
def ambient_at(lights: Lights, n: wp.vec3) -> wp.vec3:
    """Irradiance over pi from the environment, by the nine real spherical harmonics of degree 2."""
    c = lights.ambient
    value = c[0] * 0.282095
    value += (c[1] * n[1] + c[2] * n[2] + c[3] * n[0]) * 0.488603
    value += (c[4] * (n[0] * n[1]) + c[5] * (n[1] * n[2]) + c[7] * (n[0] * n[2])) * 1.092548
    value += c[6] * (0.315392 * (3.0 * n[2] * n[2] - 1.0)) + c[8] * (0.546274 * (n[0] * n[0] - n[1] * n[1]))
    return wp.max(value, wp.vec3())


@wp.func
def sun_at(lights: Lights, point: wp.vec3, n: wp.vec3) -> float:
    """The share of the sun that reaches a point: nine taps of the shadow map, the point lifted off its surface."""
    lifted = point + n * 0.012
    place = in_picture(lights.shadow_eye, in_camera(lights.shadow_eye, lifted))
    reach = lights.shadow_softness
    x = wp.clamp(place[0], reach, float(lights.shadow_words.shape[1] - 1) - reach)
    y = wp.clamp(place[1], reach, float(lights.shadow_words.shape[0] - 1) - reach)
    nearest = place[2] - 0.008
    light = wp.float32(0.0)
    for i in range(3):
        for j in range(3):
            word = lights.shadow_words[int(y + float(i - 1) * reach), int(x + float(j - 1) * reach)]
            if nearest < depth_from(word):  # an empty word reads as a depth without end
                light += 1.0 / 9.0
    return light


@wp.func
def lit(lights: Lights, albedo: wp.vec3, gloss: float, point: wp.vec3, n: wp.vec3, viewer: wp.vec3) -> wp.vec3:
    """Linear colour that leaves a point towards the viewer."""
    light = ambient_at(lights, n)
    facing = wp.dot(n, lights.sun_direction)
    highlight = wp.float32(0.0)
    if facing > 0.0:
        sun = sun_at(lights, point, n)
        light += lights.sun_color * (facing * sun)
        if lights.specular * gloss > 0.0:
            halfway = wp.normalize(lights.sun_direction + viewer)
            exponent = wp.pow(2.0, 2.0 + 7.0 * gloss)
            highlight = lights.specular * gloss * sun * wp.pow(wp.max(wp.dot(n, halfway), 0.0), exponent)
    return wp.cw_mul(albedo, light) + lights.sun_color * highlight
