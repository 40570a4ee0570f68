"""Rows between two views: their residuals against the shape, their slopes against finite differences.

Slopes hold the other view's tangent plane and cosine still, as Gauss-Newton on planes does; on a smooth surface they
are those of the residual to some per cent.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mv3d_cli.fields.alignment.correspondence import NEAR, Rows, rows_between, samples_of
from mv3d_cli.fields.alignment.warps import GRID, Warp, still
from mv3d_cli.fields.relief import Relief, relief_of

SIZE = 128
GATE = 0.2
BEHIND = np.array([[-1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 4], [0, 0, 0, 1]])
"""Beyond the point that lies 2 before the camera, looking back."""


def wavy(seed: int, pixels: float = 0.4, depth: float = 0.004) -> Warp:
    rng = np.random.default_rng(seed)
    v, u = np.meshgrid(*[np.linspace(0, 1, GRID)] * 2, indexing="ij")
    waves = [np.sin(3 * (np.cos(t) * u + np.sin(t) * v) + p) for t, p in rng.uniform(0, 6, (3, 2))]
    return Warp(np.stack(waves, axis=-1) * [pixels, pixels, depth], scale=0.004, shift=-0.003)


def reliefs_for(kind: str, shape, cameras) -> tuple[Relief, Relief]:
    """Two views, the second of which knows only what rows of this kind need."""
    first, second = (relief_of(shape.view(camera, SIZE)) for camera in cameras[:2])
    if kind == "outline":
        y, x = np.indices(second.shape) + 0.5
        tight = np.hypot(x - 60, y - 66) - 28  # so that points lie outside
        return first, replace(second, depth=None, slope=None, outline=tight.astype(np.float32))
    return first, replace(second, outline=None)


def rows_of(kind: str, pair: tuple[Relief, Relief], warps: tuple[Warp, Warp]) -> tuple[Rows, slice]:
    first, second = pair
    samples = samples_of(first, GRID)
    rows = rows_between(samples, first, warps[0], second, warps[1], GATE, kind == "color")
    return rows, slice(rows.geometric, None) if kind == "color" else slice(None)


def stepped(warp: Warp, name: str, pattern: np.ndarray, step: float) -> Warp:
    """The warp a step along one of its parameters; dx, dy and dz follow the pattern over the grid."""
    if name in ("scale", "shift"):
        return replace(warp, **{name: getattr(warp, name) + step})
    offsets = warp.offsets.copy()
    offsets[..., ("dx", "dy", "dz").index(name)] += step * pattern
    return replace(warp, offsets=offsets)


def slope_along(part: tuple[np.ndarray, ...], name: str, pattern: np.ndarray) -> np.ndarray:
    slopes, basis, height = part
    if name == "scale":
        return slopes[:, 2] * height
    if name == "shift":
        return slopes[:, 2]
    return slopes[:, ("dx", "dy", "dz").index(name)] * (basis @ pattern.ravel())


def residuals(rows: Rows, part: slice) -> dict[bytes, float]:
    """By the sample they belong to: its shares of the grid are its own."""
    return {basis.tobytes(): value for basis, value in zip(rows.own[1][part], rows.residual[part], strict=True)}


@pytest.mark.parametrize("kind", ["surface", "outline", "color"])
@pytest.mark.parametrize("moving", [0, 1], ids=["own", "other"])
def test_slopes_are_those_of_the_residual(ellipsoid, ring, kind: str, moving: int) -> None:
    pair, pattern = reliefs_for(kind, ellipsoid, ring), np.random.default_rng(3).uniform(0.5, 1, (GRID, GRID))
    for name in ("dx", "dy", "dz", "scale", "shift"):
        predicted, found = predicted_and_found(kind, pair, moving, name, pattern)
        if moving == 1 and kind != "surface" and name not in ("dx", "dy"):  # colours and outlines have no depth
            assert not predicted.any()
            assert not found.any()
            continue
        assert len(found) > 200
        assert predicted @ found == pytest.approx(predicted @ predicted, rel=0.05), name
        assert np.linalg.norm(found - predicted) < 0.15 * np.linalg.norm(predicted), name


def predicted_and_found(
    kind: str, pair: tuple[Relief, Relief], moving: int, name: str, pattern: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Slopes of the residuals along a warp's parameter, and their central differences, of rows present at both ends."""
    warps = (wavy(1), wavy(2))
    rows, part = rows_of(kind, pair, warps)
    predicted = slope_along((rows.own, rows.other)[moving], name, pattern)[part]
    step = 1.0 if name in ("dx", "dy") else 0.01  # so that pictures are looked up some pixels away
    sides = []
    for sign in (-1, 1):
        there = list(warps)
        there[moving] = stepped(warps[moving], name, pattern, sign * step)
        sides.append(residuals(*rows_of(kind, pair, (there[0], there[1]))))
    keys = list(residuals(rows, part))
    both = np.array([key in sides[0] and key in sides[1] for key in keys])
    found = [(sides[1][key] - sides[0][key]) / (2 * step) for key, known in zip(keys, both, strict=True) if known]
    return predicted[both], np.array(found)


