"""Deformations against their closed forms."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mv3d_cli.capture.shapes.deformations import bend, draw_waves, ripple, shear, taper, twist, warp
from mv3d_cli.capture.shapes.surfaces import Part, ball, cylinder


def line(points: np.ndarray) -> Part:
    """A part whose vertices are these points; deformations look at nothing else."""
    faces = np.zeros((1, 3), int)
    return Part(points, faces, np.zeros((len(points), 2)), np.arange(len(points)), np.zeros(1, int))


def volume(part: Part) -> float:
    a, b, c = (part.vertices[part.faces[:, k]] for k in range(3))
    return float((a * np.cross(b, c)).sum() / 6)


@settings(max_examples=30, deadline=None)
@given(curvature=st.floats(-1.5, 1.5), heading=st.floats(0, 6.3))
def test_bending_keeps_the_length_of_the_axis(curvature, heading):
    axis = np.stack([np.zeros(2001), np.zeros(2001), np.linspace(-1, 1, 2001)], axis=1)
    bent = bend(line(axis), curvature, heading).vertices
    assert np.linalg.norm(np.diff(bent, axis=0), axis=1).sum() == pytest.approx(2, rel=1e-5)


def test_an_axis_bent_by_half_a_turn_is_half_a_circle():
    axis = np.stack([np.zeros(9), np.zeros(9), np.linspace(0, np.pi, 9)], axis=1)
    bent = bend(line(axis), 1.0).vertices
    np.testing.assert_allclose(np.linalg.norm(bent - [1, 0, 0], axis=1), 1)
    np.testing.assert_allclose(bent[-1], [2, 0, 0], atol=1e-12)


def test_bending_keeps_the_volume_round_the_axis():
    bar = cylinder(0.2, 0.2, 2.0, columns=24)
    fine = Part(bar.vertices, bar.faces, bar.uvs, bar.smooth, bar.slots)
    assert volume(bend(fine, 0.3)) == pytest.approx(volume(bar), rel=0.02)  # Pappus: the centroid's way is kept


def test_taper_makes_a_frustum_of_a_cylinder():
    tapered = taper(cylinder(0.5, 0.5, 2.0, columns=200), -0.25)
    assert volume(tapered) == pytest.approx(np.pi * 2 / 3 * (0.25 + 0.125 + 0.0625), rel=1e-3)


def test_twist_turns_and_shear_slides():
    point = line(np.array([[1.0, 0.0, 2.0]]))
    np.testing.assert_allclose(twist(point, np.pi / 4).vertices, [[0, 1, 2]], atol=1e-12)
    np.testing.assert_allclose(shear(point, 0.5, -1.0).vertices, [[2, -2, 2]])


@pytest.mark.parametrize("seed", range(8))
def test_waves_move_by_about_their_amount_and_never_fold(seed):
    part = ball(1.0, 24)
    waves = draw_waves(np.random.default_rng(seed), 0.06, 2.2)
    moved = np.linalg.norm(warp(part, waves).vertices - part.vertices, axis=1)
    assert 0.01 < moved.mean() < 0.3
    numbers, pushes = waves.numbers, waves.pushes
    assert np.linalg.norm(numbers[:, :, None] * pushes[:, None, :], axis=(1, 2)).sum() < 1


def test_ripples_move_along_the_radius_only():
    part = ball(1.0, 12)
    rippled = ripple(part, draw_waves(np.random.default_rng(0), 0.05, 4)).vertices
    np.testing.assert_allclose(np.cross(rippled, part.vertices), 0, atol=1e-12)
    assert np.ptp(np.linalg.norm(rippled, axis=1)) > 0.02
