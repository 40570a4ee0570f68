"""The look of a mesh: its colour anywhere on its surface, and carried over to another mesh of the same shape.

Colours are linear RGBA in [0, 1]: base colour * texture (bilinear, in linear light) * vertex colour. A carried look is
opaque.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from jaxtyping import Float, Float32, Int
from scipy.spatial import KDTree

from mv3d_cli.kernels.rasterize import rasterize
from mv3d_cli.meshes.fill import dilated
from mv3d_cli.meshes.unwrap import unwrapped, uv_camera
from mv3d_cli.scene.conventions import linear_from_srgb, srgb_from_linear
from mv3d_cli.scene.mesh import Material, Mesh, Texture, Wrap, face_normals

SAMPLES = 300_000
CANDIDATES = 8
"""Samples near a point, of which the nearest that looks the point's way counts: thin walls have two sides."""

CHUNK = 1 << 16

_LINEAR = linear_from_srgb(np.arange(256) / 255).astype(np.float32)


@dataclass(frozen=True)
class Spots:
    """Points of a surface by their faces and barycentric shares."""

    face: Int[np.ndarray, "spots"]
    shares: Float[np.ndarray, "spots 3"]


def is_plain(mesh: Mesh) -> bool:
    """Whether one colour covers the whole mesh."""
    used = [mesh.materials[index] for index in np.unique(mesh.face_material)]
    return mesh.colors is None and not is_textured(mesh) and len({material.base_color for material in used}) == 1


def is_textured(mesh: Mesh) -> bool:
    """Whether a face of the mesh has a texture."""
    return mesh.uvs is not None and any(mesh.materials[i].texture is not None for i in np.unique(mesh.face_material))


def is_opaque(mesh: Mesh) -> bool:
    """Whether no material of the mesh has transparency."""
    return all(mesh.materials[index].alpha_mode == "opaque" for index in np.unique(mesh.face_material))


def colors_at(mesh: Mesh, spots: Spots) -> Float32[np.ndarray, "spots 4"]:
    """The mesh's own colours at spots of its surface, whatever the light."""
    material = mesh.face_material[spots.face]
    colors = np.array([entry.base_color for entry in mesh.materials], np.float32)[material]
    if mesh.colors is not None:
        colors *= _blended(mesh.colors, mesh, spots)
    if mesh.uvs is not None:
        uv = _blended(mesh.uvs, mesh, spots)
        for index in np.unique(material):
            texture = mesh.materials[index].texture
            if texture is not None:
                own = material == index
                colors[own] *= _looked_up(texture, uv[own])
    return colors.clip(0, 1)


