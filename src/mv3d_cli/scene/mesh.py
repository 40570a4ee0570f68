"""Meshes: triangles with materials. Axes, uv and colour as in `conventions`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Float32, Int32, UInt8

Wrap = Literal["repeat", "clamp", "mirror"]
AlphaMode = Literal["opaque", "mask", "blend"]


@dataclass(frozen=True)
class Texture:
    """An sRGB picture with straight alpha, and how uv outside [0, 1] find their texel."""

    pixels: UInt8[np.ndarray, "height width 4"]
    wrap_u: Wrap = "repeat"
    wrap_v: Wrap = "repeat"


@dataclass(frozen=True)
class Material:
    """Surface colour = base_color (linear RGBA factor) * texture * vertex colour."""

    base_color: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    texture: Texture | None = None
    alpha_mode: AlphaMode = "opaque"
    alpha_cutoff: float = 0.5
    roughness: float = 1.0
    metallic: float = 0.0
    name: str = ""


@dataclass(frozen=True)
class Mesh:
    """Triangles; attributes belong to vertices, materials to faces. Counter-clockwise faces look outwards.

    normals  unit shading normals; None: the faces are flat
    uvs      texture coordinates; None: no material has a texture
    colors   linear RGBA in [0, 1]; None: white
    """

    vertices: Float32[np.ndarray, "vertices 3"]
    faces: Int32[np.ndarray, "faces 3"]
    face_material: Int32[np.ndarray, "faces"]
    materials: tuple[Material, ...]
    normals: Float32[np.ndarray, "vertices 3"] | None = None
    uvs: Float32[np.ndarray, "vertices 2"] | None = None
    colors: Float32[np.ndarray, "vertices 4"] | None = None


def transform(mesh: Mesh, b_from_a: Float[np.ndarray, "4 4"]) -> Mesh:
    """The mesh moved by an affine map; normals by its inverse transpose; mirrored maps keep faces outwards."""
    linear = b_from_a[:3, :3]
    vertices = (mesh.vertices @ linear.T + b_from_a[:3, 3]).astype(np.float32)
    determinant = np.linalg.det(linear)
    faces = mesh.faces[:, ::-1].copy() if determinant < 0 else mesh.faces
    normals = mesh.normals
    if normals is not None and determinant != 0:
        turned = normals @ np.linalg.inv(linear)
        normals = (turned / np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-12)).astype(np.float32)
    return replace(mesh, vertices=vertices, faces=faces, normals=normals)


def unit_sphere_from_mesh(mesh: Mesh) -> Float[np.ndarray, "4 4"]:
    """The similarity that centres the bounding box of the vertices in use and brings the farthest to radius 1."""
    used = mesh.vertices[np.unique(mesh.faces)].astype(np.float64)
    centre = (used.min(axis=0) + used.max(axis=0)) / 2
    scale = 1 / np.linalg.norm(used - centre, axis=1).max()
    similarity = np.diag([scale, scale, scale, 1.0])
    similarity[:3, 3] = -scale * centre
    return similarity


def face_normals(mesh: Mesh) -> Float[np.ndarray, "faces 3"]:
    """Unit normals of the faces (zero where a face has no area)."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]].astype(np.float64) for i in range(3))
    cross = np.cross(b - a, c - a)
    return cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-300)
