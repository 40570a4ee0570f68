"""Depth from colour: calibrated views with outlines and without depth are given depth, where they agree on it.

Each view's rays are swept from the visual hull inwards (plane sweep, Collins 1996); colours are compared with those of
the views beside it, and semi-global matching (Hirschmüller, 2008) finds a smooth depth. Depth is kept where other views
found the same surface. Volumes of costs are (labels, height, width); a label is a planar z. Scene units.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample

from mv3d_cli.fields.fitting.samples import Cameras, cameras_of, rays_through
from mv3d_cli.fields.fitting.volume import RADIUS, first_crossing, span_in_sphere
from mv3d_cli.fields.fusion import fuse
from mv3d_cli.fields.relief import Relief, reliefs_of
from mv3d_cli.fields.sdf import Field, field_of
from mv3d_cli.scene.views import View, Views

LABELS = 96
AT_ONCE = 16  # labels whose colours are in memory together
HULL = 128  # voxels along an edge: it only says where to begin
NEIGHBOURS = 6
WIDEST = 1.3  # radians between two views that still show the same surface
BEST = 0.5  # share of the neighbours that have to agree: the others may not see the point
WINDOW = 3  # pixels
OUTLIER = 0.12  # of colours in [0, 1]: more different is not worse
OUTSIDE = 1.5 * OUTLIER
SLANT, STEP = 0.002, 0.02  # cost of one label's step between pixels, and of any larger one
EDGE = 20.0  # per colour: steps in depth are cheaper where colours change
LURE, LURED = (
    0.1,
    0.002,
)  # cost per scene unit behind the hull, and its limit: where colours tell nothing, the hull holds
SAME = 0.015  # scene units between two views' depth of one surface

Volume = Float[Tensor, "labels height width"]
Plane = Float[Tensor, "height width"]


@dataclass(frozen=True)
class _Sight:
    """A view: picture (4, h, w) of colour over white and outline (pixels), `enters`: z where rays enter the hull."""

    picture: Float[Tensor, "4 height width"]
    enters: Plane


@dataclass(frozen=True)
class _Window:
    """The part of a view that shows the object: slices, and its pixels' centres (h, w, 2)."""

    rows: slice
    columns: slice
    at: Float[Tensor, "height width 2"]


def with_depth_from_color(views: Views) -> Views:
    """The views, those without depth given it where their colours tell; 0 where they do not.

    Views without an outline or colour stay as they are, and so do all where fewer than three have both.
    """
    reliefs = reliefs_of(views)
    useful = [i for i, relief in enumerate(reliefs) if relief.outline is not None and relief.color is not None]
    blind = [i for i in useful if reliefs[i].depth is None]
    if len(useful) < 3 or not blind:
        return views
    chosen = [reliefs[i] for i in useful]
    cameras = cameras_of(chosen)
    with torch.no_grad():
        hull = field_of(fuse([replace(relief, depth=None) for relief in chosen], HULL))
        sights = [_sight(views.frames[i], reliefs[i], cameras, hull, n) for n, i in enumerate(useful)]
        beside = [_beside(cameras, n) for n in range(len(useful))]
        depths = [_swept(sights, cameras, n, beside[n]) for n in range(len(useful))]
        kept = [_agreed(depths, cameras, n, beside[n]) for n in range(len(useful))]
    frames = list(views.frames)
    for n, i in enumerate(useful):
        if i in blind:
            frames[i] = replace(frames[i], depth=kept[n].numpy())
    return Views(tuple(frames))


def _sight(view: View, relief: Relief, cameras: Cameras, hull: Field, index: int) -> _Sight:
    assert view.color is not None
    assert relief.outline is not None
    color = torch.from_numpy(view.color.astype(np.float32) / 255)
    picture = color[..., :3] * color[..., 3:] + 1 - color[..., 3:]
    outline = torch.from_numpy(relief.outline)
    rows, columns = (outline < 0).nonzero().unbind(1)
    at = torch.stack([columns, rows], dim=1) + 0.5
    rays = rays_through(cameras, torch.full((len(at),), index), at)
    enters = torch.full_like(outline, torch.inf)
    enters[rows, columns] = first_crossing(hull.base_distance, rays, *span_in_sphere(rays, RADIUS)) * rays.forward
    return _Sight(torch.cat([picture.movedim(2, 0), outline[None]]), enters)


