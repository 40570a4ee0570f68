"""Warp source of the z-buffer rasteriser.

A sample's z-buffer word holds the bits of z (positive floats order like integers) above the face's index, so that one
atomic minimum settles visibility, the same way on every device and in any order. A face of equal depth and lower
index wins. On a CPU a thread of a launch takes a block of items, since it unpacks its arguments anew each time.
"""

from __future__ import annotations

import warp as wp

from mv3d_cli.kernels.rasterize.footprint import (
    NEAR,
    Eye,
    barycentric_at,
    footprint_of,
    in_camera,
    in_picture,
    run_inside,
    slope,
)
from mv3d_cli.kernels.texture import Texels, sample_alpha

wp.set_module_options({"enable_backward": False})

EMPTY = 0x7F8000007FFFFFFF  # infinitely far, no face


@wp.struct
class Cutouts:
    """Alpha tests: faces whose cutoff is positive keep only samples whose texture's alpha reaches it."""

    cutoff: wp.array(dtype=wp.float32)
    uvs: wp.array(dtype=wp.vec2)
    texture: wp.array(dtype=wp.int32)
    texels: Texels


@wp.kernel
def project(
    eyes: wp.array(dtype=Eye),
    view: int,
    block: int,
    vertices: wp.array(dtype=wp.vec3),
    screen: wp.array(dtype=wp.vec3),
):
    """Vertices into the picture, (column, row, z); `block` of them a thread."""
    part = wp.tid()
    eye = eyes[view]
    for i in range(part * block, wp.min((part + 1) * block, vertices.shape[0])):
        screen[i] = in_picture(eye, in_camera(eye, vertices[i]))


@wp.func
def word_from(z: float, face: int) -> wp.int64:
    return (wp.int64(wp.cast(z, wp.int32)) << wp.int64(32)) | wp.int64(face)


@wp.func
def depth_from(word: wp.int64) -> float:
    return wp.cast(wp.int32(word >> wp.int64(32)), wp.float32)


@wp.func
def face_from(word: wp.int64) -> int:
    if word == wp.int64(EMPTY):
        return -1
    return wp.int32(word & wp.int64(0x7FFFFFFF))


@wp.func
def is_tested(cutouts: Cutouts, index: int) -> bool:
    """Whether a face has an alpha test."""
    if cutouts.cutoff.shape[0] == 0:
        return False
    return cutouts.cutoff[index] > 0.0


@wp.func
def is_kept(cutouts: Cutouts, index: int, corners: wp.vec3i, shares: wp.vec3) -> bool:
    """Whether a sample passes the alpha test of its face."""
    uv = cutouts.uvs[corners[0]] * shares[0] + cutouts.uvs[corners[1]] * shares[1] + cutouts.uvs[corners[2]] * shares[2]
    uv = uv / (shares[0] + shares[1] + shares[2])
    return sample_alpha(cutouts.texels, cutouts.texture[index], uv) >= cutouts.cutoff[index]


@wp.func
def draw_face(
    eye: Eye,
    vertices: wp.array(dtype=wp.vec3),
    corners: wp.vec3i,
    screen: wp.array(dtype=wp.vec3),
    cutouts: Cutouts,
    index: int,
    rows: wp.vec3i,
    words: wp.array2d(dtype=wp.int64),
):
    """One face into the z-buffer: of `rows` = (first, end, step) those that it meets."""
    face = footprint_of(eye, vertices, corners, screen, wp.vec2i(words.shape[1], words.shape[0]))
    first = wp.max(face.top, rows[0])
    end = wp.min(face.bottom_end, rows[1])
    if first >= end or face.left >= face.right_end:
        return
    tested = is_tested(cutouts, index)
    per_right = wp.vec3(1.0 / face.right[0], 1.0 / face.right[1], 1.0 / face.right[2])
    z_right = slope(face, face.right, eye.perspective)
    for row in range(first, end, rows[2]):
        start = face.value + face.down * float(row - face.top)
        run = run_inside(start, face.right, per_right, face.right_end - face.left)
        z_start = slope(face, start, eye.perspective)
        for step in range(run[0], run[1]):
            z = z_start + z_right * float(step)
            if eye.perspective == 1:
                z = 1.0 / z
            if z > NEAR and (not tested or is_kept(cutouts, index, corners, start + face.right * float(step))):
                wp.atomic_min(words, row, face.left + step, word_from(z, index))


@wp.kernel
def fill_z_buffer(
    eyes: wp.array(dtype=Eye),
    view: int,
    band: wp.vec2i,
    block: int,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    screen: wp.array(dtype=wp.vec3),
    cutouts: Cutouts,
    phases: int,
    words: wp.array2d(dtype=wp.int64),
):
    """Faces into rows `band` of the z-buffer: a thread draws every `phases`-th row of `block` faces."""
    part, phase = wp.tid()
    eye = eyes[view]
    rows = wp.vec3i(band[0] + phase, band[1], phases)
    for index in range(part * block, wp.min((part + 1) * block, faces.shape[0])):
        draw_face(eye, vertices, faces[index], screen, cutouts, index, rows, words)


@wp.kernel
def resolve(
    eyes: wp.array(dtype=Eye),
    view: int,
    first_row: int,
    run: int,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    screen: wp.array(dtype=wp.vec3),
    words: wp.array2d(dtype=wp.int64),
    face_out: wp.array2d(dtype=wp.int32),
    barycentric_out: wp.array2d(dtype=wp.vec3),
    depth_out: wp.array2d(dtype=wp.float32),
):
    """Z-buffer words into face index (-1 = none), barycentrics and depth (0 = none), `run` pixels a thread."""
    row_in_band, part = wp.tid()
    row = first_row + row_in_band
    eye = eyes[view]
    for column in range(part * run, wp.min((part + 1) * run, words.shape[1])):
        word = words[row, column]
        index = face_from(word)
        face_out[row, column] = index
        if index >= 0:
            place = wp.vec2(float(column) + 0.5, float(row) + 0.5)
            barycentric_out[row, column] = barycentric_at(eye, vertices, faces[index], screen, place)
            depth_out[row, column] = depth_from(word)
        else:
            barycentric_out[row, column] = wp.vec3()
            depth_out[row, column] = 0.0
