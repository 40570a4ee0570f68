"""Shading: a mesh's looks and lights brought to a device, and z-buffers turned into colour, depth and normals."""

# Warp's type stubs are narrower than Warp:
# pyright: reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false, reportOperatorIssue=false

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
import warp as wp
from jaxtyping import Float, UInt8

from mv3d_cli.kernels.rasterize import Triangles, block_of, eye_of, eyes_of, new_words, triangles, z_buffer
from mv3d_cli.kernels.rasterize import warp_kernels as raster
from mv3d_cli.kernels.runtime import empty, load
from mv3d_cli.kernels.shade import warp_kernels as source
from mv3d_cli.kernels.texture import CLAMP, MIRROR, REPEAT, Texels
from mv3d_cli.scene.camera import Camera
from mv3d_cli.scene.conventions import linear_from_srgb, srgb_from_linear
from mv3d_cli.scene.mesh import Material, Mesh, Texture

WRAP = {"repeat": REPEAT, "clamp": CLAMP, "mirror": MIRROR}


@dataclass(frozen=True)
class Light:
    """What lights an object. Linear RGB; `ambient` (9, 3) is irradiance / pi in spherical harmonics of degree 2.

    sun_direction  unit vector from the object towards the sun, world axes
    softness       blur of the shadow's edge, scene units
    specular       strength of the highlight, 0 = none
    """

    ambient: Float[np.ndarray, "9 3"]
    sun_direction: Float[np.ndarray, "3"]
    sun_color: Float[np.ndarray, "3"]
    softness: float = 0.008
    specular: float = 0.0


@dataclass(frozen=True)
class Model:
    """A mesh on a device, ready to be drawn."""

    triangles: Triangles
    surface: source.Surface


@cache
def linear_table() -> Float[np.ndarray, "256"]:
    return linear_from_srgb(np.arange(256, dtype=np.float32) / 255)


@cache
def _code_table() -> UInt8[np.ndarray, "16384"]:
    return np.round(srgb_from_linear(np.linspace(0, 1, int(source.CODE_STEPS) + 1)) * 255).astype(np.uint8)


@cache
def _codes(device: str) -> wp.array:
    return wp.array(_code_table(), dtype=wp.uint8, device=device)


