"""Warp source of the shading: z-buffer words into colour, depth and normals.

Colour is multisampled: the z-buffer has 2 x 2 samples a pixel; each face among a pixel's samples is
shaded once, at the centre or amid the samples it covers, with a texture footprint of one pixel, in linear light.
"""

from __future__ import annotations

import warp as wp

from mv3d_cli.kernels.rasterize.footprint import Eye, barycentric_at
from mv3d_cli.kernels.rasterize.warp_kernels import depth_from, face_from
from mv3d_cli.kernels.shade.light import Lights, lit
from mv3d_cli.kernels.texture import Texels, sample

wp.set_module_options({"enable_backward": False})

CODE_STEPS = wp.constant(16383)


@wp.struct
class Surface:
    """A mesh's looks; arrays of length 0 stand for what it lacks."""

    normals: wp.array(dtype=wp.vec3)
    uvs: wp.array(dtype=wp.vec2)
    colors: wp.array(dtype=wp.vec4)
    face_material: wp.array(dtype=wp.int32)
    base_color: wp.array(dtype=wp.vec4)
    texture: wp.array(dtype=wp.int32)
    gloss: wp.array(dtype=wp.float32)
    texels: Texels


@wp.func
def face_normal(vertices: wp.array(dtype=wp.vec3), corners: wp.vec3i) -> wp.vec3:
    a = vertices[corners[0]]
    return wp.normalize(wp.cross(vertices[corners[1]] - a, vertices[corners[2]] - a))


@wp.func
def point_at(vertices: wp.array(dtype=wp.vec3), corners: wp.vec3i, b: wp.vec3) -> wp.vec3:
    return vertices[corners[0]] * b[0] + vertices[corners[1]] * b[1] + vertices[corners[2]] * b[2]


@wp.func
def towards_eye(eye: Eye, point: wp.vec3) -> wp.vec3:
    """Unit direction from a point in the world to the viewer."""
    if eye.perspective == 0:
        return wp.vec3(-wp.vec3d(eye.rotation[2, 0], eye.rotation[2, 1], eye.rotation[2, 2]))
    centre = -(wp.transpose(eye.rotation) * eye.translation)
    return wp.normalize(wp.vec3(centre) - point)


@wp.func
def normal_at(
    surface: Surface, vertices: wp.array(dtype=wp.vec3), corners: wp.vec3i, b: wp.vec3, viewer: wp.vec3
) -> wp.vec3:
    """The shading normal, on the viewer's side of the face (surfaces are two-sided)."""
    flat = face_normal(vertices, corners)
    side = wp.where(wp.dot(flat, viewer) < 0.0, -1.0, 1.0)
    if surface.normals.shape[0] == 0:
        return flat * side
    smooth = (
        surface.normals[corners[0]] * b[0] + surface.normals[corners[1]] * b[1] + surface.normals[corners[2]] * b[2]
    )
    if wp.dot(smooth, flat) <= 0.0:
        return flat * side
    return wp.normalize(smooth) * side


@wp.func
def albedo_at(surface: Surface, material: int, corners: wp.vec3i, b: wp.vec3, bx: wp.vec3, by: wp.vec3) -> wp.vec3:
    """Linear albedo at barycentrics `b`; `bx`, `by` are the barycentrics one pixel to the right and below."""
    factor = surface.base_color[material]
    color = wp.vec3(factor[0], factor[1], factor[2])
    if surface.colors.shape[0] > 0:
        c = surface.colors[corners[0]] * b[0] + surface.colors[corners[1]] * b[1] + surface.colors[corners[2]] * b[2]
        color = wp.cw_mul(color, wp.vec3(c[0], c[1], c[2]))
    texture = surface.texture[material]
    if texture >= 0:
        s = surface.uvs[corners[0]]
        t = surface.uvs[corners[1]]
        r = surface.uvs[corners[2]]
        uv = s * b[0] + t * b[1] + r * b[2]
        along_x = s * bx[0] + t * bx[1] + r * bx[2] - uv
        along_y = s * by[0] + t * by[1] + r * by[2] - uv
        c4 = sample(surface.texels, texture, uv, along_x, along_y)
        color = wp.cw_mul(color, wp.vec3(c4[0], c4[1], c4[2]))
    return color


@wp.func
def byte(codes: wp.array(dtype=wp.uint8), value: float) -> wp.uint32:
    """The sRGB byte of a linear value, by table."""
    return wp.uint32(codes[int(wp.clamp(value, 0.0, 1.0) * float(CODE_STEPS) + 0.5)])