def _beside(cameras: Cameras, index: int) -> list[int]:
    """The views next to one, nearest first."""
    forward = cameras.rotation[..., 2]
    angle = torch.acos((forward @ forward[index]).clamp(-1, 1))
    order = angle.argsort().tolist()
    return [i for i in order if i != index and angle[i] < WIDEST][:NEIGHBOURS]


def _swept(sights: Sequence[_Sight], cameras: Cameras, index: int, beside: Sequence[int]) -> Plane:
    """The planar z of a view that its neighbours' colours speak for; 0 outside its outline."""
    sight = sights[index]
    solid = sight.picture[3] < 0
    depth = torch.zeros_like(sight.enters)
    if not solid.any() or not beside:
        return depth
    window = _window(solid)
    part = (window.rows, window.columns)
    labels = _labels(sight.enters[solid], cameras, index)
    costs = torch.cat([_costs(sights, cameras, index, beside, window, some) for some in labels.split(AT_ONCE)])
    costs = costs * solid[part]
    summed = _semi_global(costs, sight.picture[(slice(0, 3), *part)].mean(0))
    depth[part] = _least(summed, labels)
    return torch.where(solid, depth, 0)


def _window(solid: Tensor) -> _Window:
    rows, columns = (solid.any(1).nonzero(), solid.any(0).nonzero())
    down, across = (slice(int(n.min()), int(n.max()) + 1) for n in (rows, columns))
    y, x = (torch.arange(span.start, span.stop) + 0.5 for span in (down, across))
    return _Window(down, across, torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1))


def _labels(enters: Float[Tensor, "pixels"], cameras: Cameras, index: int) -> Float[Tensor, "labels"]:
    """Planar z from the nearest place of the hull to as far behind its middle, one step of disparity apart."""
    nearest = float(enters.min()) - SAME
    middle = -float(cameras.place[index] @ cameras.rotation[index, :, 2])
    farthest = max(2 * middle - nearest, float(enters.max())) + 2 * SAME
    if cameras.pinhole[index]:
        return 1 / torch.linspace(1 / nearest, 1 / farthest, LABELS)
    return torch.linspace(nearest, farthest, LABELS)


