"""Meshes into views: each camera of a rig sees colour, depth and normals of the mesh under one light."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from jaxtyping import Float

from mv3d_cli.kernels.runtime import in_threads
from mv3d_cli.kernels.shade import Light, draw, lights, model
from mv3d_cli.scene.camera import Camera, Orthographic, look_at_origin
from mv3d_cli.scene.conventions import RIG_RADIUS
from mv3d_cli.scene.mesh import Mesh
from mv3d_cli.scene.views import View, Views


def sun_camera(direction: Float[np.ndarray, "3"]) -> Camera:
    """The parallel camera that sees the unit sphere from the sun."""
    x, y, z = RIG_RADIUS * direction / np.linalg.norm(direction)
    return look_at_origin("sun", (x, y, z), Orthographic())


def render(mesh: Mesh, cameras: Sequence[Camera], size: int, light: Light | None, *, device: str = "cpu") -> Views:
    """Square views of `size` pixels of a mesh that lies in the unit sphere; without a light, of its albedo."""
    looks = model(mesh, device)
    lit = lights(light, looks, sun_camera(light.sun_direction) if light is not None else None)

    def view(camera: Camera) -> View:
        picture = draw(looks, lit, camera, size, size)
        return View(camera, picture.color, picture.depth, picture.normal)

    if device != "cpu":
        return Views(tuple(view(camera) for camera in cameras))
    return Views(tuple(in_threads([partial(view, camera) for camera in cameras])))
