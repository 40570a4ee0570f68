"""Lathes, superquadrics and tubes against the volumes, areas and normals of the solids they approximate."""

import numpy as np
import pytest
import trimesh

from mv3d_cli.capture.shapes.assembly import normals
from mv3d_cli.capture.shapes.surfaces import (
    Part,
    ball,
    cylinder,
    lathe,
    loop,
    spline,
    superquadric,
    torus,
    tube,
    vessel,
)


def solid(part: Part) -> trimesh.Trimesh:
    mesh = trimesh.Trimesh(np.round(part.vertices, 9), part.faces, process=False)
    mesh.merge_vertices(merge_norm=True, merge_tex=True, digits_vertex=7)
    return mesh


def closed_and_outward(part: Part) -> bool:
    mesh = solid(part)
    return bool(mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0)


HELIX = np.stack([np.cos(np.linspace(0, 4, 30)), np.sin(np.linspace(0, 4, 30)), np.linspace(0, 1, 30)], axis=1)
PARTS = {
    "boxy superquadric": superquadric(0.2, 0.3, (1, 2, 0.5)),
    "octahedral superquadric": superquadric(1.9, 2.0),
    "cylinder": cylinder(1, 0.7, 2, 0.1),
    "cone": cylinder(1, 0, 2),
    "vessel": vessel(np.array([(0.5, 0), (0.8, 0.5), (0.3, 1.2)]), 0.06),
    "lathe": lathe(np.array([(0, 0), (1, 0), (0.2, 0.5), (1, 1), (0, 1)]), section=1 + 0.1 * np.cos(np.arange(40))),
    "torus": torus(1, 0.3),
    "round tube": tube(HELIX, 0.1),
    "flat tube": tube(HELIX, np.linspace(0.05, 0.2, 30), flat=True),
}


@pytest.mark.parametrize("part", PARTS.values(), ids=PARTS.keys())
def test_surfaces_are_closed_and_face_outwards(part):
    assert closed_and_outward(part)
    assert part.uvs.min() >= -1e-9
    assert part.uvs.max() <= 1 + 1e-9


def test_exponents_of_one_make_an_ellipsoid():
    half = np.array([1.0, 0.6, 1.4])
    part = superquadric(1, 1, tuple(half), rows=64, columns=96)
    assert solid(part).volume == pytest.approx(4 / 3 * np.pi * half.prod(), rel=3e-3)
    np.testing.assert_allclose(((part.vertices / half) ** 2).sum(axis=1), 1, atol=1e-9)
    gradient = part.vertices / half**2
    gradient /= np.linalg.norm(gradient, axis=1, keepdims=True)
    assert ((normals(part) * gradient).sum(axis=1) > 0.999).all()


def test_small_exponents_approach_a_box_and_two_is_an_octahedron():
    assert solid(superquadric(0.05, 0.05, rows=40, columns=80)).volume == pytest.approx(8, rel=0.03)
    assert solid(superquadric(2, 2, rows=40, columns=80)).volume == pytest.approx(4 / 3, rel=0.01)


def test_a_constant_profile_turns_into_a_cylinder():
    mesh = solid(cylinder(0.5, 0.5, 2.0, columns=200))
    assert mesh.volume == pytest.approx(np.pi * 0.25 * 2, rel=1e-3)
    assert mesh.area == pytest.approx(2 * np.pi * 0.5 * 2 + 2 * np.pi * 0.25, rel=1e-3)


def test_a_hollow_vessel_holds_the_difference_of_two_cylinders():
    part = vessel(np.array([(1.0, 0), (1.0, 1.0), (1.0, 2.0)]), 0.1, columns=200)
    assert solid(part).volume == pytest.approx(np.pi * (2 - 0.81 * 1.9), rel=2e-3)


def test_corners_of_a_lathe_are_sharp_and_its_wall_is_smooth():
    part = cylinder(1, 1, 2, columns=24)
    shading = normals(part)
    wall = np.unique(part.faces[part.slots == 0])
    caps = np.unique(part.faces[part.slots == 1])
    np.testing.assert_allclose(shading[caps], np.sign(part.vertices[caps, 2:] - 1) * [0, 0, 1], atol=1e-9)
    np.testing.assert_allclose(shading[wall, :2], part.vertices[wall, :2], atol=0.07)


def test_the_middle_of_a_wrapped_texture_is_in_front():
    for part in (ball(1.0), cylinder(1, 1, 2)):
        x, y, _ = part.vertices[np.unique(part.faces[part.slots == 0])].T
        u = part.uvs[np.unique(part.faces[part.slots == 0]), 0]
        away = np.hypot(x, y) > 0.1
        expected = (np.arctan2(x, -y) / (2 * np.pi) + 0.5) % 1  # grows to the right of the viewer in front
        np.testing.assert_allclose(np.cos(2 * np.pi * (u - expected))[away], 1, atol=1e-6)


def test_a_torus_has_the_volume_of_pappus():
    assert solid(torus(1.0, 0.25, 160, 64)).volume == pytest.approx(2 * np.pi**2 * 0.0625, rel=4e-3)


def test_a_closed_tube_meets_itself_without_a_twist():
    t = np.linspace(0, 2 * np.pi, 150, endpoint=False)
    away = 1 + 0.4 * np.cos(3 * t)
    part = loop(np.stack([away * np.cos(2 * t), away * np.sin(2 * t), 0.4 * np.sin(3 * t)], axis=1), 0.1, 12)
    assert closed_and_outward(part)
    rings = part.vertices.reshape(151, 13, 3)
    steps = np.linalg.norm(np.diff(rings, axis=0), axis=2)
    assert steps[-1].max() < 1.5 * steps[:-1].max()


def test_a_tube_with_round_ends_is_a_capsule():
    part = tube(np.array([(0.0, 0, 0), (0, 0, 0.5), (0, 0, 1)]), 0.3, columns=96)
    assert solid(part).volume == pytest.approx(np.pi * 0.09 + 4 / 3 * np.pi * 0.027, rel=0.03)


def test_splines_pass_through_their_points():
    points = np.array([(0.0, 0.0), (1.0, 2.0), (3.0, 1.0)])
    np.testing.assert_allclose(spline(points, 5)[[0, 2, 4]], points)
    np.testing.assert_allclose(spline(points, 6, loop=True)[::2], points)
