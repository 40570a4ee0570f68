"""Views that disagree are aligned to each other: every view is warped a little until all show one surface.

Points of each view are held against the surface, the outline and the colours of every other view that sees them;
Gauss-Newton with reweighting finds all warps at once (non-rigid ICP, point to plane: Chen and Medioni, 1991).
Smoothness is the prior of a Gaussian process, so that what the views cannot tell stays as it was.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy.linalg
import torch

from mv3d_cli.fields.alignment.correspondence import Rows, Samples, rows_between, samples_of
from mv3d_cli.fields.alignment.warps import GRID, Warp, still
from mv3d_cli.fields.relief import Relief
from mv3d_cli.kernels.runtime import in_threads

GATES = (0.12, 0.08, 0.06, 0.04, 0.03, 0.03, 0.03)  # scene units: points further from the other view's surface wait
PHOTOMETRIC_FROM = 3  # the round from which colours are close enough to be compared
AGREE = 0.1  # pixels' widths: views that disagree less are left as they are
RIDGE = 1e-3  # white part of the prior, of its variance


@dataclass(frozen=True)
class Prior:
    """How far views are expected to be off: standard deviations, and over what distance errors change."""

    pixels: float = 1.5
    depth: float = 0.015
    scale: float = 0.01
    shift: float = 0.01
    reach: float = 0.15  # of the picture's width


@dataclass(frozen=True)
class Alignment:
    """The warps of all views, and the median disagreement in scene units before and after."""

    warps: tuple[Warp, ...]
    before: float
    after: float


def align(reliefs: Sequence[Relief], held: Sequence[bool], prior: Prior | None = None) -> Alignment:
    """Warps that make the views agree; views without depth, and views that agree already, stay as they are.

    held  views whose dx and dy are zero: their outlines and colours are where they belong (real photos)
    """
    prior = prior or Prior()
    warps = [still() for _ in reliefs]
    sampled = {i: samples_of(relief, GRID) for i, relief in enumerate(reliefs) if relief.depth is not None}
    before = after = disagreement(reliefs, sampled, warps)
    width = float(np.mean([reliefs[i].pixel_width for i in sampled])) if sampled else 0.0
    if len(sampled) < 2 or before < AGREE * width:
        return Alignment(tuple(warps), before, after)
    system = _System(reliefs, held, prior)
    for number, gate in enumerate(GATES):
        warps = system.step(sampled, warps, gate, photometric=number >= PHOTOMETRIC_FROM)
    return Alignment(tuple(warps), before, disagreement(reliefs, sampled, warps))


def disagreement(reliefs: Sequence[Relief], sampled: dict[int, Samples], warps: Sequence[Warp]) -> float:
    """Median distance between what two views say of the same surface, scene units; NaN where no two see the same."""
    found = [rows.residual[: rows.geometric] for _, _, rows in _all_rows(reliefs, sampled, warps, GATES[0], False)]
    return float(np.median(np.abs(np.concatenate(found)))) if sum(map(len, found)) else float("nan")


def _all_rows(
    reliefs: Sequence[Relief], sampled: dict[int, Samples], warps: Sequence[Warp], gate: float, photometric: bool
) -> list[tuple[int, int, Rows]]:
    pairs = [(i, j) for i in sampled for j in range(len(reliefs)) if i != j]
    tasks = [
        partial(rows_between, sampled[i], reliefs[i], warps[i], reliefs[j], warps[j], gate, photometric)
        for i, j in pairs
    ]
    return [(*pair, rows) for pair, rows in zip(pairs, in_threads(tasks), strict=True)]


class _System:
    """The normal equations of all warps together."""

    def __init__(self, reliefs: Sequence[Relief], held: Sequence[bool], prior: Prior):
        self.reliefs = reliefs
        self.size = 3 * GRID**2 + 2
        self.precision = [_precision(prior, relief.shape) for relief in reliefs]
        free = np.ones((len(reliefs), self.size), dtype=bool)
        free[np.asarray(held), : 2 * GRID**2] = False
        free[[relief.depth is None for relief in reliefs]] = False
        self.free = np.flatnonzero(free)

    def step(self, sampled: dict[int, Samples], warps: Sequence[Warp], gate: float, photometric: bool) -> list[Warp]:
        """One reweighted Gauss-Newton step."""
        found = _all_rows(self.reliefs, sampled, warps, gate, photometric)
        count, size = len(self.reliefs), self.size
        matrix, vector = np.zeros((count, size, count, size)), np.zeros((count, size))
        for i, j, rows in found:  # one after the other: the matrix product has threads of its own
            normal, gradient = _normal_equations(rows)
            for a, first in ((i, 0), (j, 1)):
                vector[a] += gradient[first]
                for b, second in ((i, 0), (j, 1)):
                    matrix[a, :, b] += normal[first, :, second]
        state = np.stack([_vector_of(warp) for warp in warps])
        for i, precision in enumerate(self.precision):
            matrix[i, :, i] += precision
            vector[i] += precision @ state[i]
        total = count * size
        solvable = torch.from_numpy(matrix.reshape(total, total)[np.ix_(self.free, self.free)])
        right = torch.from_numpy(vector.reshape(-1)[self.free, None])
        state.reshape(-1)[self.free] -= torch.cholesky_solve(right, torch.linalg.cholesky(solvable)).numpy()[:, 0]
        gains = _gains(found, count) if photometric else [warp.gain for warp in warps]
        return [_warp_of(values, gain) for values, gain in zip(state, gains, strict=True)]


def _normal_equations(rows: Rows) -> tuple[np.ndarray, np.ndarray]:
    """J^T W J as (2, size, 2, size) and J^T W r as (2, size), of the view with the points and of the other."""
    jacobian = np.concatenate([_jacobian(*part) for part in (rows.own, rows.other)], axis=1)
    jacobian *= np.sqrt(rows.weight)[:, None]
    half = jacobian.shape[1] // 2
    tensor, residual = torch.from_numpy(jacobian), torch.from_numpy(rows.residual * np.sqrt(rows.weight)).float()
    normal, gradient = tensor.T @ tensor, tensor.T @ residual
    return normal.numpy().reshape(2, half, 2, half), gradient.numpy().reshape(2, half)


def _jacobian(slopes: np.ndarray, basis: np.ndarray, height: np.ndarray) -> np.ndarray:
    """(rows, size): slopes (rows, 3) along dx, dy, dz; basis (rows, grid^2); height above the rig's centre."""
    slopes, height = slopes.astype(np.float32), height.astype(np.float32)
    along = [slopes[:, axis, None] * basis for axis in range(3)]
    return np.concatenate([*along, slopes[:, 2:] * height[:, None], slopes[:, 2:]], axis=1)