def with_vertex_colors(mesh: Mesh) -> Mesh:
    """The mesh with its look, opaque, in its vertices' colours; vertices that materials share are doubled."""
    keys, corners = np.unique(mesh.faces + mesh.face_material[:, None] * len(mesh.vertices), return_inverse=True)
    vertex, corners = keys % len(mesh.vertices), corners.reshape(-1)
    corner = np.zeros(len(keys), np.int64)
    corner[corners] = np.arange(len(corners))
    colors = colors_at(mesh, Spots(corner // 3, np.eye(3)[corner % 3]))
    return replace(
        mesh,
        vertices=mesh.vertices[vertex],
        faces=corners.reshape(-1, 3).astype(np.int32),
        face_material=np.zeros(len(mesh.faces), np.int32),
        materials=(_main_material(mesh),),
        normals=None if mesh.normals is None else mesh.normals[vertex],
        uvs=None,
        colors=_opaque(colors),
    )


def carried_to_vertices(mesh: Mesh, source: Mesh) -> Mesh:
    """The mesh with the look of `source`, a mesh of nearly the same shape, in its vertices' colours."""
    normals = np.zeros(mesh.vertices.shape)
    np.add.at(normals, mesh.faces, face_normals(mesh)[:, None])
    colors = colors_at(source, _nearest(source, mesh.vertices.astype(np.float64), normals))
    return replace(_of_material(mesh, _main_material(source)), uvs=None, colors=_opaque(colors))


def carried_to_texture(mesh: Mesh, source: Mesh, size: int) -> Mesh:
    """The mesh, unwrapped, with the look of `source`, a mesh of nearly the same shape, in a texture of `size`²."""
    laid = unwrapped(replace(mesh, uvs=None, colors=None), size)
    assert laid.uvs is not None
    picture = rasterize(np.pad(laid.uvs, ((0, 0), (0, 1))), laid.faces, [uv_camera()], size, size)
    covered = picture.face[0] >= 0
    texels = Spots(picture.face[0][covered], picture.barycentric[0][covered])
    found = _nearest(source, _blended(laid.vertices, laid, texels).astype(np.float64), face_normals(laid)[texels.face])
    pixels = np.full((size, size, 4), 255, np.uint8)
    pixels[covered, :3] = np.round(srgb_from_linear(colors_at(source, found)[:, :3]) * 255)
    pixels = dilated(pixels, covered)
    return _of_material(laid, replace(_main_material(source), texture=Texture(pixels, "clamp", "clamp")))


def plain_as(mesh: Mesh, source: Mesh) -> Mesh:
    """The mesh in the colour of `source`, which is plain."""
    base = source.materials[int(source.face_material[0])].base_color
    return _of_material(mesh, replace(_main_material(source), base_color=base))


def _of_material(mesh: Mesh, material: Material) -> Mesh:
    return replace(mesh, face_material=np.zeros(len(mesh.faces), np.int32), materials=(material,))


def _main_material(mesh: Mesh) -> Material:
    """Roughness and metal of the material that most faces have, in white."""
    most = mesh.materials[int(np.bincount(mesh.face_material).argmax())]
    return Material(roughness=most.roughness, metallic=most.metallic, name=most.name)


def _opaque(colors: Float32[np.ndarray, "rows 4"]) -> Float32[np.ndarray, "rows 4"]:
    return np.concatenate([colors[:, :3], np.ones_like(colors[:, :1])], axis=1)


def _blended(values: Float[np.ndarray, "vertices n"], mesh: Mesh, spots: Spots) -> Float32[np.ndarray, "spots n"]:
    corners = mesh.faces[spots.face]
    parts = [spots.shares[:, corner, None] * values[corners[:, corner]] for corner in range(3)]
    return np.add.reduce(parts).astype(np.float32)


def _looked_up(texture: Texture, uv: Float32[np.ndarray, "spots 2"]) -> Float32[np.ndarray, "spots 4"]:
    """Bilinear samples."""
    height, width = texture.pixels.shape[:2]
    place = uv * np.array([width, height]) - 0.5
    low = np.floor(place).astype(np.int64)
    share = (place - low).astype(np.float32)
    total = np.zeros((len(uv), 4), np.float32)
    for right in (0, 1):
        column = _wrapped(low[:, 0] + right, width, texture.wrap_u)
        for lower in (0, 1):
            row = _wrapped(low[:, 1] + lower, height, texture.wrap_v)
            weight = np.abs(1 - right - share[:, 0]) * np.abs(1 - lower - share[:, 1])
            texel = texture.pixels[row, column]
            linear = np.concatenate([_LINEAR[texel[:, :3]], texel[:, 3:].astype(np.float32) / 255], axis=1)
            total += weight[:, None] * linear
    return total


def _wrapped(index: Int[np.ndarray, "spots"], size: int, wrap: Wrap) -> Int[np.ndarray, "spots"]:
    """Texels' indices brought into the texture."""
    if wrap == "clamp":
        return index.clip(0, size - 1)
    if wrap == "repeat":
        return index % size
    around = index % (2 * size)
    return np.minimum(around, 2 * size - 1 - around)


def _nearest(mesh: Mesh, points: Float[np.ndarray, "points 3"], normals: Float[np.ndarray, "points 3"]) -> Spots:
    """Spots of the mesh near the points, on the side that looks as the normals do where there is one."""
    triangles, outwards = mesh.vertices[mesh.faces].astype(np.float64), face_normals(mesh)
    owner, places = _samples(triangles)
    tree = KDTree(places)
    parts = []
    for start in range(0, len(points), CHUNK):
        part, normal = points[start : start + CHUNK], normals[start : start + CHUNK]
        found = owner[cast(np.ndarray, tree.query(part, CANDIDATES, workers=-1)[1])]
        alike = np.einsum("pcx,px->pc", outwards[found], normal) > 0
        face = found[np.arange(len(part)), alike.argmax(axis=1)]
        parts.append((face, _shares(triangles[face], part)))
    faces, shares = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return Spots(faces, shares)


def _samples(triangles: Float[np.ndarray, "faces 3 3"]) -> tuple[np.ndarray, np.ndarray]:
    """The faces and places of samples: each face's middle, and more spread evenly over the area."""
    area = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1)
    generator = np.random.default_rng(0)
    steps = (np.arange(SAMPLES) + generator.random(SAMPLES)) / SAMPLES
    drawn = np.searchsorted(np.cumsum(area) / area.sum(), steps).clip(0, len(area) - 1)
    root, other = np.sqrt(generator.random(SAMPLES)), generator.random(SAMPLES)
    shares = np.stack([1 - root, root * (1 - other), root * other], axis=1)
    places = np.concatenate([triangles.mean(axis=1), np.einsum("sc,scx->sx", shares, triangles[drawn])])
    return np.concatenate([np.arange(len(area)), drawn]), places


def _shares(triangles: Float[np.ndarray, "points 3 3"], points: Float[np.ndarray, "points 3"]) -> np.ndarray:
    """Barycentric shares of the points, brought into their triangles."""
    first, second, third = (
        triangles[:, 1] - triangles[:, 0],
        triangles[:, 2] - triangles[:, 0],
        points - triangles[:, 0],
    )
    normal = np.cross(first, second)
    scale = np.maximum((normal**2).sum(axis=1), 1e-300)
    b = (np.cross(third, second) * normal).sum(axis=1) / scale
    c = (np.cross(first, third) * normal).sum(axis=1) / scale
    shares = np.stack([1 - b - c, b, c], axis=1).clip(0, 1)
    return shares / shares.sum(axis=1, keepdims=True)
