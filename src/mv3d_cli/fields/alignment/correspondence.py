"""What two views say of each other: points of one on the surface, inside the outline and in the colours of the other.

Every comparison is a *row*: a residual in scene units (colours are scaled to them), its weight, and its slopes along
the warps (dx, dy, dz) of both views at the point. Axes and warps as in `warps`.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float

from mv3d_cli.fields.alignment.warps import Warp, basis_of
from mv3d_cli.fields.relief import Relief, lookup
from mv3d_cli.scene.camera import Perspective, pixel_from_camera
from mv3d_cli.scene.conventions import RIG_RADIUS

STRIDE = 4  # pixels between samples, for pictures of 256
NOISE = 0.004  # scene units; residuals below are Gaussian, above Laplacian
COLOR_NOISE = 0.02  # of colours in [0, 1]; residuals well above are outliers
PHOTOMETRIC = 10.0  # weight of colours; found on scans
FACING = 0.2  # cosine: surfaces seen at a more grazing angle are not compared
OUTSIDE = 8.0  # pixels: points further outside the outline are someone else's mistake
NEAR = 0.015  # scene units from the surface within which colours are compared

Points = Float[np.ndarray, "points 3"]


@dataclass(frozen=True)
class Samples:
    """Pixels of one view: `at` (n, 2) pixel, depth, slope, colour there, and the warp's `basis` (n, grid^2)."""

    at: np.ndarray
    depth: np.ndarray
    slope: np.ndarray
    color: np.ndarray | None
    basis: np.ndarray


@dataclass(frozen=True)
class Rows:
    """Residuals and weights; `own` and `other`: slopes (n, 3), basis (n, grid^2), height above the rig's centre (n,).

    The first `geometric` rows compare surfaces. `log_ratio` is of the other view's brightness to this one's.
    """

    residual: np.ndarray
    weight: np.ndarray
    own: tuple[np.ndarray, np.ndarray, np.ndarray]
    other: tuple[np.ndarray, np.ndarray, np.ndarray]
    geometric: int
    log_ratio: float


@dataclass(frozen=True)
class _Seen:
    """Points of one view as another sees them, and how that moves with the point's own warp (dx, dy, dz).

    pixel         (n, 2), in the other view's picture as it came, its warp undone
    depth         (n,) and depth_slopes (n, 3)
    pixel_slopes  (n, 2, 3)
    facing        (n,) cosine between the surface and the other view
    basis, dz     of the other view's warp there
    """

    pixel: np.ndarray
    depth: np.ndarray
    pixel_slopes: np.ndarray
    depth_slopes: np.ndarray
    facing: np.ndarray
    basis: np.ndarray
    dz: np.ndarray


@dataclass(frozen=True)
class _Part:
    """Rows of one kind: which samples, residual, weight, slopes (n, 3) along both warps."""

    which: np.ndarray
    residual: np.ndarray
    weight: np.ndarray
    own: np.ndarray
    other: np.ndarray


_NOTHING = _Part(np.zeros(0, np.int64), *(np.zeros(shape, np.float32) for shape in (0, 0, (0, 3), (0, 3))))