def _precision(prior: Prior, shape: tuple[int, int]) -> np.ndarray:
    """Inverse covariance of one view's warp, its errors drawn from a Gaussian process with a Gaussian kernel."""
    place = np.stack(np.meshgrid(*[np.linspace(0, 1, GRID)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    place *= np.array([shape[0] / shape[1], 1.0])
    apart = ((place[:, None] - place[None]) ** 2).sum(-1)
    inverse = np.linalg.inv(np.exp(-apart / (2 * prior.reach**2)) + RIDGE * np.eye(len(place)))
    unit = shape[1] / 256  # errors are stated for pictures of 256 pixels
    parts = [inverse / (prior.pixels * unit) ** 2] * 2 + [inverse / prior.depth**2]
    return np.asarray(scipy.linalg.block_diag(*parts, 1 / prior.scale**2, 1 / prior.shift**2))


def _vector_of(warp: Warp) -> np.ndarray:
    return np.concatenate([warp.offsets.reshape(-1, 3).T.ravel(), [warp.scale, warp.shift]])


def _warp_of(values: np.ndarray, gain: float) -> Warp:
    offsets = values[:-2].reshape(3, GRID, GRID).transpose(1, 2, 0).copy()
    return Warp(offsets, float(values[-2]), float(values[-1]), float(gain))


def _gains(found: list[tuple[int, int, Rows]], count: int) -> np.ndarray:
    """One gain per view so that colours agree: least squares of log ratios, their mean left alone."""
    system, right = np.full((count, count), 1e-3), np.zeros(count)
    for i, j, rows in found:
        if np.isfinite(rows.log_ratio):
            trust = np.sqrt(rows.geometric)
            system[[i, j], [i, j]] += trust
            system[[i, j], [j, i]] -= trust
            right[j] += trust * rows.log_ratio
            right[i] -= trust * rows.log_ratio
    system += 1e-6 * np.eye(count)
    return np.exp(np.linalg.solve(system, right))
