"""Solids between two sheets against bodies that are known: half a ball, and a scan's like drawn by our rasteriser."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mv3d_cli.capture.lighting import studio
from mv3d_cli.capture.rendering import render
from mv3d_cli.capture.shapes import procedural_mesh
from mv3d_cli.capture.solid import views_between
from mv3d_cli.formats.cameras import load_cameras, select
from mv3d_cli.metrics.image import psnr
from mv3d_cli.metrics.overlap import iou
from mv3d_cli.scene.views import View

SIDE = 128
NAMES = ("front", "back", "right", "left", "front_right", "top")
RIG = select(load_cameras(None), NAMES)
PLACE = (np.arange(SIDE) + 0.5) / SIDE * 2 - 1
X, Z = np.meshgrid(PLACE, -PLACE)
BALL = np.hypot(X, Z) < 0.7
BULGE = np.sqrt(np.maximum(0.49 - X**2 - Z**2, 0))


def view(which: int, depth: np.ndarray, color: tuple[int, int, int], mask: np.ndarray = BALL) -> View:
    shown = np.dstack([np.broadcast_to(np.array(color, np.uint8), (*mask.shape, 3)), 255 * mask.astype(np.uint8)])
    return View(RIG[which], shown, np.where(mask, depth, 0))


def seen(front: View, back: View) -> dict[str, View]:
    return dict(zip(NAMES, views_between(front, back, RIG).frames, strict=True))


def test_half_a_ball_is_half_a_ball_from_all_sides() -> None:
    """Its front bulges, its back is flat."""
    views = seen(view(0, 2 - BULGE, (200, 30, 30)), view(1, np.full((SIDE, SIDE), 2.0), (30, 30, 200)))
    bulge, flat = views["front"].depth, views["back"].depth
    inner = np.hypot(X, Z) < 0.6
    assert np.abs(bulge - (2 - BULGE))[inner].max() < 0.03
    assert np.abs(flat - 2)[inner].max() < 0.03
    # from its right the front lies to the left: y runs to the right, z up
    assert iou(views["right"].depth > 0, BALL & (X < 0)) > 0.93
    assert iou(views["left"].depth > 0, BALL & (X > 0)) > 0.93
    assert iou(views["top"].depth > 0, BALL & (Z < 0)) > 0.93
    assert (views["back"].color[..., 2] > views["back"].color[..., 0])[inner].all()
    assert (views["right"].color[..., 0] > views["right"].color[..., 2])[BALL & (X < -0.1)].mean() > 0.95


def test_the_back_is_mirrored() -> None:
    """A wedge: thick at the front's right."""
    mask = (np.abs(X) < 0.5) & (np.abs(Z) < 0.4)
    back = view(1, 2 - 0.3 * (0.5 - X), (90, 90, 90), mask)  # the back's left is the front's right
    top = seen(view(0, np.full((SIDE, SIDE), 2.0), (90, 90, 90), mask), back)["top"].depth > 0
    wedge = (np.abs(X) < 0.5) & (Z > 0) & (Z < 0.3 * (0.5 + X))  # from above: x right, y up
    assert iou(top, wedge) > 0.85


def test_true_sheets_say_more_of_the_sides_than_the_front_does() -> None:
    unfolded, copied = [], []
    for seed in (3, 5, 8, 13):
        frames = render(procedural_mesh(seed), RIG, SIDE, studio()).frames
        drawn = views_between(frames[0], frames[1], RIG).frames
        unfolded += [psnr(a.color, b.color) for a, b in zip(drawn[2:5], frames[2:5], strict=True)]
        copied += [psnr(frames[0].color, b.color) for b in frames[2:5]]
    assert np.mean(unfolded) > np.mean(copied) + 2
    assert all(ours > theirs - 1.5 for ours, theirs in zip(unfolded, copied, strict=True))


@pytest.mark.parametrize("depth", [0.0, 1.2, 2.8])
def test_sheets_that_cross_are_kept_apart(depth: float) -> None:
    """Also where one knows of no surface at all."""
    flat = np.full((SIDE, SIDE), depth)
    views = seen(view(0, np.full((SIDE, SIDE), 2.5), (9, 9, 9)), replace(view(1, flat, (9, 9, 9)), depth=flat * BALL))
    for name, drawn in views.items():
        assert np.isfinite(drawn.depth).all(), name
    assert iou(views["front"].depth > 0, BALL) > 0.95
