"""Baking against surfaces painted by a function of position, drawn by the house's renderer or by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from mv3d_cli.kernels.rasterize import rasterize
from mv3d_cli.meshes.bake import bake, balanced, gains, vertex_colors
from mv3d_cli.meshes.shots import Shot
from mv3d_cli.meshes.surface import mesh_of, with_normals
from mv3d_cli.meshes.unwrap import unwrapped, uv_camera
from mv3d_cli.scene.camera import Camera, Orthographic, Perspective, direction_on_sphere, look_at_origin
from mv3d_cli.scene.conventions import srgb_from_linear
from mv3d_cli.scene.mesh import Mesh, Texture

SIZE = 256
RING = [look_at_origin(f"a{i}", direction_on_sphere(i * np.pi / 4, 0.0), Orthographic()) for i in range(8)]
CAPS = [look_at_origin(f"c{i}", direction_on_sphere(0.3, e), Orthographic()) for i, e in enumerate((1.4, -1.4))]


def paint(points: np.ndarray) -> np.ndarray:
    """sRGB in [0.2, 0.8], smooth, different everywhere."""
    return (0.5 + 0.3 * np.sin(3.0 * points + [0.0, 1.0, 2.0])).astype(np.float32)


def ball(centre: tuple[float, float, float] = (0.0, 0.0, 0.0), radius: float = 0.8) -> Mesh:
    made = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    return with_normals(mesh_of(made.vertices + np.array(centre), made.faces))


def joined(*meshes: Mesh) -> Mesh:
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    faces = np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)])
    return with_normals(mesh_of(np.concatenate([mesh.vertices for mesh in meshes]), faces))


def shoot(mesh: Mesh, camera: Camera, painted=paint, gain: float = 1.0, **how) -> Shot:
    """What the camera sees of a mesh of that paint; black, transparent background."""
    seen = rasterize(mesh.vertices, mesh.faces, [camera], SIZE, SIZE)
    hit = seen.face[0] >= 0
    color = np.zeros((SIZE, SIZE, 4), np.uint8)
    points = np.einsum("pc,pcx->px", seen.barycentric[0][hit], mesh.vertices[mesh.faces[seen.face[0][hit]]])
    color[hit, :3] = np.round(255 * np.clip(gain * painted(points), 0, 1))
    color[hit, 3] = 255
    return Shot(camera, color, **how)


def errors(mesh: Mesh, texture: Texture, painted=paint) -> tuple[np.ndarray, np.ndarray]:
    """Per covered texel: its point, and the greatest difference from the paint."""
    assert mesh.uvs is not None
    size = texture.pixels.shape[0]
    laid = rasterize(np.pad(mesh.uvs, ((0, 0), (0, 1))), mesh.faces, [uv_camera()], size, size)
    hit = laid.face[0] >= 0
    points = np.einsum("pc,pcx->px", laid.barycentric[0][hit], mesh.vertices[mesh.faces[laid.face[0][hit]]])
    return points, np.abs(texture.pixels[hit, :3] / 255 - painted(points)).max(axis=1)


@pytest.fixture(scope="module")
def sphere() -> Mesh:
    return unwrapped(ball(), SIZE)


def test_a_sphere_seen_from_all_sides_gets_its_paint(sphere: Mesh) -> None:
    shots = [shoot(sphere, camera) for camera in RING + CAPS]
    _, error = errors(sphere, bake(sphere, shots, SIZE))
    assert error.mean() < 0.004
    assert error.max() < 0.05


def test_pinholes_are_projected_and_tested_along_their_rays(sphere: Mesh) -> None:
    cameras = [replace(camera, projection=Perspective((1.1, 1.1))) for camera in RING + CAPS]
    _, error = errors(sphere, bake(sphere, [shoot(sphere, camera) for camera in cameras], SIZE))
    assert error.mean() < 0.006
    assert error.max() < 0.1


def test_vertices_get_linear_colours(sphere: Mesh) -> None:
    colored = vertex_colors(ball(), [shoot(sphere, camera) for camera in RING + CAPS])
    assert colored.colors is not None
    assert np.abs(srgb_from_linear(colored.colors[:, :3]) - paint(colored.vertices)).max() < 0.05
    assert (colored.colors[:, 3] == 1).all()


def test_what_stands_behind_does_not_take_the_colour_of_what_stands_before() -> None:
    near, far = ball((0.0, -0.5, 0.0), 0.25), ball((0.0, 0.35, 0.0), 0.5)

    def two_paints(points: np.ndarray) -> np.ndarray:
        return np.where(points[:, 1:2] < -0.2, [[0.9, 0.1, 0.1]], [[0.1, 0.2, 0.9]]).astype(np.float32)

    mesh = unwrapped(joined(near, far), SIZE)
    shots = [shoot(mesh, camera, two_paints) for camera in RING[:3] + RING[-2:]]
    points, error = errors(mesh, bake(mesh, shots, SIZE), two_paints)
    covered = (points[:, 1] > -0.2) & (points[:, 1] < 0.3)
    assert covered.sum() > 500
    assert error[covered].max() < 0.1


def test_the_background_never_bleeds(sphere: Mesh) -> None:
    def plain(points: np.ndarray) -> np.ndarray:
        return np.full((len(points), 3), 0.7, np.float32)

    shots = [shoot(sphere, camera, plain) for camera in RING]
    for color in (shot.color for shot in shots):
        color[color[..., 3] == 0] = [0, 255, 0, 0]
    texture = bake(sphere, shots, SIZE)
    assert np.abs(texture.pixels[..., :3].astype(int) - round(0.7 * 255)).max() <= 2  # the atlas's gaps as well
    assert (texture.pixels[..., 3] == 255).all()


def test_unseen_texels_are_filled_by_the_callable(sphere: Mesh) -> None:
    texture = bake(sphere, [shoot(sphere, RING[0])], SIZE, lambda points: 1 - paint(points))
    points, error = errors(sphere, texture)
    _, against = errors(sphere, texture, lambda points: 1 - paint(points))
    assert error[points[:, 1] < -0.4].max() < 0.05
    assert against[points[:, 1] > 0.05].max() < 0.01


def test_unseen_surface_takes_the_colours_around_it_and_not_those_beside_it_in_space() -> None:
    """Two balls, red and blue; the sides that face each other are unseen and stay red and blue."""
    left, right = ball((-0.41, 0.0, 0.0), 0.4), ball((0.41, 0.0, 0.0), 0.4)

    def two_paints(points: np.ndarray) -> np.ndarray:
        return np.where(points[:, :1] < 0, [[0.9, 0.1, 0.1]], [[0.1, 0.2, 0.9]]).astype(np.float32)

    mesh = unwrapped(joined(left, right), SIZE)
    shots = [shoot(mesh, camera, two_paints) for camera in (RING[2], RING[6])]
    _, error = errors(mesh, bake(mesh, shots, SIZE), two_paints)
    assert error.max() < 0.02


def test_warped_pictures_are_read_where_they_say(sphere: Mesh) -> None:
    def moved(camera: Camera) -> Shot:
        shot = shoot(sphere, camera)

        def pixel_of(points: np.ndarray) -> np.ndarray:
            inside = points @ camera.camera_from_world[:3, :3].T
            return SIZE / 2 * (inside[:, :2] + 1) + [6.0, -4.0]

        return replace(shot, color=np.roll(shot.color, (-4, 6), axis=(0, 1)), pixel_of=pixel_of)

    shots = [moved(camera) for camera in RING + CAPS]
    _, right = errors(sphere, bake(sphere, shots, SIZE))
    _, wrong = errors(sphere, bake(sphere, [replace(shot, pixel_of=None) for shot in shots], SIZE))
    assert right.mean() < 0.006
    assert wrong.mean() > 4 * right.mean()


def test_gains_are_recovered_and_photos_hold_still(sphere: Mesh) -> None:
    true = np.array([1.0, 0.92, 1.08, 1.05, 0.95, 1.1, 0.9, 1.02])
    shots = [
        shoot(sphere, camera, gain=gain, fixed=index == 0)
        for index, (camera, gain) in enumerate(zip(RING, true, strict=True))
    ]
    assert gains(sphere, shots)[0] == pytest.approx(1, abs=1e-6)
    assert np.abs(gains(sphere, shots) * true - 1).max() < 0.02
    free = gains(sphere, [replace(shot, fixed=False) for shot in shots]) * true
    assert free.std() < 0.01
    _, before = errors(sphere, bake(sphere, shots, SIZE))
    _, after = errors(sphere, bake(sphere, balanced(sphere, shots), SIZE))
    assert after.mean() < 0.5 * before.mean()


def grey(level: float):
    return lambda points: np.full((len(points), 3), level, np.float32)


def test_weight_decides_between_pictures_that_contradict_each_other(sphere: Mesh) -> None:
    shots = [shoot(sphere, RING[0], grey(level), weight=weight) for level, weight in ((0.2, 0.01), (0.8, 1.0))]
    points, error = errors(sphere, bake(sphere, shots, SIZE), grey(0.8))
    assert error[points[:, 1] < -0.4].max() < 0.02


def test_no_shot_at_all_gives_grey_and_the_same_input_the_same_bytes(sphere: Mesh) -> None:
    assert np.isin(bake(sphere, [], 64).pixels[..., :3], [127, 128]).all()
    shots = [shoot(sphere, camera) for camera in RING[:3]]
    assert bake(sphere, shots, SIZE).pixels.tobytes() == bake(sphere, shots, SIZE).pixels.tobytes()
