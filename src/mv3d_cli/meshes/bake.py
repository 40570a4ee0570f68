"""Colours of a mesh from pictures of it: as a texture, or at its vertices; and the pictures' exposures made equal.

A point's colour is the mean over the views that see it, by how squarely and how far from silhouettes they do. (Taking
high frequencies from the best view alone looked no better and measured 0.3 dB worse on views that disagree.) Colours
are sRGB in [0, 1] while they are blended.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Float, Float32, Int

from mv3d_cli.kernels.rasterize import rasterize
from mv3d_cli.kernels.runtime import in_threads
from mv3d_cli.meshes.fill import dilated, harmonic
from mv3d_cli.meshes.shots import Shot, Sight, sights, witness
from mv3d_cli.meshes.surface import with_normals
from mv3d_cli.meshes.unwrap import uv_camera
from mv3d_cli.scene.conventions import linear_from_srgb
from mv3d_cli.scene.mesh import Mesh, Texture

Fill = Callable[[Float[np.ndarray, "points 3"]], Float[np.ndarray, "points 3"]]

CHUNK = 16384
DOUBT = 3e-4
"""Trust below which a point's colour is rather its neighbourhood's."""


@dataclass(frozen=True)
class Points:
    """Points of a surface, and where they lie on its faces."""

    position: Float32[np.ndarray, "points 3"]
    normal: Float32[np.ndarray, "points 3"]
    corners: Int[np.ndarray, "points 3"]
    shares: Float32[np.ndarray, "points 3"]


@dataclass(frozen=True)
class Blend:
    """What the views say together: colour, and the sum of their trust."""

    color: Float32[np.ndarray, "points 3"]
    trust: Float32[np.ndarray, "points"]


def bake(mesh: Mesh, shots: Sequence[Shot], size: int, fill: Fill | None = None) -> Texture:
    """An opaque square texture of `size` texels for the mesh's uvs.

    fill  sRGB in [0, 1] of points that no shot sees; None: colours of the seen surface spread over the mesh
    Raises ValueError for a mesh without uvs.
    """
    if mesh.uvs is None:
        raise ValueError("the mesh has no uvs: unwrap it first")
    smooth = mesh if mesh.normals is not None else with_normals(mesh)
    flat = np.pad(mesh.uvs, ((0, 0), (0, 1)))
    picture = rasterize(flat, mesh.faces, [uv_camera()], size, size)
    covered = picture.face[0] >= 0
    texels = _points(smooth, picture.face[0][covered], picture.barycentric[0][covered])
    rgb = np.full((size, size, 3), 0.5, np.float32)
    rgb[covered] = _colors(smooth, texels, sights(smooth, shots), fill)
    pixels = np.full((size, size, 4), 255, np.uint8)
    pixels[..., :3] = dilated(np.round(rgb.clip(0, 1) * 255).astype(np.uint8), covered)
    return Texture(pixels, "clamp", "clamp")


def vertex_colors(mesh: Mesh, shots: Sequence[Shot], fill: Fill | None = None) -> Mesh:
    """The mesh with colours at its vertices, blended and filled as in `bake`."""
    smooth = mesh if mesh.normals is not None else with_normals(mesh)
    rgb = _colors(smooth, _vertices(smooth), sights(smooth, shots), fill)
    linear = linear_from_srgb(rgb.clip(0, 1))
    return replace(mesh, colors=np.pad(linear, ((0, 0), (0, 1)), constant_values=1).astype(np.float32))


def balanced(mesh: Mesh, shots: Sequence[Shot]) -> tuple[Shot, ...]:
    """The shots with `gains` applied."""
    return tuple(replace(shot, gain=float(gain)) for shot, gain in zip(shots, gains(mesh, shots), strict=True))


def gains(mesh: Mesh, shots: Sequence[Shot]) -> Float[np.ndarray, "shots"]:
    """What each shot's colours must be multiplied with so that shots agree where they see the same; fixed ones: 1.

    Robust least squares on logarithms of brightness at the vertices, with a weak pull towards 1.
    """
    smooth = mesh if mesh.normals is not None else with_normals(mesh)
    points = _vertices(smooth)
    plain = [replace(shot, gain=1.0) for shot in shots]
    trust, light = np.zeros((2, len(shots), len(points.position)))
    for row, sight in enumerate(sights(smooth, plain)):
        for part in _parts(len(points.position)):
            said = witness(sight, points.position[part], points.normal[part])
            brightness = said.color.mean(axis=1)
            usable = (said.trust > 0.02) & (brightness > 0.05) & (said.color.max(axis=1) < 0.98)
            trust[row, part] = np.where(usable, said.trust, 0)
            light[row, part] = np.log(np.maximum(brightness, 0.05))
    return np.exp(_log_gains(trust, light, np.array([shot.fixed for shot in shots])))


def _log_gains(trust: np.ndarray, light: np.ndarray, fixed: np.ndarray) -> Float[np.ndarray, "shots"]:
    """Minimises sum of w_ij rho(light_i + g_i - light_j - g_j) + pull * g^2; reweighted (Cauchy, scale 0.1)."""
    count, gain = len(trust), np.zeros(len(trust))
    first, second = np.triu_indices(count, 1)
    for _ in range(5):
        matrix, right = np.diag(np.where(fixed, 1e12, 1.0)), np.zeros(count)
        for i, j in zip(first, second, strict=True):
            difference = light[j] - light[i]
            weight = np.sqrt(trust[i] * trust[j]) / (1 + ((difference + gain[j] - gain[i]) / 0.1) ** 2)
            total, pull = weight.sum(), (weight * difference).sum()
            matrix[[i, j], [i, j]] += total
            matrix[[i, j], [j, i]] -= total
            right[i] += pull
            right[j] -= pull
        gain = np.linalg.solve(matrix, right)
    return gain


def _colors(mesh: Mesh, points: Points, views: list[Sight], fill: Fill | None) -> Float32[np.ndarray, "points 3"]:
    """Blended colours; where trust is low, the filling."""
    blend = _blend(points, views)
    low = np.flatnonzero(blend.trust < 20 * DOUBT)
    if fill is not None:
        spare = fill(points.position[low]).astype(np.float32)
    else:
        corners = _blend(_vertices(mesh), views)
        colors = harmonic(mesh, corners.color, corners.trust / (corners.trust + DOUBT))
        spare = np.einsum("pc,pcx->px", points.shares[low], colors[points.corners[low]]).astype(np.float32)
    share = (blend.trust[low] / (blend.trust[low] + DOUBT))[:, None]
    blend.color[low] = share * blend.color[low] + (1 - share) * spare
    return blend.color


def _blend(points: Points, views: list[Sight]) -> Blend:
    parts = in_threads([partial(_blend_part, points, part, views) for part in _parts(len(points.position))])
    color, trust = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return Blend(color, trust)


def _blend_part(points: Points, part: slice, views: list[Sight]) -> tuple[np.ndarray, np.ndarray]:
    position, normal = points.position[part], points.normal[part]
    total, color = np.zeros(len(position), np.float32), np.zeros((len(position), 3), np.float32)
    for view in views:
        said = witness(view, position, normal)
        total += said.trust
        color += said.trust[:, None] * said.color
    return color / np.maximum(total, 1e-12)[:, None], total


def _parts(count: int) -> list[slice]:
    return [slice(start, start + CHUNK) for start in range(0, count, CHUNK)]


def _points(mesh: Mesh, face: Int[np.ndarray, "points"], shares: Float32[np.ndarray, "points 3"]) -> Points:
    assert mesh.normals is not None
    corners = mesh.faces[face]
    position, normal = (
        np.add.reduce([shares[:, corner, None] * values[corners[:, corner]] for corner in range(3)])
        for values in (mesh.vertices, mesh.normals)
    )
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return Points(position, normal, corners, shares)


def _vertices(mesh: Mesh) -> Points:
    assert mesh.normals is not None
    own = np.repeat(np.arange(len(mesh.vertices))[:, None], 3, axis=1)
    return Points(mesh.vertices, mesh.normals, own, np.full(own.shape, 1 / 3, np.float32))