def samples_of(relief: Relief, grid: int) -> Samples:
    """Every few pixels of a relief that has depth."""
    assert relief.depth is not None
    assert relief.slope is not None
    stride = max(1, round(STRIDE * relief.shape[1] / 256))
    rows, columns = np.mgrid[stride // 2 : relief.shape[0] : stride, stride // 2 : relief.shape[1] : stride]
    known = relief.smooth[rows, columns]
    place = rows[known], columns[known]
    at = np.stack([place[1], place[0]], axis=-1) + np.float32(0.5)
    color = relief.color[place] if relief.color is not None else None
    return Samples(at, relief.depth[place], relief.slope[place], color, basis_of(at, relief.shape, grid))


def rows_between(
    samples: Samples, relief: Relief, warp: Warp, other: Relief, other_warp: Warp, gate: float, photometric: bool
) -> Rows:
    """All rows of one view's samples against another view; `gate`: how far off its surface they may be."""
    seen = _seen_from(*_lifted(samples, relief, warp), other, other_warp)
    parts, log_ratio, geometric = [], float("nan"), 0
    if other.depth is not None:
        surface = _surface_rows(seen, other, other_warp, gate)
        parts.append(surface)
        geometric = len(surface.which)
        if photometric and samples.color is not None and other.color is not None:
            near = surface.which[np.abs(surface.residual) < NEAR]
            parts.append(_color_rows(seen, other, near, samples.color[near] / warp.gain, other_warp.gain))
            log_ratio = _log_ratio(samples.color[near], lookup(other.color, *seen.pixel[near].T))
    if other.outline is not None:
        parts.append(_outline_rows(seen, other))
    rows = _Part(
        *(np.concatenate([getattr(part, field.name) for part in (_NOTHING, *parts)]) for field in fields(_Part))
    )
    return Rows(
        rows.residual,
        rows.weight * np.float32(relief.weight * other.weight),
        (rows.own, samples.basis[rows.which], samples.depth[rows.which] - RIG_RADIUS),
        (rows.other, seen.basis[rows.which], _height_of(other, seen, rows.which)),
        geometric,
        log_ratio,
    )


def _height_of(other: Relief, seen: _Seen, which: np.ndarray) -> np.ndarray:
    """Depth of the other view at the points, above the rig's centre; it scales with the warp's `scale`."""
    if other.depth is None:
        return np.zeros(len(which), np.float32)
    return lookup(other.depth, *seen.pixel[which].T) - RIG_RADIUS


def _lifted(samples: Samples, relief: Relief, warp: Warp) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """World points (n, 3), how they move along dx, dy, dz as (n, 3 xyz, 3), and outward normals (n, 3)."""
    offsets = samples.basis @ warp.offsets.reshape(-1, 3).astype(np.float32)
    depth = samples.depth + (samples.depth - RIG_RADIUS) * warp.scale + warp.shift + offsets[:, 2]
    (sx, ox), (sy, oy) = pixel_from_camera(relief.camera, relief.shape[1], relief.shape[0])
    ray = (samples.at + offsets[:, :2] - (ox, oy)) / (sx, sy)
    tangents = np.zeros((len(depth), 3, 3))
    tangents[:, 2, 2] = 1
    slope = samples.slope * (sx, sy)  # of depth, per unit of the ray's x and y
    if isinstance(relief.camera.projection, Perspective):
        place = np.column_stack([ray * depth[:, None], depth])
        tangents[:, :2, 2] = ray
        tangents[:, 0, 0], tangents[:, 1, 1] = depth / sx, depth / sy
        along = depth + (slope * ray).sum(1)
        normals = np.column_stack([slope[:, 0], slope[:, 1], -along])
    else:
        place = np.column_stack([ray, depth])
        tangents[:, 0, 0], tangents[:, 1, 1] = 1 / sx, 1 / sy
        normals = np.column_stack([slope, np.full(len(depth), -1.0)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    world_from_camera = relief.camera.world_from_camera
    rotation = world_from_camera[:3, :3]
    return place @ rotation.T + world_from_camera[:3, 3], rotation @ tangents, normals @ rotation.T


def _seen_from(points: np.ndarray, tangents: np.ndarray, normals: np.ndarray, other: Relief, warp: Warp) -> _Seen:
    """The points in the other view's picture."""
    pose = other.camera.camera_from_world
    place, moves = points @ pose[:3, :3].T + pose[:3, 3], pose[:3, :3] @ tangents
    (sx, ox), (sy, oy) = pixel_from_camera(other.camera, other.shape[1], other.shape[0])
    z = place[:, 2]
    if isinstance(other.camera.projection, Perspective):
        ray = place[:, :2] / np.maximum(z, 1e-6)[:, None]
        pixel_moves = (moves[:, :2] - ray[:, :, None] * moves[:, None, 2]) / np.maximum(z, 1e-6)[:, None, None]
        towards = pose[:3, :3].T @ -pose[:3, 3] - points
        facing = (normals * towards).sum(1) / np.linalg.norm(towards, axis=1)
    else:
        ray, pixel_moves = place[:, :2], moves[:, :2]
        facing = -normals @ pose[2, :3]
    at = ray * (sx, sy) + (ox, oy)
    basis = basis_of(at, other.shape, warp.offsets.shape[0])
    offsets = basis @ warp.offsets.reshape(-1, 3).astype(np.float32)
    facing = np.where(z > 0, facing, -1)
    return _Seen(at - offsets[:, :2], z, pixel_moves * [[sx], [sy]], moves[:, 2], facing, basis, offsets[:, 2])


def _surface_rows(seen: _Seen, other: Relief, warp: Warp, gate: float) -> _Part:
    """Distance from the other view's surface, to its tangent plane."""
    assert other.depth is not None
    assert other.slope is not None
    height, width = other.shape
    x, y = seen.pixel.T
    inside = (x > 1) & (x < width - 1) & (y > 1) & (y < height - 1) & (seen.facing > FACING)
    which = np.flatnonzero(inside)
    which = which[other.smooth[y[which].astype(int), x[which].astype(int)]]
    x, y = seen.pixel[which].T
    depth, slope = lookup(other.depth, x, y), other.slope[y.astype(int), x.astype(int)]
    scale, offset = pixel_from_camera(other.camera, width, height).T
    slant, along = slope * scale, 1.0
    if isinstance(other.camera.projection, Perspective):
        slant = slant / depth[:, None]
        along = 1 + (slant * (seen.pixel[which] - offset) / scale).sum(1)
    cosine = 1 / np.sqrt(along**2 + (slant**2).sum(1))  # between the normal and the ray whose z is 1
    placed = depth + (depth - RIG_RADIUS) * warp.scale + warp.shift + seen.dz[which]
    residual = (seen.depth[which] - placed) * cosine
    near = (np.abs(residual) < gate) & (cosine > FACING)
    which, slope, residual, cosine = which[near], slope[near], residual[near], cosine[near, None]
    own = (seen.depth_slopes[which] - (slope[:, :, None] * seen.pixel_slopes[which]).sum(1)) * cosine
    theirs = np.column_stack([slope, np.full(len(which), -1.0)]) * cosine
    weight = np.minimum(1, 2 * seen.facing[which]) / (np.maximum(np.abs(residual), NOISE) * NOISE)
    return _Part(which, residual, weight, own, theirs)


def _outline_rows(seen: _Seen, other: Relief) -> _Part:
    """How far points lie outside the other view's silhouette."""
    assert other.outline is not None
    which = np.flatnonzero((np.abs(seen.pixel / other.shape[::-1] - 0.5) < 0.5).all(1) & (seen.depth > 0))
    out = lookup(other.outline, *seen.pixel[which].T)
    outside = (out > 0) & (out < OUTSIDE)
    which, out = which[outside], out[outside]
    x, y = seen.pixel[which].T
    slope = 0.5 * np.column_stack([
        lookup(other.outline, x + 1, y) - lookup(other.outline, x - 1, y),
        lookup(other.outline, x, y + 1) - lookup(other.outline, x, y - 1),
    ])  # fmt: skip
    unit = other.pixel_width * (seen.depth[which] if isinstance(other.camera.projection, Perspective) else 1.0)
    unit = np.broadcast_to(unit, which.shape)[:, None]
    own = (slope[:, :, None] * seen.pixel_slopes[which]).sum(1) * unit
    theirs = np.column_stack([-slope, np.zeros(len(which))]) * unit
    residual = out * unit[:, 0]
    return _Part(which, residual, 1 / (np.maximum(residual, NOISE) * NOISE), own, theirs)


def _color_rows(seen: _Seen, other: Relief, which: np.ndarray, own_color: np.ndarray, gain: float) -> _Part:
    """Difference of brightness, with the weights of Geman and McClure (1985): outliers do not count."""
    assert other.color is not None
    x, y = seen.pixel[which].T
    grey = other.color.mean(-1) / gain
    residual = lookup(grey, x, y) - own_color.mean(1)
    slope = 0.5 * np.column_stack([
        lookup(grey, x + 1, y) - lookup(grey, x - 1, y),
        lookup(grey, x, y + 1) - lookup(grey, x, y - 1),
    ])  # fmt: skip
    own = (slope[:, :, None] * seen.pixel_slopes[which]).sum(1)
    theirs = np.column_stack([-slope, np.zeros(len(which))])
    robust = 1 / (1 + (residual / COLOR_NOISE) ** 2) ** 2
    weight = PHOTOMETRIC * robust * np.minimum(1, 2 * seen.facing[which]) / COLOR_NOISE**2
    return _Part(which, residual, weight, own, theirs)


def _log_ratio(own: np.ndarray, theirs: np.ndarray) -> float:
    """Median log of the other view's brightness over this one's; NaN where too few points tell."""
    bright = (own.mean(1) > 0.1) & (theirs.mean(1) > 0.1)
    if bright.sum() <= 20:
        return float("nan")
    return float(np.median(np.log(theirs[bright].mean(1) / own[bright].mean(1))))
