from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch

from mv3d_cli.fields import stereo
from mv3d_cli.fields.fitting.samples import cameras_of
from mv3d_cli.fields.relief import relief_of
from mv3d_cli.fields.stereo import with_depth_from_color
from mv3d_cli.scene.camera import Camera, Orthographic, Perspective, direction_on_sphere, look_at_origin
from mv3d_cli.scene.views import Views

SIZE, VIEWS = 96, 12


def cameras(projection: Orthographic | Perspective) -> list[Camera]:
    turns = np.linspace(0, 2 * np.pi, VIEWS, endpoint=False)
    return [look_at_origin(f"{i}", direction_on_sphere(turn, 0.5), projection) for i, turn in enumerate(turns)]


@pytest.mark.parametrize("projection", [Orthographic(), Perspective((0.85, 0.85))], ids=["parallel", "pinhole"])
def test_depth_of_a_painted_ellipsoid_is_found_from_its_colors(ellipsoid, projection) -> None:
    true = Views(tuple(ellipsoid.view(camera, SIZE) for camera in cameras(projection)))
    found = with_depth_from_color(Views(tuple(replace(view, depth=None) for view in true.frames)))
    for view, exact in zip(found.frames, true.frames, strict=True):
        assert view.depth is not None
        assert exact.depth is not None
        known, solid = view.depth > 0, exact.depth > 0
        assert (known & solid).sum() > 0.8 * solid.sum()
        assert (known & ~solid).sum() < 0.02 * solid.sum()
        error = np.abs(view.depth - exact.depth)[known & solid]
        assert np.median(error) < 0.005
        assert error.mean() < 0.012


def test_views_with_depth_or_without_outline_stay_as_they_are(ellipsoid) -> None:
    frames = [ellipsoid.view(camera, 48) for camera in cameras(Orthographic())[:4]]
    assert frames[1].color is not None
    opaque = frames[1].color.copy()
    opaque[..., 3] = 255
    given = [frames[0], replace(frames[1], color=opaque, depth=None), *(replace(f, depth=None) for f in frames[2:])]
    found = with_depth_from_color(Views(tuple(given))).frames
    assert found[0] is given[0]
    assert found[1] is given[1]
    assert found[2].depth is not None
    few = Views(tuple(given[2:]))
    assert with_depth_from_color(few) is few


def test_paths_are_the_cheapest_of_all() -> None:
    """Every sequence of labels tried, on a row of five pixels with four labels."""
    steps, labels = 5, 4
    generator = torch.Generator().manual_seed(0)
    costs = 0.03 * torch.rand(steps, labels, 1, generator=generator)
    grey = torch.rand(steps, 1, generator=generator)
    jumps = stereo.STEP / (1 + stereo.EDGE * grey.diff(dim=0).abs()[:, 0])

    def cost(sequence: tuple[int, ...]) -> float:
        total = sum(float(costs[n, label, 0]) for n, label in enumerate(sequence))
        for n, (one, other) in enumerate(itertools.pairwise(sequence)):
            step = abs(other - one)
            total += 0 if step == 0 else min(stereo.SLANT, float(jumps[n])) if step == 1 else float(jumps[n])
        return total

    every = list(itertools.product(range(labels), repeat=steps))
    best = torch.tensor([min(cost(s) for s in every if s[-1] == last) for last in range(labels)])
    found = stereo._paths(costs, grey)[-1, :, 0]
    torch.testing.assert_close(found - found.min(), best - best.min(), atol=1e-6, rtol=0)


def test_the_least_cost_lies_between_labels() -> None:
    labels = torch.linspace(1.0, 2.0, 21)
    true = torch.tensor([[1.23, 1.5], [1.77, 1.613]])
    found = stereo._least((labels[:, None, None] - true) ** 2, labels)
    torch.testing.assert_close(found, true, atol=1e-4, rtol=0)


@pytest.mark.parametrize("projection", [Orthographic(), Perspective((1.0, 1.0))], ids=["parallel", "pinhole"])
def test_labels_reach_from_the_hull_to_behind_the_middle(ellipsoid, projection) -> None:
    camera = look_at_origin("a", (0.0, -2.0, 0.0), projection)
    cameras = cameras_of([relief_of(ellipsoid.view(camera, 16))])
    labels = stereo._labels(torch.tensor([1.4, 1.9, 2.1]), cameras, 0)
    assert labels.min() < 1.4
    assert labels.max() > 2.6
    gaps = (labels if isinstance(projection, Orthographic) else 1 / labels).diff()
    torch.testing.assert_close(gaps, gaps.mean().expand_as(gaps), atol=1e-5, rtol=0)
