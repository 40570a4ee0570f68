"""Boxes and extruded outlines against closed-form volumes; their pictures must stand upright."""

import numpy as np
import pytest
import trimesh

from mv3d_cli.capture.shapes.assembly import aspect, normals
from mv3d_cli.capture.shapes.extrusions import (
    blocky,
    box,
    extrusion,
    gear,
    heart,
    polygon,
    rounded_rectangle,
    triangulated,
)
from mv3d_cli.capture.shapes.surfaces import Part


def solid(part: Part) -> trimesh.Trimesh:
    mesh = trimesh.Trimesh(np.round(part.vertices, 9), part.faces, process=False)
    mesh.merge_vertices(merge_norm=True, merge_tex=True, digits_vertex=7)
    return mesh


def area_of(outline: np.ndarray) -> float:
    x, z = outline.T
    return float((x * np.roll(z, -1) - np.roll(x, -1) * z).sum() / 2)


OUTLINES = {
    "triangle": polygon(3),
    "star": polygon(7, 0.4),
    "gear": gear(11, 0.25),
    "heart": heart(),
    "letter E": blocky(("###", "#..", "###", "#..", "###")),
    "letter S": blocky(("###", "#..", "###", "..#", "###")),
    "badge": rounded_rectangle(2, 1, 0.3),
}


@pytest.mark.parametrize("outline", OUTLINES.values(), ids=OUTLINES.keys())
@pytest.mark.parametrize("bevel", [0.0, 0.04])
def test_extrusions_are_closed_and_as_large_as_their_outline(outline, bevel):
    mesh = solid(extrusion(outline, 0.5, bevel))
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert area_of(outline) > 0
    exact = area_of(outline) * 0.5
    assert mesh.volume == pytest.approx(exact, rel=1e-6) if bevel == 0 else 0.85 * exact < mesh.volume < exact


@pytest.mark.parametrize("outline", OUTLINES.values(), ids=OUTLINES.keys())
def test_ears_cover_the_outline_once(outline):
    a, b, c = (outline[triangulated(outline)[:, k]] for k in range(3))
    areas = ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2
    assert (areas > -1e-12).all()
    assert areas.sum() == pytest.approx(area_of(outline))


def test_a_letter_has_one_square_per_cell():
    assert area_of(OUTLINES["letter E"]) == pytest.approx(11 * 0.16)


@pytest.mark.parametrize("part", [box((1, 2, 3)), box((1, 2, 3), 0.2), extrusion(polygon(5), 0.4, 0.05)])
def test_front_pictures_are_upright(part):
    front = np.unique(part.faces[part.slots == 0])
    uv, xyz = part.uvs[front], part.vertices[front]
    assert xyz[:, 1].max() < 0
    assert np.corrcoef(uv[:, 0], xyz[:, 0])[0, 1] > 0.95
    assert np.corrcoef(uv[:, 1], xyz[:, 2])[0, 1] < -0.95


def test_a_box_has_its_volume_and_the_aspect_of_its_sides():
    part = box((1, 2, 3), 0.0)
    mesh = solid(part)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(6)
    assert [aspect(part, slot) for slot in (0, 1, 4)] == pytest.approx([1 / 3, 2 / 3, 1 / 2])


def test_a_round_box_is_the_sum_of_a_box_and_a_ball():
    part = box((2, 2, 2), 0.5)
    mesh = solid(part)
    exact = 1 + 6 * 0.5 + 12 * np.pi * 0.25 / 4 + 4 / 3 * np.pi * 0.125
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(exact, rel=0.03)
    away = part.vertices - np.clip(part.vertices, -0.5, 0.5)
    np.testing.assert_allclose(np.linalg.norm(away, axis=1), 0.5, atol=1e-9)
    assert ((normals(part) * away / 0.5).sum(axis=1) > 0.95).all()
