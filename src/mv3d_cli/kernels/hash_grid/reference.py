"""The torch twin of the hash grid encoding: all corners of all cells gathered and weighted."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import pad

from mv3d_cli.kernels.hash_grid import Layout

PRIMES = (1, 2654435761, 805459861)
CORNERS = torch.tensor([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)])


def encode(
    points: Float[Tensor, "points 3"],
    tables: Float[Tensor, "entries features"],
    layout: Layout,
    *,
    levels: int | None = None,
) -> Float[Tensor, "points encoding"]:
    """Features of points by level: same arguments and results as the kernel's `encode`."""
    active = layout.levels if levels is None else levels
    parts = [_level(points, tables, layout, index) for index in range(active)]
    features = torch.cat(parts, dim=1) if parts else points.new_zeros((len(points), 0))
    return pad(features, (0, (layout.levels - active) * layout.features))


def _level(
    points: Float[Tensor, "points 3"], tables: Float[Tensor, "entries features"], layout: Layout, index: int
) -> Float[Tensor, "points features"]:
    """Features of one level (Müller et al. 2022, section 3)."""
    place = points.clamp(0, 1) * layout.resolutions[index]
    cell = place.detach().long().clamp(max=layout.resolutions[index] - 1)
    corners = CORNERS.to(points.device)
    share = (place - cell)[:, None]
    x, y, z = torch.where(corners == 1, share, 1 - share).unbind(-1)
    found = tables[_entries(cell[:, None] + corners, layout, index)]
    return ((x * y * z)[..., None] * found).sum(1)


def _entries(corner: Int[Tensor, "points 8 3"], layout: Layout, index: int) -> Int[Tensor, "points 8"]:
    """Entries of corners of a level: dense with x fastest, or hashed (eq. 4)."""
    x, y, z = corner.unbind(-1)
    if layout.is_hashed(index):
        entry = (x * PRIMES[0] ^ y * PRIMES[1] ^ z * PRIMES[2]) % layout.table_size
    else:
        row = layout.resolutions[index] + 1
        entry = x + row * (y + row * z)
    return layout.offsets[index] + entry