def mip_levels(pixels: UInt8[np.ndarray, "height width 4"]) -> list[UInt8[np.ndarray, "_h _w 4"]]:
    """The picture at full size, half, quarter ... one texel; each averaged in linear light."""
    table = np.round(linear_table() * 65535)
    tables = np.stack([table, table, table, np.arange(256) * 257.0], axis=-1).astype(np.uint16)
    linear = cv2.LUT(pixels, tables.reshape(1, 256, 4))
    levels = [pixels]
    while max(linear.shape[:2]) > 1:
        height, width = linear.shape[:2]
        linear = cv2.resize(linear, (max(width // 2, 1), max(height // 2, 1)), interpolation=cv2.INTER_AREA)
        rgb = _code_table()[linear[..., :3] >> 2]
        levels.append(np.dstack([rgb, (linear[..., 3] >> 8).astype(np.uint8)]))
    return levels


def _texels(textures: list[Texture], device: str) -> Texels:
    """All levels of all textures in one buffer."""
    pages, places, parts, offset = [], [], [], 0
    for texture in textures:
        levels = mip_levels(np.ascontiguousarray(texture.pixels))
        pages.append((len(places), len(levels), WRAP[texture.wrap_u], WRAP[texture.wrap_v]))
        for level in levels:
            places.append((offset, level.shape[1], level.shape[0], 0))
            parts.append(level.reshape(-1, 4).view(np.uint32)[:, 0])
            offset += len(parts[-1])
    texels = Texels()
    texels.words = wp.array(np.concatenate(parts) if parts else np.zeros(0, np.uint32), dtype=wp.uint32, device=device)
    texels.levels = wp.array(np.array(places, np.int32).reshape(-1, 4), dtype=wp.vec4i, device=device)
    texels.pages = wp.array(np.array(pages, np.int32).reshape(-1, 4), dtype=wp.vec4i, device=device)
    texels.linear = wp.array(linear_table(), dtype=wp.float32, device=device)
    return texels


def _texture_pages(materials: tuple[Material, ...]) -> tuple[list[Texture], list[int]]:
    """The distinct textures, and each material's index among them (-1 = none)."""
    textures: list[Texture] = []
    index: dict[int, int] = {}
    pages = []
    for material in materials:
        if material.texture is None:
            pages.append(-1)
            continue
        key = id(material.texture)
        if key not in index:
            index[key] = len(textures)
            textures.append(material.texture)
        pages.append(index[key])
    return textures, pages


def _cutouts(mesh: Mesh, surface: source.Surface, pages: list[int], device: str) -> raster.Cutouts:
    """Alpha tests of the faces whose texture has transparent texels; blended ones are tested at one half."""
    cutouts = raster.Cutouts()
    cutoff = np.zeros(len(mesh.materials), np.float32)
    for i, material in enumerate(mesh.materials):
        texture = material.texture
        if material.alpha_mode != "opaque" and texture is not None and texture.pixels[..., 3].min() < 255:
            factor = max(material.base_color[3], 1e-3) if material.alpha_mode == "mask" else 1.0
            cutoff[i] = (material.alpha_cutoff if material.alpha_mode == "mask" else 0.5) / factor
    if cutoff.any():
        cutouts.cutoff = wp.array(cutoff[mesh.face_material], dtype=wp.float32, device=device)
        cutouts.uvs = surface.uvs
        cutouts.texture = wp.array(np.array(pages, np.int32)[mesh.face_material], dtype=wp.int32, device=device)
        cutouts.texels = surface.texels
    return cutouts


def model(mesh: Mesh, device: str = "cpu") -> Model:
    """The mesh, its textures and their mip levels, brought to `device` ("cpu" or "cuda:0")."""
    load(raster, device)
    load(source, device)
    textures, pages = _texture_pages(mesh.materials if mesh.uvs is not None else ())
    pages = pages or [-1] * len(mesh.materials)
    surface = source.Surface()
    if mesh.normals is not None:
        surface.normals = wp.array(mesh.normals, dtype=wp.vec3, device=device)
    if mesh.uvs is not None:
        surface.uvs = wp.array(mesh.uvs, dtype=wp.vec2, device=device)
    if mesh.colors is not None:
        surface.colors = wp.array(mesh.colors, dtype=wp.vec4, device=device)
    surface.face_material = wp.array(mesh.face_material, dtype=wp.int32, device=device)
    base = np.array([material.base_color for material in mesh.materials], np.float32)
    surface.base_color = wp.array(base, dtype=wp.vec4, device=device)
    surface.texture = wp.array(np.array(pages, np.int32), dtype=wp.int32, device=device)
    gloss = np.array([1 - material.roughness for material in mesh.materials], np.float32)
    surface.gloss = wp.array(gloss, dtype=wp.float32, device=device)
    surface.texels = _texels(textures, device)
    cutouts = _cutouts(mesh, surface, pages, device)
    return Model(triangles(mesh.vertices, mesh.faces, cutouts, device), surface)


def lights(light: Light | None, mesh: Model, sun: Camera | None, shadow_size: int = 512) -> source.Lights:
    """The lights as kernels read them, with the shadow map that the camera `sun` sees; None: albedo only."""
    device = mesh.triangles.device
    packed = source.Lights()
    if light is None or sun is None:
        return packed
    packed.lit = 1
    packed.ambient = wp.array(light.ambient.astype(np.float32), dtype=wp.vec3, device=device)
    packed.sun_direction = wp.vec3(*light.sun_direction.tolist())
    packed.sun_color = wp.vec3(*light.sun_color.tolist())
    packed.specular = light.specular
    packed.shadow_softness = light.softness * shadow_size / 2
    packed.shadow_eye = eye_of(sun, shadow_size, shadow_size)
    packed.shadow_words = new_words(shadow_size, shadow_size, device)
    z_buffer(mesh.triangles, eyes_of([sun], shadow_size, shadow_size, device), 0, packed.shadow_words)
    return packed


@dataclass(frozen=True)
class Picture:
    """One view as drawn, on the host: see `scene.views.View`."""

    color: UInt8[np.ndarray, "height width 4"]
    depth: Float[np.ndarray, "height width"]
    normal: UInt8[np.ndarray, "height width 3"]


SAMPLES = 2  # z-buffer samples a pixel, along each side


def draw(mesh: Model, lit: source.Lights, camera: Camera, width: int, height: int) -> Picture:
    """One view of the model: colour with 2x2 samples a pixel, depth and normals at pixel centres."""
    device = mesh.triangles.device
    color = empty((height, width), dtype=wp.uint32, device=device)
    depth = empty((height, width), dtype=wp.float32, device=device)
    normal = empty((height, width, 3), dtype=wp.uint8, device=device)
    place = (mesh.triangles.vertices, mesh.triangles.faces)
    block = block_of(device)

    eyes = eyes_of([camera], width * SAMPLES, height * SAMPLES, device)
    words = new_words(height * SAMPLES, width * SAMPLES, device)
    screen = z_buffer(mesh.triangles, eyes, 0, words)
    given = [eyes, 0, block, *place, screen, words, mesh.surface, lit, _codes(device), color]
    wp.launch(source.color, (height, -(-width // block)), given, device=device)

    eyes = eyes_of([camera], width, height, device)
    words = new_words(height, width, device)
    screen = z_buffer(mesh.triangles, eyes, 0, words)
    given = [eyes, 0, block, *place, screen, words, mesh.surface, depth, normal]
    wp.launch(source.geometry, (height, -(-width // block)), given, device=device)
    return Picture(color.numpy().view(np.uint8).reshape(height, width, 4), depth.numpy(), normal.numpy())