def test_views_that_agree_have_no_residuals(ellipsoid, ring) -> None:
    first, second = (relief_of(ellipsoid.view(camera, SIZE)) for camera in ring[:2])
    rows = rows_between(samples_of(first, GRID), first, still(), second, still(), GATE, True)
    assert rows.geometric > 300
    assert np.median(np.abs(rows.residual[: rows.geometric])) < 2e-4
    assert abs(rows.log_ratio) < 0.01


def test_a_surface_moved_outwards_is_that_far_away(sphere, ring) -> None:
    first, second = (relief_of(sphere.view(camera, SIZE)) for camera in ring[:2])
    bigger = replace(sphere, radii=tuple(r + 0.01 for r in sphere.radii))
    rows = rows_between(
        samples_of(second, GRID), second, still(), relief_of(bigger.view(ring[0], SIZE)), still(), GATE, False
    )
    residual = rows.residual[: rows.geometric]
    assert np.median(residual) == pytest.approx(0.01, rel=0.05)  # behind the other view's surface
    back = rows_between(
        samples_of(first, GRID), first, still(), relief_of(bigger.view(ring[1], SIZE)), still(), GATE, False
    )
    assert np.quantile(back.residual[: back.geometric], [0.1, 0.9]) == pytest.approx(0.01, rel=0.15)


def test_points_beyond_the_gate_wait(sphere, ring) -> None:
    smaller = replace(sphere, radii=tuple(r - 0.05 for r in sphere.radii))
    first, second = relief_of(sphere.view(ring[0], SIZE)), relief_of(smaller.view(ring[1], SIZE))
    second = replace(second, outline=None)
    counts = [
        len(rows_between(samples_of(first, GRID), first, still(), second, still(), gate, False).residual)
        for gate in (0.02, 0.08)
    ]
    assert counts[0] < 0.05 * counts[1]


def test_gains_and_trust(sphere, ring) -> None:
    first, second = (relief_of(sphere.view(camera, SIZE)) for camera in ring[:2])
    assert second.color is not None
    brighter = replace(second, color=second.color * np.float32(1.2), weight=3.0)
    samples = samples_of(first, GRID)
    plain = rows_between(samples, first, still(), second, still(), NEAR, True)
    rows = rows_between(samples, first, still(), brighter, replace(still(), gain=1.2), NEAR, True)
    assert rows.log_ratio - plain.log_ratio == pytest.approx(np.log(1.2), abs=1e-3)
    assert np.allclose(rows.residual, plain.residual, atol=1e-6)  # once the gain is known, colours agree
    assert np.allclose(rows.weight, 3 * plain.weight, rtol=1e-3)


def test_views_that_see_nothing_of_each_other_have_no_rows(sphere, ring) -> None:
    behind = replace(ring[0], world_from_camera=ring[0].world_from_camera @ BEHIND)
    first, second = relief_of(sphere.view(ring[0], SIZE)), relief_of(sphere.view(behind, SIZE))
    rows = rows_between(samples_of(first, GRID), first, still(), replace(second, outline=None), still(), 0.02, True)
    assert rows.geometric == len(rows.residual) == len(rows.own[0]) == len(rows.other[1]) == 0
    assert np.isnan(rows.log_ratio)
