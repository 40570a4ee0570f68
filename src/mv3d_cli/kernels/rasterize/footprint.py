"""A face in the picture: where a point falls, which samples a face may cover, and what is linear across it.

Inside a face, barycentrics are linear in the picture under parallel rays, and barycentrics over z are under a pinhole
(Blinn, "Hyperbolic interpolation", 1992). So a face becomes three linear functions of the sample,
q_i = value_i + right_i * (column - left) + down_i * (row - top), for both projections.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

NEAR = wp.constant(1.0e-4)
SLACK = wp.constant(1.0e-4)  # pixels: a sample on a shared edge belongs to both faces, so no crack opens between them


@wp.struct
class Eye:
    """A camera in pixels: camera_from_world, and pixel = scale * coordinate (/ z) + offset."""

    rotation: wp.mat33d
    translation: wp.vec3d
    scale: wp.vec2d
    offset: wp.vec2d
    perspective: wp.int32


@wp.struct
class Footprint:
    """A face in the picture: the samples it may cover and its three linear functions (see the module's page)."""

    left: wp.int32
    top: wp.int32
    right_end: wp.int32
    bottom_end: wp.int32
    value: wp.vec3
    right: wp.vec3
    down: wp.vec3
    z: wp.vec3


@wp.func
def in_camera(eye: Eye, point: wp.vec3) -> wp.vec3d:
    return eye.rotation * wp.vec3d(point) + eye.translation


@wp.func
def in_picture(eye: Eye, p: wp.vec3d) -> wp.vec3:
    scale = wp.float64(1.0)
    if eye.perspective == 1:
        scale = wp.float64(1.0) / wp.max(p[2], wp.float64(NEAR))
    return wp.vec3(
        wp.float32(eye.scale[0] * p[0] * scale + eye.offset[0]),
        wp.float32(eye.scale[1] * p[1] * scale + eye.offset[1]),
        wp.float32(p[2]),
    )


@wp.func
def cross2(ax: float, ay: float, bx: float, by: float) -> float:
    return ax * by - ay * bx


@wp.func
def footprint_in_front(p: wp.vec3, q: wp.vec3, r: wp.vec3, perspective: int, width: int, height: int) -> Footprint:
    """The footprint of a face that lies wholly in front of the camera."""
    face = Footprint()
    face.left = wp.max(int(wp.ceil(wp.min(p[0], wp.min(q[0], r[0])) - 0.5 - 1.0e-3)), 0)
    face.top = wp.max(int(wp.ceil(wp.min(p[1], wp.min(q[1], r[1])) - 0.5 - 1.0e-3)), 0)
    face.right_end = wp.min(int(wp.floor(wp.max(p[0], wp.max(q[0], r[0])) - 0.5 + 1.0e-3)) + 1, width)
    face.bottom_end = wp.min(int(wp.floor(wp.max(p[1], wp.max(q[1], r[1])) - 0.5 + 1.0e-3)) + 1, height)
    area = cross2(q[0] - p[0], q[1] - p[1], r[0] - p[0], r[1] - p[1])
    if wp.abs(area) < 1.0e-12:
        face.right_end = face.left
        return face
    x = float(face.left) + 0.5
    y = float(face.top) + 0.5
    share = wp.vec3(1.0 / area, 1.0 / area, 1.0 / area)
    if perspective == 1:
        share = wp.vec3(share[0] / p[2], share[1] / q[2], share[2] / r[2])
    face.value = wp.cw_mul(
        share,
        wp.vec3(
            cross2(q[0] - x, q[1] - y, r[0] - x, r[1] - y),
            cross2(r[0] - x, r[1] - y, p[0] - x, p[1] - y),
            cross2(p[0] - x, p[1] - y, q[0] - x, q[1] - y),
        ),
    )
    face.right = wp.cw_mul(share, wp.vec3(q[1] - r[1], r[1] - p[1], p[1] - q[1]))
    face.down = wp.cw_mul(share, wp.vec3(r[0] - q[0], p[0] - r[0], q[0] - p[0]))
    face.z = wp.vec3(p[2], q[2], r[2])
    return face


@wp.func
def footprint_through_plane(eye: Eye, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, width: int, height: int) -> Footprint:
    """The footprint of a face that passes the camera's plane: homogeneous, so it needs no clipping.

    For the ray d = ((column - ox) / sx, (row - oy) / sy, 1), q_a = d . (b x c) / det (Olano & Greer, 1997).
    """
    face = Footprint()
    face.right_end = width
    face.bottom_end = height
    det = wp.dot(a, wp.cross(b, c))
    if wp.abs(det) < wp.float64(1.0e-15):
        face.right_end = 0
        return face
    q_from_ray = wp.matrix_from_rows(wp.cross(b, c) / det, wp.cross(c, a) / det, wp.cross(a, b) / det)
    x = (wp.float64(0.5) - eye.offset[0]) / eye.scale[0]
    y = (wp.float64(0.5) - eye.offset[1]) / eye.scale[1]
    face.value = wp.vec3(q_from_ray * wp.vec3d(x, y, wp.float64(1.0)))
    face.right = wp.vec3(q_from_ray * wp.vec3d(wp.float64(1.0) / eye.scale[0], wp.float64(0.0), wp.float64(0.0)))
    face.down = wp.vec3(q_from_ray * wp.vec3d(wp.float64(0.0), wp.float64(1.0) / eye.scale[1], wp.float64(0.0)))
    return face


@wp.func
def footprint_of(
    eye: Eye,
    vertices: wp.array(dtype=wp.vec3),
    corners: wp.vec3i,
    screen: wp.array(dtype=wp.vec3),
    size: wp.vec2i,
) -> Footprint:
    """The footprint of one face; empty where the face cannot be seen at all."""
    p = screen[corners[0]]
    q = screen[corners[1]]
    r = screen[corners[2]]
    nearest = wp.min(p[2], wp.min(q[2], r[2]))
    if wp.max(p[2], wp.max(q[2], r[2])) <= NEAR:
        return Footprint()
    if eye.perspective == 1 and nearest < NEAR:
        return footprint_through_plane(
            eye,
            in_camera(eye, vertices[corners[0]]),
            in_camera(eye, vertices[corners[1]]),
            in_camera(eye, vertices[corners[2]]),
            size[0],
            size[1],
        )
    return footprint_in_front(p, q, r, eye.perspective, size[0], size[1])


@wp.func
def barycentric_at(
    eye: Eye,
    vertices: wp.array(dtype=wp.vec3),
    corners: wp.vec3i,
    screen: wp.array(dtype=wp.vec3),
    place: wp.vec2,
) -> wp.vec3:
    """Barycentrics of the face's plane at a place in the picture (pixels)."""
    p = screen[corners[0]]
    q = screen[corners[1]]
    r = screen[corners[2]]
    if eye.perspective == 1 and wp.min(p[2], wp.min(q[2], r[2])) < NEAR:
        a = in_camera(eye, vertices[corners[0]])
        b = in_camera(eye, vertices[corners[1]])
        c = in_camera(eye, vertices[corners[2]])
        face = footprint_through_plane(eye, a, b, c, 1, 1)
        shares = face.value + face.right * (place[0] - 0.5) + face.down * (place[1] - 0.5)
        return shares / (shares[0] + shares[1] + shares[2])
    px = p[0] - place[0]
    py = p[1] - place[1]
    qx = q[0] - place[0]
    qy = q[1] - place[1]
    rx = r[0] - place[0]
    ry = r[1] - place[1]
    parts = wp.vec3(qx * ry - qy * rx, rx * py - ry * px, px * qy - py * qx)
    if eye.perspective == 1:
        parts = wp.vec3(parts[0] / p[2], parts[1] / q[2], parts[2] / r[2])
    return parts * (1.0 / (parts[0] + parts[1] + parts[2]))


@wp.func
def slope(face: Footprint, parts: wp.vec3, perspective: int) -> float:
    """What is linear in the picture, from the three linear functions: z under parallel rays, 1 / z under a pinhole."""
    if perspective == 1:
        return parts[0] + parts[1] + parts[2]
    return wp.dot(parts, face.z)


@wp.func
def run_inside(start: wp.vec3, right: wp.vec3, per_right: wp.vec3, columns: int) -> wp.vec2i:
    """The run of columns, [first, end), in which start + right * column stays positive in all three parts."""
    first = wp.float32(0.0)
    last = float(columns - 1)
    for i in range(3):
        crossing = -start[i] * per_right[i]
        if right[i] > 0.0:
            first = wp.max(first, crossing - SLACK)
        elif right[i] < 0.0:
            last = wp.min(last, crossing + SLACK)
        elif start[i] < 0.0:
            last = -1.0
    return wp.vec2i(int(wp.ceil(first)), int(wp.floor(last)) + 1)
