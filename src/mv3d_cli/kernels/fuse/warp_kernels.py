"""Warp source of the fusion: one thread fills one column of voxels (along z)."""

import warp as wp

wp.set_module_options({"enable_backward": False})

STEP = wp.constant(0.06)
"""Scene units between neighbouring depths: more is two surfaces, and nothing lies between them."""


@wp.struct
class Picture:
    """A view: camera, and where its texels (depth, |normal . ray|, outline in scene units, trust) lie on the shelf."""

    rotation: wp.mat33
    translation: wp.vec3
    scale: wp.vec2
    offset: wp.vec2
    perspective: wp.int32
    start: wp.int32
    width: wp.int32
    height: wp.int32
    deep: wp.int32
    outlined: wp.int32
    weight: wp.float32


@wp.func
def texel_at(shelf: wp.array(dtype=wp.vec4), picture: Picture, x: wp.float32, y: wp.float32) -> wp.vec4:
    """Bilinear; across a step in depth the nearest texel but for its outline; outside grows beyond the border."""
    u = wp.clamp(x - 0.5, 0.0, wp.float32(picture.width) - 1.001)
    v = wp.clamp(y - 0.5, 0.0, wp.float32(picture.height) - 1.001)
    j = wp.int32(u)
    i = wp.int32(v)
    right = u - wp.float32(j)
    down = v - wp.float32(i)
    first = picture.start + i * picture.width + j
    a = shelf[first]
    b = shelf[first + 1]
    c = shelf[first + picture.width]
    d = shelf[first + picture.width + 1]
    mixed = (1.0 - down) * ((1.0 - right) * a + right * b) + down * ((1.0 - right) * c + right * d)
    low = wp.min(wp.min(a[0], b[0]), wp.min(c[0], d[0]))
    high = wp.max(wp.max(a[0], b[0]), wp.max(c[0], d[0]))
    if high - low > STEP:
        near = shelf[first + wp.int32(down + 0.5) * picture.width + wp.int32(right + 0.5)]
        mixed = wp.vec4(near[0], near[1], mixed[2], near[3])
    beyond = wp.length(wp.vec2(x - 0.5 - u, y - 0.5 - v)) / picture.scale[0]
    return wp.vec4(mixed[0], mixed[1], mixed[2] + beyond, mixed[3])


@wp.func
def distance_at(
    point: wp.vec3, shelf: wp.array(dtype=wp.vec4), pictures: wp.array(dtype=Picture), reach: wp.float32
) -> wp.float32:
    """Signed distance, positive outside, within `reach` of zero."""
    outside = wp.float32(-reach)
    total = wp.float32(0.0)
    weights = wp.float32(0.0)
    for index in range(pictures.shape[0]):
        picture = pictures[index]
        place = picture.rotation * point + picture.translation
        z = place[2]
        ray = wp.vec3(place[0], place[1], 1.0)
        length = wp.float32(1.0)
        unit = wp.float32(1.0)
        if picture.perspective == 1:
            z = wp.max(z, 1.0e-6)
            ray = wp.vec3(place[0] / z, place[1] / z, 1.0)
            length = wp.length(ray)
            unit = z
        x = ray[0] * picture.scale[0] + picture.offset[0]
        y = ray[1] * picture.scale[1] + picture.offset[1]
        texel = texel_at(shelf, picture, x, y)
        if picture.outlined == 1:
            outside = wp.max(outside, texel[2] * unit)
            if outside >= reach:
                return reach
        if picture.deep == 1 and texel[2] < 0.0:
            distance = (texel[0] - z) * texel[1]
            if distance > -reach:
                cosine = texel[1] / length
                weight = texel[3] * picture.weight * cosine * cosine * wp.min(1.0, 1.0 + distance / reach)
                total += weight * wp.min(distance, reach)
                weights += weight
    if weights > 1.0e-6:
        return wp.max(total / weights, outside)
    return outside


@wp.kernel
def fuse(
    shelf: wp.array(dtype=wp.vec4),
    pictures: wp.array(dtype=Picture),
    origin: wp.vec3,
    voxel: wp.float32,
    reach: wp.float32,
    first: wp.int32,
    distances: wp.array3d(dtype=wp.float32),
):
    i, j = wp.tid()
    i += first
    for k in range(distances.shape[2]):
        point = origin + voxel * wp.vec3(wp.float32(i), wp.float32(j), wp.float32(k))
        distances[i, j, k] = distance_at(point, shelf, pictures, reach)
