"""Blender's pictures against our rasteriser's: two programs, one rig, one light, one answer."""

from __future__ import annotations

import importlib.util
import subprocess
import sys

import numpy as np
import pytest
import trimesh

from mv3d_cli.capture import blender, rendering
from mv3d_cli.capture.blender.scene import SKY_ROWS, sky_of
from mv3d_cli.capture.lighting import COSINE_OVER_PI, ambient_from_lamps, harmonics, studio
from mv3d_cli.capture.shapes import procedural_mesh
from mv3d_cli.errors import MissingDependency
from mv3d_cli.kernels.shade import Picture
from mv3d_cli.scene.camera import Orthographic, Perspective, direction_on_sphere, look_at_origin
from mv3d_cli.scene.conventions import normal_from_bytes
from mv3d_cli.scene.mesh import Material, Mesh, Texture, transform, unit_sphere_from_mesh
from mv3d_cli.scene.views import View, Views

needs_blender = pytest.mark.skipif(
    importlib.util.find_spec("bpy") is None, reason="Blender's package bpy is not installed"
)
SIZE = 64
CAMERAS = (
    look_at_origin("orthographic", direction_on_sphere(0.4, 0.5), Orthographic(1.1)),
    look_at_origin("perspective", direction_on_sphere(-1.0, 0.2, 2.5), Perspective((1.1, 1.3), (0.45, 0.56))),
    look_at_origin("top", (0.0, 0.0, 2.0), Orthographic()),
)
FRONT = look_at_origin("front", (0.0, -2.0, 0.0), Orthographic())


def egg() -> Mesh:
    """A smooth, stretched sphere with its normals."""
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=0.8)
    sphere.apply_transform(np.diag([0.7, 1.0, 1.1, 1.0]))
    faces = sphere.faces.astype(np.int32)
    material = Material(base_color=(0.8, 0.5, 0.3, 1.0))
    return Mesh(
        sphere.vertices.astype(np.float32),
        faces,
        np.zeros(len(faces), np.int32),
        (material,),
        normals=np.array(sphere.vertex_normals, np.float32),
    )


