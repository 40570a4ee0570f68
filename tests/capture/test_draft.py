"""Drafts against solids of revolution, for which they are right, and against what they promise of any photo."""

from __future__ import annotations

import numpy as np
import pytest

from mv3d_cli.capture.draft import draft_views, solid_of_discs, thickness
from mv3d_cli.formats.cameras import load_cameras, select
from mv3d_cli.metrics.overlap import iou
from mv3d_cli.scene.conventions import RIG_RADIUS

SIDE = 128
RIG = select(load_cameras(None), ("front", "back", "right", "left", "front_right", "top"))
STEP = 2 / 96  # of the solid's grid, scene units


def places() -> tuple[np.ndarray, np.ndarray]:
    """(x, z) in scene units at the pixels' centres."""
    centres = (np.arange(SIDE) + 0.5) / SIDE * 2 - 1
    return np.meshgrid(centres, -centres)


def photo_of(mask: np.ndarray, color: np.ndarray | None = None) -> np.ndarray:
    shown = np.full((*mask.shape, 3), 90, np.uint8) if color is None else color
    return np.dstack([shown, np.where(mask, 255, 0).astype(np.uint8)])


@pytest.fixture
def ball() -> np.ndarray:
    x, z = places()
    return np.hypot(x, z) < 0.7


def test_the_draft_of_a_disc_is_a_ball(ball) -> None:
    x, z = places()
    inner = np.hypot(x, z) < 0.6
    expected = RIG_RADIUS - np.sqrt(np.maximum(0.7**2 - x**2 - z**2, 0))
    for view in draft_views(photo_of(ball), RIG).frames:
        assert view.depth is not None
        assert np.abs(view.depth - expected)[inner].max() < 1.5 * STEP, view.camera.name
        assert iou(view.depth > 0, ball) > 0.95, view.camera.name


def test_horizontal_views_fill_the_rows_of_the_photo() -> None:
    x, z = places()
    mask = (np.abs(z - 0.1) < 0.4) & (np.abs(x + 0.2) < 0.1 + 0.3 * (z + 0.3))
    rows = mask.any(axis=1)
    for view in draft_views(photo_of(mask), RIG).frames[:5]:
        assert view.depth is not None
        there = (view.depth > 0).any(axis=1)
        assert (there != rows).sum() <= 3  # a row of the solid's grid at either end


def test_a_row_of_two_runs_is_two_discs() -> None:
    mask = np.zeros((3, 12), bool)
    mask[1, 1:5] = mask[1, 8:10] = True
    depth = thickness(mask)
    assert depth[[0, 2]].max() == 0
    np.testing.assert_allclose(depth[1, 1:5], np.sqrt(4 - np.array([1.5, 0.5, 0.5, 1.5]) ** 2))
    np.testing.assert_allclose(depth[1, 8:10], np.sqrt(1 - 0.25))
    assert depth[1, [0, 5, 6, 7, 10, 11]].max() == 0


def test_the_photo_is_the_front_and_its_mirror_image_the_back(ball) -> None:
    rng = np.random.default_rng(0)
    halves = np.where(places()[0][..., None] < 0, [200, 40, 40], [40, 40, 200]).astype(np.uint8)
    photo = photo_of(ball, halves)
    photo[..., :3] += rng.integers(0, 9, photo[..., :3].shape, dtype=np.uint8)
    front, back, right, *_ = (view.color for view in draft_views(photo, RIG).frames)
    assert front is not None
    assert back is not None
    assert right is not None
    assert np.array_equal(front, photo)
    inner = np.hypot(*places()) < 0.6
    beside = inner & (np.abs(places()[0]) > 0.1)  # the edge between the halves is soft
    difference = back[..., :3].astype(int) - photo[:, ::-1, :3]
    assert np.abs(difference)[beside].max() < 20
    assert (right[..., 2] > right[..., 0])[inner].mean() > 0.95  # its right half is blue


def test_faces_look_outwards(ball) -> None:
    mesh = solid_of_discs(photo_of(ball))
    corners = mesh.vertices[mesh.faces].astype(float)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outwards = (normals * corners.mean(axis=1)).sum(axis=1)
    assert (outwards > -1e-9).all()
    volume = (corners[:, 0] * np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    assert volume == pytest.approx(4 / 3 * np.pi * 0.7**3, rel=0.05)


@pytest.mark.parametrize("covered", [0, 3 * SIDE, SIDE * SIDE])
def test_any_cut_out_will_do(covered: int) -> None:
    mask = np.arange(SIDE * SIDE).reshape(SIDE, SIDE) < covered
    views = draft_views(photo_of(mask), RIG)
    assert len(views) == len(RIG)
    for view in views.frames:
        assert view.depth is not None
        assert np.isfinite(view.depth).all()
        assert (view.depth > 0).any()