def _costs(
    sights: Sequence[_Sight], cameras: Cameras, index: int, beside: Sequence[int], window: _Window, labels: Tensor
) -> Volume:
    """How badly colours at the labels' points agree between views; OUTSIDE where the hull has no room for them."""
    part = (window.rows, window.columns)
    points = _lifted(window.at, labels[:, None, None].expand(-1, *window.at.shape[:2]), cameras, index)
    behind = labels[:, None, None] - sights[index].enters[part]
    outside = behind < -SAME
    own, errors = sights[index].picture[(slice(0, 3), *part)], []
    for other in beside:
        pixel, _ = _projected(points, cameras, other)
        seen = _looked_up(sights[other].picture, pixel)
        outside |= seen[:, 3] > 1
        error = (seen[:, :3] - own).abs().mean(1).clamp(max=OUTLIER)
        errors.append(avg_pool2d(error[:, None], WINDOW, 1, WINDOW // 2, count_include_pad=False)[:, 0])
    agreeing = torch.stack(errors).sort(dim=0).values[: max(1, int(BEST * len(errors)))].mean(0)
    return torch.where(outside, OUTSIDE, agreeing + (LURE * behind).clamp(0, LURED))


def _semi_global(costs: Volume, grey: Plane) -> Volume:
    """Costs with those of the cheapest smooth path to each pixel from four sides (Hirschmüller, eq. 13), their mean."""
    total = torch.zeros_like(costs)
    for axis in (1, 2):
        for backwards in (False, True):
            lines, along = costs.movedim(axis, 0), grey.movedim(axis - 1, 0)
            if backwards:
                lines, along = lines.flip(0), along.flip(0)
            paths = _paths(lines, along)
            total += (paths.flip(0) if backwards else paths).movedim(0, axis)
    return total / 4


def _paths(lines: Float[Tensor, "steps labels lines"], grey: Float[Tensor, "steps lines"]) -> Tensor:
    """The cheapest path to each pixel from one side, less what it cost the pixel before."""
    paths = lines.clone()
    for n in range(1, len(lines)):
        before = paths[n - 1]
        least = before.amin(0)
        jump = STEP / (1 + EDGE * (grey[n] - grey[n - 1]).abs())
        cheapest = torch.minimum(before, least + jump)
        cheapest[1:] = torch.minimum(cheapest[1:], before[:-1] + SLANT)
        cheapest[:-1] = torch.minimum(cheapest[:-1], before[1:] + SLANT)
        paths[n] += cheapest - least
    return paths


def _least(costs: Volume, labels: Float[Tensor, "labels"]) -> Plane:
    """The label of least cost, between labels by the parabola through three."""
    middle = costs.argmin(0).clamp(1, len(labels) - 2)
    before, at, after = (costs.gather(0, (middle + step)[None])[0] for step in (-1, 0, 1))
    share = ((before - after) / (2 * (before + after - 2 * at)).clamp_min(1e-6)).clamp(-0.5, 0.5)
    towards = labels[middle + share.sign().long()]
    return labels[middle].lerp(towards, share.abs())


def _agreed(depths: Sequence[Plane], cameras: Cameras, index: int, beside: Sequence[int]) -> Plane:
    """A view's depth where more views have the same surface there than views that see through it; else 0."""
    depth = depths[index]
    rows, columns = depth.nonzero().unbind(1)
    at = torch.stack([columns, rows], dim=1) + 0.5
    points = _lifted(at, depth[rows, columns], cameras, index)
    votes = torch.zeros(len(points))
    for other in beside:
        pixel, z = _projected(points, cameras, other)
        height, width = depths[other].shape
        column, row = pixel[:, 0].long().clamp(0, width - 1), pixel[:, 1].long().clamp(0, height - 1)
        there = depths[other][row, column]
        votes += ((there - z).abs() < SAME).float() - ((there - z > 2 * SAME) | (there == 0)).float()
    return torch.zeros_like(depth).index_put((rows, columns), torch.where(votes > 0, depth[rows, columns], 0))


def _lifted(at: Float[Tensor, "*pixels 2"], z: Float[Tensor, "*pixels"], cameras: Cameras, index: int) -> Tensor:
    """World points of pixels at planar z."""
    across = (at - cameras.offset[index]) / cameras.scale[index]
    across = across * z[..., None] if cameras.pinhole[index] else across.expand(*z.shape, 2)
    return torch.cat([across, z[..., None]], dim=-1) @ cameras.rotation[index].T + cameras.place[index]


def _projected(points: Float[Tensor, "*points 3"], cameras: Cameras, index: int) -> tuple[Tensor, Tensor]:
    """Pixels (x, y) and planar z of world points."""
    local = (points - cameras.place[index]) @ cameras.rotation[index]
    z = local[..., 2]
    across = local[..., :2] / z[..., None].clamp_min(1e-6) if cameras.pinhole[index] else local[..., :2]
    return across * cameras.scale[index] + cameras.offset[index], z


def _looked_up(
    picture: Float[Tensor, "channels height width"], pixel: Float[Tensor, "labels rows columns 2"]
) -> Tensor:
    """A picture between its pixels, bilinear: (labels, channels, rows, columns)."""
    place = 2 * pixel / pixel.new_tensor(picture.shape[:0:-1]) - 1
    found = grid_sample(picture[None], place.flatten(0, 1)[None], "bilinear", "border", align_corners=False)[0]
    return found.unflatten(1, place.shape[:2]).movedim(1, 0)
