"""Whole objects: the same bytes from the same seed, closed parts, sane textures, and no two alike."""

from functools import lru_cache

import numpy as np
import pytest
import trimesh

from mv3d_cli.capture.shapes import procedural_mesh, procedural_parts
from mv3d_cli.capture.shapes.assembly import extent, join, mirrored, normals, painted, place
from mv3d_cli.capture.shapes.families import FAMILIES
from mv3d_cli.capture.shapes.surfaces import ball, cylinder
from mv3d_cli.capture.shapes.textures import draw_palette, patterned, plain
from mv3d_cli.scene.mesh import Material, Mesh, face_normals, transform, unit_sphere_from_mesh

mesh_of = lru_cache(maxsize=None)(procedural_mesh)


def pixels_of(material: Material) -> np.ndarray:
    assert material.texture is not None
    return material.texture.pixels


def normals_of(mesh: Mesh) -> np.ndarray:
    assert mesh.normals is not None
    return mesh.normals


def uvs_of(mesh: Mesh) -> np.ndarray:
    assert mesh.uvs is not None
    return mesh.uvs


def arrays_of(mesh: Mesh) -> list[np.ndarray]:
    pixels = [pixels_of(material) for material in mesh.materials]
    return [mesh.vertices, mesh.faces, mesh.face_material, normals_of(mesh), uvs_of(mesh), *pixels]


@pytest.mark.parametrize("seed", range(0, 40, 8))
def test_a_seed_gives_the_same_bytes(seed):
    first, second = procedural_mesh(seed), procedural_mesh(seed)
    assert [a.tobytes() for a in arrays_of(first)] == [b.tobytes() for b in arrays_of(second)]
    assert first.vertices.tobytes() != mesh_of(seed + 1).vertices.tobytes()


@pytest.mark.parametrize("seed", range(40))
def test_parts_are_closed_and_face_outwards(seed):
    for part in procedural_parts(seed):
        mesh = trimesh.Trimesh(np.round(part.vertices, 9), part.faces, process=False)
        mesh.merge_vertices(merge_norm=True, merge_tex=True, digits_vertex=6)
        assert mesh.is_watertight
        assert mesh.is_winding_consistent
        assert mesh.volume > 0


@pytest.mark.parametrize("family", [family for family, _ in FAMILIES], ids=lambda family: family.__name__)
def test_every_family_makes_textured_objects(family):
    mesh = join(family(np.random.default_rng(5)))
    assert 40 < len(mesh.faces) < 25_000
    assert mesh.face_material.min() == 0
    assert mesh.face_material.max() < len(mesh.materials)
    for array in (mesh.vertices, normals_of(mesh), uvs_of(mesh)):
        assert np.isfinite(array).all()
    assert all(material.texture is not None for material in mesh.materials)
    assert 0.5 < np.ptp(mesh.vertices, axis=0).max() < 6


def test_the_face_budget_holds():
    faces = np.array([len(mesh_of(seed).faces) for seed in range(60)])
    assert faces.max() <= 20_000
    assert 2_000 < np.median(faces) < 10_000


@pytest.mark.parametrize("seed", range(20))
def test_shading_agrees_with_the_faces(seed):
    mesh = mesh_of(seed)
    np.testing.assert_allclose(np.linalg.norm(normals_of(mesh), axis=1), 1, atol=1e-3)
    facing = np.einsum("fkx,fx->fk", normals_of(mesh)[mesh.faces], face_normals(mesh))
    assert (facing > 0.3).mean() > 0.99


def face_areas(mesh: Mesh) -> np.ndarray:
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(float) for k in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


@pytest.mark.parametrize("seed", range(40))
def test_textures_lie_evenly_on_the_surface(seed):
    """Texels per area stay within a factor of four of the material's median on most of the surface."""
    mesh, even = mesh_of(seed), 0.0
    area = face_areas(mesh)
    p, q, r = (uvs_of(mesh)[mesh.faces[:, k]].astype(float) for k in range(3))
    shown = np.abs(np.linalg.det(np.stack([q - p, r - p], axis=1))) / 2
    for material in range(len(mesh.materials)):
        own = (mesh.face_material == material) & (area > 1e-9)
        density = shown[own] / area[own]
        order = np.argsort(density)
        covered = np.cumsum(area[own][order])
        median = density[order][np.searchsorted(covered, covered[-1] / 2)]
        assert median > 0
        even += area[own][(density > median / 4) & (density < median * 4)].sum()
    assert even > 0.75 * area.sum()


