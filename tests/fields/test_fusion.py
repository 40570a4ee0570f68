"""Fusions of exact views against the shape that was seen: its distances, its volume; and views that cannot be fused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from mv3d_cli.errors import BadViews
from mv3d_cli.fields.fusion import DOUBT, EXTENT, REACH, Fusion, fuse
from mv3d_cli.fields.relief import relief_of
from mv3d_cli.formats.cameras import load_cameras
from mv3d_cli.meshes.surface import surface_of_grid
from mv3d_cli.scene.views import View

RESOLUTION = 64


def points_of(fusion: Fusion) -> np.ndarray:
    axes = [first + fusion.voxel * np.arange(n) for first, n in zip(fusion.origin, fusion.distance.shape, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def volume_of(fusion: Fusion) -> float:
    mesh = surface_of_grid(fusion.distance, np.array(fusion.origin), fusion.voxel)
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert solid.is_watertight
    return float(solid.volume)


def cube_seen(camera, half: float, size: int = 128) -> View:
    """Depth of a cube about the origin, whose sides are the axes'."""
    y, x = (np.indices((size, size)) + 0.5) * 2 / size - 1
    pose = camera.world_from_camera
    start = np.stack([x, y, 0 * x], axis=-1) @ pose[:3, :3].T + pose[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        meets = (np.array([[[-half]], [[half]]])[..., None] - start) / pose[:3, 2]
    enters, leaves = np.nanmax(meets.min(0), axis=-1), np.nanmin(meets.max(0), axis=-1)
    return View(camera, depth=np.where(enters < leaves, enters, 0).astype(np.float32))


def test_the_grid_is_the_unit_sphere_and_a_margin(sphere, ring) -> None:
    fusion = fuse([relief_of(sphere.view(ring[0], 64))], RESOLUTION)
    points = points_of(fusion)
    assert np.allclose(points[0, 0, 0], -EXTENT + fusion.voxel / 2)
    assert np.allclose(points[-1, -1, -1], EXTENT - fusion.voxel / 2)
    assert fusion.reach == REACH * fusion.voxel
    assert np.abs(fusion.distance).max() == pytest.approx(fusion.reach, rel=1e-6)


@pytest.mark.parametrize("source", ["rendered", "generated"])
def test_an_ellipsoid_has_its_distances_and_volume(ellipsoid, ring, source: str) -> None:
    fusion = fuse([relief_of(ellipsoid.view(camera, 128, source)) for camera in ring], RESOLUTION)
    true = ellipsoid.distance(points_of(fusion))
    near = np.abs(true) < 0.5 * fusion.voxel
    off = np.abs(fusion.distance - true)[near] / fusion.voxel
    assert np.median(off) < 0.05
    assert np.quantile(off, 0.95) < 0.3
    assert (fusion.distance[true < -0.5 * fusion.voxel] < 0).all()
    assert (fusion.distance[true > 1.5 * fusion.voxel] > 0).mean() > 0.9999
    volume = 4 / 3 * np.pi * np.prod(ellipsoid.radii)
    assert volume_of(fusion) == pytest.approx(volume, rel=0.01 if source == "rendered" else 0.02)


def test_distances_to_one_view_are_to_its_tangent_planes(sphere, ring) -> None:
    fusion = fuse([relief_of(sphere.view(ring[0], 128))], RESOLUTION)
    points = points_of(fusion)
    true = sphere.distance(points)
    outwards = (points - sphere.centre) / np.linalg.norm(points - sphere.centre, axis=-1, keepdims=True)
    sight = ring[0].world_from_camera[:3, 3] - points
    cosine = (outwards * sight).sum(-1) / np.linalg.norm(sight, axis=-1)
    slanted = (cosine > 0.5) & (cosine < 0.75) & (np.abs(true) < 0.7 * fusion.voxel)
    slope = (fusion.distance * true)[slanted].sum() / (true[slanted] ** 2).sum()
    assert slope == pytest.approx(1, abs=0.04)


def test_a_cube_has_its_volume() -> None:
    half = 33 / 64  # its sides run between pixels: outlines that come from depth are not known any closer
    fusion = fuse([relief_of(cube_seen(camera, half)) for camera in load_cameras()], 96)
    assert volume_of(fusion) == pytest.approx(8 * half**3, rel=0.01)


def test_silhouettes_alone_carve_their_hull(sphere, ring) -> None:
    reliefs = [relief_of(replace(sphere.view(camera, 128), depth=None)) for camera in ring]
    fusion = fuse(reliefs, RESOLUTION)
    true = sphere.distance(points_of(fusion))
    assert (fusion.distance[true < -0.1 * fusion.voxel] < 0).all()
    volume = 4 / 3 * np.pi * sphere.radii[0] ** 3
    assert volume < volume_of(fusion) < 1.1 * volume


def test_views_that_disagree_count_further_around_their_surfaces(sphere, ring) -> None:
    reliefs = [relief_of(sphere.view(camera, 64)) for camera in ring[:4]]
    fusion = fuse(reliefs, RESOLUTION, disagreement=0.02)
    assert fusion.reach == pytest.approx(DOUBT * 0.02)
    true = sphere.distance(points_of(fusion))
    assert fusion.distance[np.abs(true) < 0.09].std() > 0.04


def test_depth_that_has_no_weight_does_not_count(sphere, ring) -> None:
    good = [relief_of(sphere.view(camera, 96)) for camera in ring]
    wrong = relief_of(replace(sphere, radii=(0.5, 0.5, 0.5)).view(ring[0], 96))
    assert wrong.depth is not None
    without = fuse(good, RESOLUTION).distance
    assert np.array_equal(fuse([*good, replace(wrong, outline=None, weight=0.0)], RESOLUTION).distance, without)
    assert not np.array_equal(fuse([*good, replace(wrong, outline=None)], RESOLUTION).distance, without)


def test_views_that_know_nothing_are_refused(sphere, ring) -> None:
    view = sphere.view(ring[0], 32)
    opaque = np.dstack([view.color[..., :3], np.full((32, 32, 1), 255, np.uint8)])
    with pytest.raises(BadViews, match="where the object is") as refusal:
        fuse([relief_of(replace(view, color=opaque, depth=None))], 16)
    assert "transparent" in refusal.value.hint


def test_silhouettes_that_contradict_each_other_are_refused(sphere, ring) -> None:
    high, low = (replace(sphere, radii=(0.3, 0.3, 0.3), centre=(0.0, 0.0, z)) for z in (0.6, -0.6))
    reliefs = [relief_of(replace(shape.view(c, 64), depth=None)) for shape, c in ((high, ring[0]), (low, ring[2]))]
    with pytest.raises(BadViews, match="contradict") as refusal:
        fuse(reliefs, 32)
    assert "--weight" in refusal.value.hint
