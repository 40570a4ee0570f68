"""A mesh's look, held against colours that are known at every point, and against the rasteriser."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mv3d_cli.capture.rendering import render
from mv3d_cli.formats.cameras import load_cameras, select
from mv3d_cli.meshes import appearance
from mv3d_cli.meshes.appearance import Spots, colors_at
from mv3d_cli.meshes.simplify import simplified
from mv3d_cli.meshes.surface import mesh_of
from mv3d_cli.scene.conventions import srgb_from_linear
from mv3d_cli.scene.mesh import Material, Mesh, Texture

SIDE = 64


def ramp() -> np.ndarray:
    """A picture whose linear red rises with u, whose linear green rises with v."""
    v, u = (np.mgrid[0:SIDE, 0:SIDE] + 0.5) / SIDE
    rgb = srgb_from_linear(np.stack([u, v, np.full_like(u, 0.25)], axis=-1))
    return np.dstack([np.round(rgb * 255), np.full_like(u, 255)]).astype(np.uint8)


def square(**how) -> Mesh:
    """The unit square in x, z; u along x, v down z."""
    vertices = np.float32([[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]])
    uvs = np.float32([[0, 1], [1, 1], [1, 0], [0, 0]])
    return replace(mesh_of(vertices, np.array([[0, 1, 2], [0, 2, 3]])), uvs=uvs, **how)


def seen(mesh: Mesh) -> np.ndarray:
    cameras = select(load_cameras(None), ("front", "back_right_top"))
    return np.stack([view.color for view in render(mesh, cameras, 96, None).frames]).astype(float)


def test_texture_times_base_times_vertex_colour():
    base, tint = (0.5, 1.0, 0.25, 1.0), np.float32([[1, 1, 1, 1], [1, 1, 1, 1], [0, 1, 1, 1], [0, 1, 1, 1]])
    mesh = square(materials=(Material(base, Texture(ramp())),), colors=tint)
    shares = np.random.default_rng(0).dirichlet(np.ones(3), 200)
    face = np.arange(200) % 2
    place = np.einsum("sc,scx->sx", shares, mesh.vertices[mesh.faces[face]])
    inside = ((place[:, [0, 2]] > 1 / SIDE) & (place[:, [0, 2]] < 1 - 1 / SIDE)).all(axis=1)
    x, z = place[inside][:, 0], place[inside][:, 2]
    wanted = np.stack([0.5 * x * (1 - z), 1 - z, 0.25 * 0.25 * np.ones_like(x), np.ones_like(x)], axis=1)
    assert np.abs(colors_at(mesh, Spots(face, shares))[inside] - wanted).max() < 0.006


@pytest.mark.parametrize(("wrap", "at"), [("repeat", 0.2), ("clamp", 1.0), ("mirror", 0.8)])
def test_uv_beyond_the_picture(wrap, at):
    mesh = square(materials=(Material(texture=Texture(ramp(), wrap, "repeat")),))
    moved = replace(mesh, uvs=np.full((4, 2), (1.2, 0.5), np.float32))
    (color,) = colors_at(moved, Spots(np.array([0]), np.float32([[1, 0, 0]])))
    assert color[:2] == pytest.approx([at - (0.5 / SIDE if wrap == "clamp" else 0), 0.5], abs=0.006)


def test_vertices_on_borders_of_materials_are_doubled():
    red, blue = Material((1.0, 0.0, 0.0, 1.0)), Material((0.0, 0.0, 1.0, 1.0))
    mesh = square(materials=(red, blue), face_material=np.int32([0, 1]))
    made = appearance.with_vertex_colors(mesh)
    assert made.colors is not None
    assert (len(made.vertices), len(made.materials), made.uvs) == (6, 1, None)
    for face, color in enumerate([(1, 0, 0, 1), (0, 0, 1, 1)]):
        assert (made.colors[made.faces[face]] == color).all()
    assert np.array_equal(made.vertices[made.faces], mesh.vertices[mesh.faces])
    assert not appearance.is_plain(mesh)
    assert appearance.is_plain(replace(mesh, materials=(red, red)))
    assert not appearance.is_plain(made)


@pytest.mark.parametrize("how", ["vertices", "texture"])
def test_a_look_is_carried_to_fewer_faces(fields, mesh_from, how):
    fine = mesh_from(fields["torus"], 72)
    waves = 0.5 + 0.4 * np.sin(4 * fine.vertices)
    fine = replace(fine, colors=np.pad(waves, ((0, 0), (0, 1)), constant_values=1).astype(np.float32))
    bare = simplified(fine, len(fine.faces) // 8)
    made = (
        appearance.carried_to_vertices(bare, fine)
        if how == "vertices"
        else appearance.carried_to_texture(bare, fine, 512)
    )
    assert (made.colors is None) == (how == "texture")
    assert np.array_equal(made.vertices[made.faces], bare.vertices[bare.faces])
    before, after = seen(fine), seen(made)
    both = (before[..., 3] == 255) & (after[..., 3] == 255)
    error = np.abs(before - after)[both][:, :3]
    assert error.mean() < (3 if how == "vertices" else 1.5)
    assert np.abs(before[both] - before[both].mean(axis=0))[:, :3].mean() > 20  # the look varies


def test_both_sides_of_a_thin_plate_keep_their_own():
    """A plate 0.001 thick, red before and green behind, with few large faces."""
    vertices = np.float32([[x, y, z] for y in (0, 0.001) for x in (0, 1) for z in (0, 1)])
    front, back = [[0, 2, 3], [0, 3, 1]], [[4, 7, 6], [4, 5, 7]]
    plate = replace(
        mesh_of(vertices, np.array(front + back)),
        materials=(Material((1.0, 0.0, 0.0, 1.0)), Material((0.0, 1.0, 0.0, 1.0))),
        face_material=np.int32([0, 0, 1, 1]),
    )
    made = appearance.carried_to_texture(mesh_of(vertices, plate.faces), plate, 64)
    shares = np.random.default_rng(0).dirichlet(np.full(3, 4.0), 400)
    face = np.arange(400) % 4
    wanted = np.array([[1, 0, 0, 1], [0, 1, 0, 1]])[face // 2]
    assert np.abs(colors_at(made, Spots(face, shares)) - wanted).max(axis=1).mean() < 0.02


def test_plain_meshes_keep_their_colour(fields, mesh_from):
    fine = replace(mesh_from(fields["sphere"], 24), materials=(Material((0.2, 0.4, 0.6, 1.0), roughness=0.3),))
    made = appearance.plain_as(simplified(fine, 200), fine)
    assert made.materials[0] == fine.materials[0]
