"""Scores of shapes against two concentric spheres, a box of known faces, and trimesh's own queries."""

from __future__ import annotations

import math

import numpy as np
import pytest
import trimesh

from mv3d_cli.metrics.shape import Surface, distances, outer_surface, shape_scores, surface_samples

COUNT = 60_000


def on_sphere(radius: float, seed: int, count: int = COUNT) -> Surface:
    normals = np.random.default_rng(seed).normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Surface(radius * normals, normals)


def test_two_spheres_are_as_far_apart_as_their_radii():
    scores = shape_scores(on_sphere(0.315, 1), on_sphere(0.3, 0))
    along = 4 * 0.3**2 / COUNT  # mean squared distance to the nearest of points strewn over a plane: 1 / (pi density)
    assert scores.chamfer == pytest.approx(math.hypot(0.015, math.sqrt(along)), rel=0.003)
    assert scores.chamfer_plane == scores.chamfer  # farther apart than a tangent plane is trusted
    assert (scores.f_01, scores.f_02, scores.f_05) == (0.0, 1.0, 1.0)
    assert scores.normals == pytest.approx(1, abs=1e-4)
    assert math.isnan(scores.seen)


def test_tangent_planes_take_the_sampling_floor_away():
    apart = shape_scores(on_sphere(0.303, 1), on_sphere(0.3, 0))
    same = shape_scores(on_sphere(0.3, 1), on_sphere(0.3, 0))
    floor = 0.5 * 0.3 / math.sqrt(COUNT / (4 * math.pi))  # mean distance to the nearest of points strewn over a plane
    assert same.chamfer == pytest.approx(floor, rel=0.03)
    assert same.chamfer_plane < 0.1 * floor
    assert apart.chamfer_plane == pytest.approx(0.003, rel=0.02)
    assert apart.chamfer > 0.0035


def test_parts_are_scored_apart():
    """The upper half of the prediction lies .02 off, and the views see only that half."""
    true, predicted = on_sphere(1.0, 0), on_sphere(1.0, 1)
    points = np.where(predicted.points[:, 2:] > 0, 1.02, 1.0) * predicted.points
    scores = shape_scores(Surface(points, predicted.normals), Surface(true.points, true.normals, true.points[:, 2] > 0))
    assert scores.seen == pytest.approx(0.0214, abs=0.0005)
    assert scores.unseen == pytest.approx(0.0073, abs=0.0005)
    assert scores.chamfer == pytest.approx((scores.seen + scores.unseen) / 2, rel=0.01)


def test_distances_are_those_of_all_pairs():
    rng = np.random.default_rng(0)
    normals = np.tile([0.0, 0.0, 1.0], (40, 1))
    a, b = Surface(rng.uniform(size=(40, 3)), normals), Surface(rng.uniform(size=(30, 3)), normals[:30])
    pairs = np.linalg.norm(a.points[:, None] - b.points, axis=-1)
    found = distances(a, b)
    np.testing.assert_allclose(found.to_point, pairs.min(axis=1))
    np.testing.assert_array_equal(found.nearest, pairs.argmin(axis=1))


def test_samples_lie_on_the_surface_in_proportion_to_area():
    box = trimesh.creation.box((2.0, 1.0, 0.5))
    samples = surface_samples(box.vertices, box.faces, COUNT, seed=3)
    _, off, face = trimesh.proximity.closest_point_naive(box, samples.points[:2000])
    assert off.max() < 1e-9
    np.testing.assert_allclose(np.abs(samples.normals[:2000]), np.abs(box.face_normals[face]), atol=1e-9)
    share = np.bincount(np.abs(samples.normals).argmax(axis=1)) / COUNT
    np.testing.assert_allclose(share, np.array([0.5, 1.0, 2.0]) / 3.5, atol=0.01)
    again = surface_samples(box.vertices, box.faces, COUNT, seed=3)
    np.testing.assert_array_equal(again.points, samples.points)


def test_the_outer_surface_leaves_out_what_is_hidden():
    shell, core = trimesh.creation.icosphere(4, 0.8), trimesh.creation.icosphere(3, 0.5)
    both = trimesh.util.concatenate([shell, core])
    found = outer_surface(both.vertices, both.faces, 20_000, seed=0)
    radius = np.linalg.norm(found.points, axis=1)
    assert len(found.points) == 20_000
    assert 0.797 < radius.min() <= radius.max() < 0.8001
    assert ((found.normals * found.points).sum(axis=1) / radius).min() > 0.99
    octants = np.bincount((found.points > 0) @ [1, 2, 4])
    assert octants.min() > 0.5 * 20_000 / 8  # from every side