@wp.func
def centre_of(seen: wp.vec4i, k: int) -> wp.vec3:
    """(x, y, count): the centre of the samples that show the face of sample `k`; count 0 if an earlier one did."""
    total = wp.vec3()
    for j in range(4):
        if seen[j] == seen[k]:
            if j < k:
                return wp.vec3()
            total += wp.vec3(float(j % 2) + 0.5, float(j // 2) + 0.5, 1.0)
    return wp.vec3(total[0] / total[2], total[1] / total[2], total[2])


@wp.func
def shade_at(
    eye: Eye,
    vertices: wp.array(dtype=wp.vec3),
    corners: wp.vec3i,
    screen: wp.array(dtype=wp.vec3),
    surface: Surface,
    lights: Lights,
    index: int,
    centre: wp.vec2,
    covered: wp.vec2,
) -> wp.vec3:
    """Linear colour of a face in a pixel: at the pixel's centre if that lies in the face, else where it covers samples.

    Places are in the z-buffer, whose samples are half a pixel wide.
    """
    b = barycentric_at(eye, vertices, corners, screen, centre)
    place = centre
    if wp.min(b) < -1.0e-3:
        place = covered
        b = barycentric_at(eye, vertices, corners, screen, place)
    bx = b
    by = b
    material = surface.face_material[index]
    if surface.texture[material] >= 0:
        bx = barycentric_at(eye, vertices, corners, screen, place + wp.vec2(2.0, 0.0))
        by = barycentric_at(eye, vertices, corners, screen, place + wp.vec2(0.0, 2.0))
    albedo = albedo_at(surface, material, corners, b, bx, by)
    if lights.lit == 0:
        return albedo
    point = point_at(vertices, corners, b)
    viewer = towards_eye(eye, point)
    n = normal_at(surface, vertices, corners, b, viewer)
    return wp.min(lit(lights, albedo, surface.gloss[material], point, n, viewer), wp.vec3(1.0, 1.0, 1.0))


@wp.func
def packed(codes: wp.array(dtype=wp.uint8), color: wp.vec3, alpha: float) -> wp.uint32:
    """Four sRGB bytes with straight alpha, red lowest."""
    word = byte(codes, color[0]) | (byte(codes, color[1]) << wp.uint32(8)) | (byte(codes, color[2]) << wp.uint32(16))
    return word | (wp.uint32(alpha * 255.0 + 0.5) << wp.uint32(24))


@wp.func
def pixel_at(
    eye: Eye,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    screen: wp.array(dtype=wp.vec3),
    surface: Surface,
    lights: Lights,
    codes: wp.array(dtype=wp.uint8),
    seen: wp.vec4i,
    corner: wp.vec2,
) -> wp.uint32:
    """One pixel, of whose samples at least one shows a face; `corner` is its upper left, in samples."""
    middle = corner + wp.vec2(1.0, 1.0)
    total = wp.vec3()
    covered = wp.float32(0.0)
    k = wp.int32(0)
    while k < 4:  # not a `for`, which Warp would unroll into four copies of the shading
        if seen[k] >= 0:
            centre = centre_of(seen, k)
            if centre[2] > 0.0:
                place = corner + wp.vec2(centre[0], centre[1])
                shade = shade_at(eye, vertices, faces[seen[k]], screen, surface, lights, seen[k], middle, place)
                total += shade * centre[2]
                covered += centre[2]
        k += 1
    return packed(codes, total / covered, covered / 4.0)


@wp.kernel
def color(
    eyes: wp.array(dtype=Eye),
    view: int,
    block: int,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    screen: wp.array(dtype=wp.vec3),
    words: wp.array2d(dtype=wp.int64),
    surface: Surface,
    lights: Lights,
    codes: wp.array(dtype=wp.uint8),
    out: wp.array2d(dtype=wp.uint32),
):
    """Pixels, sRGB with straight alpha, from a z-buffer twice as fine; `block` of them a thread."""
    row, part = wp.tid()
    eye = eyes[view]
    upper = row * 2
    for column in range(part * block, wp.min((part + 1) * block, out.shape[1])):
        left = column * 2
        seen = wp.vec4i(
            face_from(words[upper, left]),
            face_from(words[upper, left + 1]),
            face_from(words[upper + 1, left]),
            face_from(words[upper + 1, left + 1]),
        )
        if wp.max(seen) < 0:
            out[row, column] = wp.uint32(0)
        else:
            corner = wp.vec2(float(left), float(upper))
            out[row, column] = pixel_at(eye, vertices, faces, screen, surface, lights, codes, seen, corner)


@wp.kernel
def geometry(
    eyes: wp.array(dtype=Eye),
    view: int,
    block: int,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    screen: wp.array(dtype=wp.vec3),
    words: wp.array2d(dtype=wp.int64),
    surface: Surface,
    depth_out: wp.array2d(dtype=wp.float32),
    normal_out: wp.array3d(dtype=wp.uint8),
):
    """Depth (0 = none) and normal bytes (128 = none) at pixel centres; normals in the viewer's axes."""
    row, part = wp.tid()
    eye = eyes[view]
    for column in range(part * block, wp.min((part + 1) * block, depth_out.shape[1])):
        word = words[row, column]
        index = face_from(word)
        n = wp.vec3()
        if index >= 0:
            corners = faces[index]
            place = wp.vec2(float(column) + 0.5, float(row) + 0.5)
            b = barycentric_at(eye, vertices, corners, screen, place)
            world = normal_at(surface, vertices, corners, b, towards_eye(eye, point_at(vertices, corners, b)))
            n = wp.vec3(eye.rotation * wp.vec3d(world))
            n = wp.vec3(n[0], -n[1], -n[2])
            depth_out[row, column] = depth_from(word)
        else:
            depth_out[row, column] = 0.0
        for i in range(3):
            normal_out[row, column, i] = wp.uint8(int(wp.clamp((n[i] + 1.0) * 127.5 + 0.5, 0.0, 255.0)))
