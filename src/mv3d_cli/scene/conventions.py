"""Axes, units and colour space, stated once; every docstring in the house relies on this page.

world    right-handed, +Z up; the object's front faces -Y; its bounding box is centred on the origin and its
         farthest vertex lies at radius 1 (a *scene unit*).
camera   OpenCV axes: x right, y down, z forward. Transforms are named `b_from_a` and act on columns.
pixel    the centre of (row, column) is (column + 0.5, row + 0.5).
depth    planar z in scene units, float32; 0 where there is no surface.
normal   camera frame as a normal map is read: x right, y up, z towards the viewer; 8 bits, (n + 1) * 127.5.
colour   sRGB, 8 bits, straight alpha. Shading and filtering happen in linear light, premultiplied.
uv       (0, 0) is the upper left corner of the texture (as in glTF), v runs down.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8

RIG_RADIUS = 2.0
"""Distance of the rig's cameras from the origin, in scene units."""

# glTF: +Y up, front +Z  ->  ours: +Z up, front -Y
WORLD_FROM_Y_UP = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]], dtype=np.float64)
Y_UP_FROM_WORLD = WORLD_FROM_Y_UP.T.copy()

# OpenCV camera axes <-> the y-up, z-backwards camera of OpenGL, Blender and nerfstudio
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def linear_from_srgb(value: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Linear light from sRGB, both in [0, 1] (IEC 61966-2-1)."""
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4).astype(value.dtype)


def srgb_from_linear(value: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """sRGB from linear light, both in [0, 1]: the inverse of `linear_from_srgb`."""
    curve = 1.055 * np.maximum(value, 0.0031308) ** (1 / 2.4) - 0.055
    return np.where(value <= 0.0031308, value * 12.92, curve).astype(value.dtype)


def bytes_from_normal(normal: Float[np.ndarray, "*shape 3"]) -> UInt8[np.ndarray, "*shape 3"]:
    """A normal map's bytes from unit normals in [-1, 1] (viewer's axes)."""
    return np.round((normal + 1) * 127.5).clip(0, 255).astype(np.uint8)


def normal_from_bytes(pixels: UInt8[np.ndarray, "*shape 3"]) -> Float[np.ndarray, "*shape 3"]:
    """Unit normals (viewer's axes) from a normal map's bytes: the inverse of `bytes_from_normal`."""
    normal = pixels.astype(np.float32) / 127.5 - 1
    return normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)
