"""Meshes into views by Blender's path tracer Cycles: the same rig, light and pictures as `rendering`.

Colour is taken over the pixel's area, depth and normals at its centre, as `rendering` does; so each view is traced
twice: with a box filter of one pixel, and with one sample through a filter too narrow to leave the centre.
Linear colour is read back and turned to sRGB here: what is white to `rendering` is white to Blender.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8

from mv3d_cli.capture.blender.scene import add_eye, add_light, add_mesh, aim
from mv3d_cli.errors import MissingDependency, WorkFailed
from mv3d_cli.kernels.runtime import discarded, threads
from mv3d_cli.kernels.shade import Light
from mv3d_cli.scene.camera import Camera
from mv3d_cli.scene.conventions import bytes_from_normal, srgb_from_linear
from mv3d_cli.scene.mesh import Mesh
from mv3d_cli.scene.views import View, Views

Channels = dict[str, Float32[np.ndarray, "height width"]]

FAR = 1e9
"""Cycles writes 1e10 as the depth of nothing."""


def render(mesh: Mesh, cameras: Sequence[Camera], size: int, light: Light | None, *, samples: int = 32) -> Views:
    """Square views of `size` pixels of a mesh that lies in the unit sphere; without a light, of its albedo.

    Raises MissingDependency without the package `bpy`, WorkFailed when Blender gives up.
    """
    with discarded(1), TemporaryDirectory(prefix="mv3d-blender-") as folder:
        bpy = _blender()
        try:
            bpy.ops.wm.read_factory_settings(use_empty=True)
            _settings(bpy.context.scene, size, Path(folder) / "view.exr")
            add_mesh(bpy, mesh, light)
            if light is not None:
                add_light(bpy, light)
            return Views(_trace(bpy, cameras, samples, bounces=0 if light is None else 4))
        except RuntimeError as error:
            raise WorkFailed(f"Blender could not render: {error}", "try --engine raster") from error
        finally:
            bpy.ops.wm.read_factory_settings(use_empty=True)


def _blender() -> Any:
    try:
        return importlib.import_module("bpy")
    except ImportError:
        raise MissingDependency(
            "the package bpy (Blender) is not installed",
            "pip install 'mv3d-cli[blender]'; bpy 4.2.0 needs Python 3.11, yours is "
            f"{sys.version_info.major}.{sys.version_info.minor}; or try --engine raster",
        ) from None


def _settings(scene: Any, size: int, path: Path) -> None:
    """What all pictures share: size, passes, reproducibility, and the file that they are read back from."""
    frame, tracer, layer = scene.render, scene.cycles, scene.view_layers[0]
    frame.engine, tracer.device = "CYCLES", "CPU"
    frame.resolution_x = frame.resolution_y = size
    frame.resolution_percentage = 100
    frame.film_transparent = True
    frame.use_persistent_data = True
    frame.threads_mode, frame.threads = "FIXED", threads()
    frame.filepath = str(path)
    frame.image_settings.file_format, frame.image_settings.color_depth = "OPEN_EXR_MULTILAYER", "32"
    layer.use_pass_z = layer.use_pass_normal = True
    tracer.seed = 0
    tracer.use_denoising = tracer.use_adaptive_sampling = False
    tracer.transparent_max_bounces = 256


def _trace(bpy: Any, cameras: Sequence[Camera], samples: int, bounces: int) -> tuple[View, ...]:
    """The views: first all colours, then all depths and normals, for Blender keeps what does not change."""
    scene, eye = bpy.context.scene, add_eye(bpy)
    tracer = scene.cycles
    tracer.max_bounces = tracer.diffuse_bounces = bounces
    tracer.pixel_filter_type, tracer.samples = "BOX", samples
    colors = [_color(_shot(bpy, scene, eye, camera)) for camera in cameras]
    tracer.max_bounces = 0
    tracer.pixel_filter_type, tracer.filter_width, tracer.samples = "GAUSSIAN", 0.01, 1
    shots = [_shot(bpy, scene, eye, camera) for camera in cameras]
    return tuple(
        View(camera, color, _depth(shot), _normal(shot, camera))
        for camera, color, shot in zip(cameras, colors, shots, strict=True)
    )


def _shot(bpy: Any, scene: Any, eye: Any, camera: Camera) -> Channels:
    """One picture's channels by their short names: Combined.R, Depth.Z, Normal.X ..."""
    import OpenEXR

    aim(scene, eye, camera)
    bpy.ops.render.render(write_still=True)
    with OpenEXR.File(scene.render.filepath, separate_channels=True) as file:
        return {
            name.partition(".")[2]: np.array(channel.pixels, np.float32)
            for name, channel in file.parts[0].channels.items()
        }


def _color(shot: Channels) -> UInt8[np.ndarray, "height width 4"]:
    """sRGB with straight alpha from linear, premultiplied channels."""
    alpha = shot["Combined.A"].clip(0, 1)[..., None]
    linear = np.stack([shot[f"Combined.{c}"] for c in "RGB"], axis=-1)
    straight = np.where(alpha > 0, linear / np.maximum(alpha, 1e-6), 0).clip(0, 1)
    return np.round(np.concatenate([srgb_from_linear(straight), alpha], axis=-1) * 255).astype(np.uint8)


def _depth(shot: Channels) -> Float32[np.ndarray, "height width"]:
    """Planar z; Cycles measures along the viewing axis, not along the ray."""
    return np.where(shot["Depth.Z"] < FAR, shot["Depth.Z"], np.float32(0))


def _normal(shot: Channels, camera: Camera) -> UInt8[np.ndarray, "height width 3"]:
    """Shading normals, from the world's axes to the viewer's."""
    world = np.stack([shot[f"Normal.{axis}"] for axis in "XYZ"], axis=-1)
    viewed = world @ camera.world_from_camera[:3, :3] * np.array([1, -1, -1])
    return bytes_from_normal(viewed.astype(np.float32))
