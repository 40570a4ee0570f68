"""Colours carried over a surface against known harmonic functions; the atlas's gaps against SciPy."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import distance_transform_edt

from mv3d_cli.meshes.fill import dilated, harmonic
from mv3d_cli.meshes.surface import mesh_of


def strip(length: int, width: int = 3):
    """A flat strip of squares, each cut along the same diagonal."""
    index = np.arange(length * width).reshape(length, width)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    place = np.stack(np.unravel_index(np.arange(length * width), (length, width)), axis=1)
    return mesh_of(np.pad(place, ((0, 0), (0, 1))), faces)


def test_between_two_seen_ends_colours_run_steadily() -> None:
    mesh = strip(21)
    along = mesh.vertices[:, 0]
    known = (along == 0) | (along == 20)
    colors = np.where(known[:, None], (along / 20)[:, None] * [1.0, 0.5, 0.0], 9.0)
    filled = harmonic(mesh, colors, 1e3 * known)
    assert np.abs(filled[:, 0] - along / 20).max() < 0.06
    assert np.allclose(filled[:, 1], filled[:, 0] / 2, atol=1e-6)
    middle = filled[along == 10, 0]
    assert np.isclose(middle.mean(), 0.5, atol=0.01)


def test_seams_do_not_stop_colours_and_gaps_do() -> None:
    first, second = strip(5), strip(5)
    for shift, expected in ((4, 1.0), (9, 0.5)):  # sharing a row of doubled vertices, and apart
        vertices = np.concatenate([first.vertices, second.vertices + np.float32([shift, 0, 0])])
        mesh = mesh_of(vertices, np.concatenate([first.faces, second.faces + 15]))
        colors = np.where(vertices[:, :1] == 0, [[1.0, 1.0, 1.0]], [[0.0, 0.0, 0.0]])
        trust = (vertices[:, 0] == 0).astype(float)
        trust[0] = 0.0
        if shift == 9:
            third = mesh_of(vertices + np.float32([30, 0, 0]), mesh.faces)
            mesh = mesh_of(np.concatenate([vertices, third.vertices]), np.concatenate([mesh.faces, third.faces + 30]))
            colors = np.concatenate([colors, np.zeros((30, 3))])
            trust = np.concatenate([trust, np.zeros(30)])
            trust[-1] = trust.sum()  # black elsewhere: the mean is grey, and what touches neither takes it
        filled = harmonic(mesh, colors, trust)
        assert np.isclose(filled[15 + 14, 0], expected, atol=0.01)
        assert np.isclose(filled[14, 0], 1.0, atol=0.01)


def test_nothing_known_is_grey() -> None:
    assert (harmonic(strip(4), np.zeros((12, 3)), np.zeros(12)) == 0.5).all()


def test_gaps_take_the_nearest_valid_texel() -> None:
    rng = np.random.default_rng(0)
    valid = rng.random((60, 80)) < 0.02
    row, column = np.indices(valid.shape)
    picture = np.dstack([row, column, np.zeros_like(row)]).astype(np.uint8)
    filled = dilated(picture, valid).astype(int)
    reached = np.hypot(filled[..., 0] - row, filled[..., 1] - column)
    assert np.array_equal(filled[valid], picture[valid])
    assert valid[filled[..., 0], filled[..., 1]].all()
    assert (reached <= 1.05 * distance_transform_edt(~valid) + 0.5).all()