def silhouettes(mesh: Mesh, size: int = 20) -> np.ndarray:
    """Coarse front and side silhouettes of the object in its unit sphere, by splatting points of its faces."""
    unit = transform(mesh, unit_sphere_from_mesh(mesh))
    corners = unit.vertices[unit.faces]
    weights = np.random.default_rng(0).dirichlet([1, 1, 1], 12)
    points = np.einsum("wk,fkx->wfx", weights, corners).reshape(-1, 3)
    picture = np.zeros((2, size, size), bool)
    cell = np.clip(((points + 1) / 2 * size).astype(int), 0, size - 1)
    for view, axis in enumerate((0, 1)):
        picture[view, cell[:, 2], cell[:, axis]] = True
    return picture.ravel()


def mean_colour(mesh: Mesh) -> np.ndarray:
    counts = np.bincount(mesh.face_material, minlength=len(mesh.materials))
    means = [pixels_of(material)[..., :3].mean(axis=(0, 1)) for material in mesh.materials]
    return np.average(means, axis=0, weights=counts)


def test_objects_differ_in_shape_and_colour():
    shapes = np.stack([silhouettes(mesh_of(seed)) for seed in range(60)]).astype(float)
    both = shapes @ shapes.T
    overlap = both / (shapes.sum(1)[:, None] + shapes.sum(1)[None, :] - both)
    pairs = overlap[np.triu_indices(60, 1)]
    assert np.median(pairs) < 0.65
    assert (pairs < 0.98).mean() > 0.99
    colours = np.stack([mean_colour(mesh_of(seed)) for seed in range(60)])
    assert (colours.std(axis=0) > 25).all()
    assert np.ptp(colours.max(axis=1) - colours.min(axis=1)) > 80  # from greys to vivid


def colours_seen(mesh: Mesh, towards: tuple[int, int, int]) -> np.ndarray:
    """A histogram over 4 x 4 x 4 colours of the faces that look that way, by area."""
    centre = uvs_of(mesh)[mesh.faces].mean(axis=1)
    weight = face_areas(mesh) * np.maximum(face_normals(mesh) @ np.array(towards) - 0.5, 0)
    histogram = np.zeros(64)
    for number, material in enumerate(mesh.materials):
        own = mesh.face_material == number
        height, width = pixels_of(material).shape[:2]
        row, column = (centre[own] * [width, height] // 1).astype(int).T[::-1]
        colour = pixels_of(material)[row % height, column % width, :3].astype(int) // 64
        histogram += np.bincount(colour @ [16, 4, 1], weight[own], 64)
    return histogram / histogram.sum()


def test_the_front_of_most_objects_is_not_their_back():
    differences = [
        np.abs(colours_seen(mesh_of(seed), (0, -1, 0)) - colours_seen(mesh_of(seed), (0, 1, 0))).sum() / 2
        for seed in range(60)
    ]
    assert np.median(differences) > 0.05


def test_placing_scales_then_turns_then_moves():
    part = place(ball(1.0), (1, 2, 3), (0, 0, 90), (2, 1, 1))
    np.testing.assert_allclose(np.ptp(part.vertices, axis=0), [2, 4, 2], rtol=0.02)
    np.testing.assert_allclose(part.vertices.mean(axis=0), [1, 2, 3], atol=0.2)


def test_a_mirrored_part_still_faces_outwards():
    part = place(ball(1.0), (3, 0, 0))
    outward = mirrored(part).vertices - [-3, 0, 0]
    assert ((normals(mirrored(part)) * outward).sum(axis=1) > 0.9).all()


def test_tiling_paint_repeats_a_whole_number_of_times_round_and_keeps_its_scale():
    rng = np.random.default_rng(0)
    paint = patterned(rng, *draw_palette(rng)[:2])
    part = painted(cylinder(1, 1, 2), paint, plain(rng, draw_palette(rng).light))
    wall = np.unique(part.faces[part.slots == 0])
    repeats = np.ptp(part.uvs[wall, 0])
    assert repeats == pytest.approx(round(repeats))
    assert extent(part)[0] == pytest.approx(paint.tile, rel=0.3)
    assert extent(part)[1] == pytest.approx(paint.tile, rel=0.05)


def test_shared_materials_appear_once():
    paint = plain(np.random.default_rng(0), np.array([1.0, 0, 0]))
    mesh = join([painted(ball(1.0), paint), painted(place(ball(1.0), (3, 0, 0)), paint)])
    assert len(mesh.materials) == 1
