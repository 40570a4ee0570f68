from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from mv3d_cli.fields.fitting.samples import cameras_of, outside_of, pixels_of, rays_through, seen_by
from mv3d_cli.fields.relief import Relief, reliefs_of
from mv3d_cli.scene.camera import Camera, Orthographic, Perspective, look_at_origin, pixel_from_camera
from mv3d_cli.scene.views import View, Views

RADIUS, SIZE = 0.6, 96
PLACES = ((0.0, -2.0, 0.0), (1.6, 0.4, 1.2))
LENSES = (Orthographic(1.0), Perspective((0.9, 0.9)))


def sphere_view(camera: Camera, *, depth: bool = True) -> View:
    """A view of a sphere whose colours are its world normals."""
    (sx, ox), (sy, oy) = pixel_from_camera(camera, SIZE, SIZE)
    x, y = np.meshgrid((np.arange(SIZE) + 0.5 - ox) / sx, (np.arange(SIZE) + 0.5 - oy) / sy)
    pose = camera.world_from_camera
    flat = np.stack([x, y, 0 * x], axis=-1)
    ahead = np.broadcast_to([0.0, 0, 1], flat.shape)
    pinhole = isinstance(camera.projection, Perspective)
    start, ray = (0 * flat, flat + ahead) if pinhole else (flat, ahead)
    start, ray = start @ pose[:3, :3].T + pose[:3, 3], ray @ pose[:3, :3].T
    a, b, c = (ray**2).sum(-1), (start * ray).sum(-1), (start**2).sum(-1) - RADIUS**2
    hit = b**2 > a * c
    z = np.where(hit, (-b - np.sqrt(np.where(hit, b**2 - a * c, 0))) / a, 0)
    color = np.zeros((SIZE, SIZE, 4), np.uint8)
    color[..., :3] = np.round(((start + z[..., None] * ray) / RADIUS + 1) * 127.5).clip(0, 255)
    color[..., 3] = 255 * hit
    return View(camera, color, z.astype(np.float32) if depth else None)


def sphere_reliefs(*, depth: bool = True) -> tuple[Relief, ...]:
    cameras = [look_at_origin(f"{i}", place, lens) for i, (place, lens) in enumerate(zip(PLACES, LENSES, strict=True))]
    return reliefs_of(Views(tuple(sphere_view(camera, depth=depth) for camera in cameras)))


def test_what_is_seen_of_a_sphere_lies_on_it_and_looks_outwards() -> None:
    seen = seen_by(sphere_reliefs())
    assert len(seen) > 3000
    assert (seen.points.norm(dim=1) - RADIUS).abs().mean() < 2e-3
    cosine = (seen.normals * seen.points).sum(1) / seen.points.norm(dim=1)
    assert cosine.mean() > 0.998
    torch.testing.assert_close(seen.facing, -(seen.normals * seen.rays).sum(1))
    assert seen.facing.min() > 0.1
    for vectors in (seen.normals, seen.rays):
        torch.testing.assert_close(vectors.norm(dim=1), torch.ones(len(seen)))


def test_views_weigh_as_they_are_told() -> None:
    one, other = sphere_reliefs()
    light, heavy = seen_by((one, other)), seen_by((one, replace(other, weight=3.0)))
    first = len(seen_by((one,)))
    assert 0 < first < len(light)
    torch.testing.assert_close(heavy.weight[first:], 3 * light.weight[first:])
    torch.testing.assert_close(heavy.weight[:first], light.weight[:first])


@pytest.mark.parametrize("index", [0, 1])
def test_rays_pass_through_what_projects_to_their_pixels(index: int) -> None:
    reliefs = sphere_reliefs()
    camera = reliefs[index].camera
    points = torch.rand(40, 3, generator=torch.Generator().manual_seed(0)).double().numpy() - 0.5
    local = points @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3]
    z = local[:, 2:]
    scale, offset = pixel_from_camera(camera, SIZE, SIZE).T
    at = local[:, :2] / (z if index else 1) * scale + offset
    rays = rays_through(cameras_of(reliefs), torch.full((40,), index), torch.tensor(at, dtype=torch.float32))
    reached = rays.at(torch.tensor(z, dtype=torch.float32) / rays.forward[:, None])[:, 0]
    torch.testing.assert_close(reached, torch.tensor(points, dtype=torch.float32), atol=1e-5, rtol=0)


def test_outside_is_the_distance_to_the_shadow_of_a_sphere() -> None:
    reliefs = sphere_reliefs()[:1]
    points = 1.6 * torch.rand(300, 3, generator=torch.Generator().manual_seed(0)) - 0.8
    expected = points[:, [0, 2]].norm(dim=1) - RADIUS  # seen along +y
    found = outside_of(points, reliefs, cameras_of(reliefs))
    torch.testing.assert_close(found, expected, atol=1.0 / SIZE * 2, rtol=0)
    both = sphere_reliefs()
    assert (outside_of(points, both, cameras_of(both)) >= found).all()


def test_without_outlines_nothing_is_outside() -> None:
    reliefs = tuple(replace(relief, outline=None) for relief in sphere_reliefs())
    assert (outside_of(torch.zeros(3, 3), reliefs, cameras_of(reliefs)) == -torch.inf).all()


def test_only_views_without_depth_are_rendered() -> None:
    assert len(pixels_of(sphere_reliefs())) == 0
    reliefs = sphere_reliefs(depth=False)
    assert len(seen_by(reliefs)) == 0
    pixels = pixels_of(reliefs)
    assert set(pixels.view.tolist()) == {0, 1}
    first = pixels[pixels.view == 0]
    assert first.inside.sum().item() == pytest.approx(np.pi * (RADIUS * SIZE / 2) ** 2, rel=0.02)
    middle = first.at - SIZE / 2
    apart = middle.norm(dim=1) * 2 / SIZE
    assert first.inside[apart < RADIUS - 0.05].min() == 1
    assert first.inside[apart > RADIUS + 0.05].max() == 0
    solid = apart < RADIUS - 0.1  # colours there are (n + 1) / 2
    torch.testing.assert_close(first.color[solid, 0], (middle[solid, 0] * 2 / SIZE / RADIUS + 1) / 2, atol=0.02, rtol=0)