def quad(x: float, material: Material, index: int) -> tuple[np.ndarray, ...]:
    """Vertices, faces, uvs and face materials of an upright strip that shows uv in [-0.3, 1.3]."""
    corners = np.array([[x, 0, -0.6], [x + 0.4, 0, -0.6], [x + 0.4, 0, 0.6], [x, 0, 0.6]], np.float32)
    uvs = np.array([[-0.3, 1.3], [1.3, 1.3], [1.3, -0.3], [-0.3, -0.3]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32) + 4 * index
    return corners, faces, uvs, np.full(2, index, np.int32)


def strips() -> Mesh:
    """Five strips of one smooth picture: every way to wrap, vertex colours, a base colour, an alpha test."""
    v, u = np.mgrid[0:64, 0:64] / 64
    waves = np.stack([np.sin(2 * np.pi * u), np.cos(2 * np.pi * v), np.sin(2 * np.pi * (u + v))], axis=-1)
    hole = np.where(np.hypot(u - 0.5, v - 0.5) < 0.3, 60, 255)[..., None]
    pixels = np.concatenate([150 + 60 * waves, hole], axis=-1).astype(np.uint8)
    materials = (
        Material(texture=Texture(pixels)),
        Material(texture=Texture(pixels, "clamp", "clamp"), base_color=(0.9, 0.5, 0.7, 1.0)),
        Material(texture=Texture(pixels, "mirror", "mirror"), alpha_mode="mask", alpha_cutoff=0.4),
        Material(texture=Texture(pixels, "mirror", "clamp"), alpha_mode="blend"),
        Material(texture=Texture(pixels, "clamp", "repeat")),
    )
    parts = [quad(-1 + 0.4 * i, material, i) for i, material in enumerate(materials)]
    vertices, faces, uvs, face_material = (np.concatenate(column) for column in zip(*parts, strict=True))
    colors = np.ones((len(vertices), 4), np.float32)
    colors[:, 1] = np.linspace(0.4, 1.0, len(vertices))
    return Mesh(vertices, faces, face_material, materials, uvs=uvs, colors=colors)


def pictures(view: View) -> Picture:
    """What a view that lacks nothing holds."""
    assert view.color is not None
    assert view.depth is not None
    assert view.normal is not None
    return Picture(view.color, view.depth, view.normal)


def interior(depth: np.ndarray) -> np.ndarray:
    """Pixels with a surface all around them."""
    seen = depth > 0
    inner = seen.copy()
    for axis in (0, 1):
        for step in (-1, 1):
            inner &= np.roll(seen, step, axis)
    return inner


def degrees_between(a: Picture, b: Picture) -> np.ndarray:
    cosine = (normal_from_bytes(a.normal) * normal_from_bytes(b.normal)).sum(-1)
    return np.degrees(np.arccos(cosine.clip(-1, 1)))


@pytest.fixture(scope="module")
def lit_pair() -> tuple[Views, Views]:
    """The egg under the studio light, by Blender and by us."""
    light = studio()
    return blender.render(egg(), CAMERAS, SIZE, light, samples=16), rendering.render(egg(), CAMERAS, SIZE, light)


@needs_blender
@pytest.mark.parametrize("index", range(len(CAMERAS)), ids=[camera.name for camera in CAMERAS])
def test_geometry_agrees(lit_pair: tuple[Views, Views], index: int) -> None:
    theirs, ours = (pictures(views.frames[index]) for views in lit_pair)
    assert ((theirs.depth > 0) == (ours.depth > 0)).mean() > 0.999
    inner = interior(ours.depth) & (theirs.depth > 0)
    assert inner.sum() > 1000
    assert np.abs(theirs.depth - ours.depth)[inner].max() < 2e-3
    assert degrees_between(theirs, ours)[inner].max() < 2


@needs_blender
@pytest.mark.parametrize("index", range(len(CAMERAS)), ids=[camera.name for camera in CAMERAS])
def test_light_agrees(lit_pair: tuple[Views, Views], index: int) -> None:
    theirs, ours = (pictures(views.frames[index]) for views in lit_pair)
    difference = (theirs.color.astype(float) - ours.color)[interior(ours.depth)][:, :3] / 255
    assert np.abs(difference).mean() < 0.02
    assert np.abs(difference.mean()) < 0.006
    assert ours.color[interior(ours.depth)][:, 0].std() > 8  # there is shading to agree on


@needs_blender
def test_albedo_agrees_with_textures_and_cutouts() -> None:
    size = 5 * 32
    theirs = pictures(blender.render(strips(), [FRONT], size, None, samples=16).frames[0])
    ours = pictures(rendering.render(strips(), [FRONT], size, None).frames[0])
    both = (theirs.color[..., 3] == 255) & (ours.color[..., 3] == 255) & interior(ours.depth)
    both &= np.abs(np.arange(size) % 32 - 15.5) < 15  # but where strips meet
    assert both.sum() > 10_000
    assert np.abs(theirs.color.astype(int) - ours.color)[both].max() <= 2
    coverage = [found.color[..., 3].mean(axis=0).reshape(5, 32).mean(axis=1) for found in (theirs, ours)]
    assert coverage[1].min() < 0.9 * coverage[1].max()  # some strips have holes
    assert np.abs(coverage[0] - coverage[1]).max() < 3


@needs_blender
def test_an_object_of_many_parts_and_the_same_bytes_twice() -> None:
    mesh = procedural_mesh(3)
    mesh = transform(mesh, unit_sphere_from_mesh(mesh))
    first, second = (pictures(blender.render(mesh, CAMERAS[:1], SIZE, studio(), samples=4).frames[0]) for _ in range(2))
    ours = pictures(rendering.render(mesh, CAMERAS[:1], SIZE, studio()).frames[0])
    assert np.array_equal(first.color, second.color)
    assert np.array_equal(first.depth, second.depth)
    assert np.array_equal(first.normal, second.normal)
    error = np.abs(first.depth - ours.depth)[interior(ours.depth) & (first.depth > 0)]
    assert np.mean(error < 2e-3) > 0.98  # the rest lies where one part ends before another


@needs_blender
def test_blender_says_nothing_on_stdout() -> None:
    program = """
import numpy as np
from mv3d_cli.capture import blender
from mv3d_cli.scene.camera import Orthographic, look_at_origin
from mv3d_cli.scene.mesh import Material, Mesh
corners = np.float32([[-1, 0, -1], [1, 0, -1], [0, 0, 1]])
mesh = Mesh(corners, np.int32([[0, 1, 2], [1, 1, 2]]), np.int32([0, 0]), (Material(),))
camera = look_at_origin("front", (0.0, -2.0, 0.0), Orthographic())
print("before")
views = blender.render(mesh, [camera], 8, None, samples=1)
print("after", int(views.frames[0].depth[4, 4]))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "before\nafter 2\n"


def test_without_blender_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "bpy", None)
    with pytest.raises(MissingDependency) as caught:
        blender.render(egg(), CAMERAS, SIZE, None)
    assert "pip install 'mv3d-cli[blender]'" in caught.value.hint
    assert "3.11" in caught.value.hint


def test_the_sky_shines_as_the_coefficients_say() -> None:
    """The environment's irradiance / pi, integrated over its pixels, has the coefficients it was made from."""
    lamp = np.array([direction_on_sphere(0.7, 0.6, 1.0)])
    ambient = ambient_from_lamps(lamp, np.array([[0.5, 0.4, 0.3]]), np.full(3, 0.3))
    sky = sky_of(ambient).reshape(-1, 3)
    rows, columns = np.mgrid[0:SKY_ROWS, 0 : 2 * SKY_ROWS] + 0.5
    elevation = ((rows / SKY_ROWS - 0.5) * np.pi).ravel()
    azimuth = ((0.5 - columns / (2 * SKY_ROWS)) * 2 * np.pi).ravel()
    along = np.cos(elevation)
    directions = np.stack([along * np.cos(azimuth), along * np.sin(azimuth), np.sin(elevation)], axis=1)
    area = along[:, None] * (np.pi / SKY_ROWS) ** 2
    found = (harmonics(directions).T @ (area * sky)) * COSINE_OVER_PI[:, None]
    assert sky.min() >= 0
    assert np.abs(found - ambient).max() < 0.02 * ambient.max()
    assert directions[sky[:, 0].argmax()] @ lamp[0] > 0.98
