"""The multi-resolution hash grid encoding (Müller et al. 2022, "Instant neural graphics primitives").

Points lie in [0, 1]^3. Levels are cubic grids, coarse to fine, whose corners hold trained features: all of them where
the corners fit in a table, else through a spatial hash. `tables` holds the entries of all levels, one after the other.
"""

# Warp's type stubs are narrower than Warp:
# pyright: reportArgumentType=false, reportIncompatibleMethodOverride=false

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, partial
from itertools import accumulate
from typing import Any

import torch
import warp as wp
from jaxtyping import Float32
from torch import Tensor

from mv3d_cli.kernels.hash_grid import warp_kernels as source
from mv3d_cli.kernels.rasterize import bands, block_of, workers
from mv3d_cli.kernels.runtime import device_of, in_threads, load, to_warp

Part = tuple[tuple[int, int], tuple[int, int]]  # of a launch: levels and points, each from and to


@dataclass(frozen=True)
class Layout:
    """The grids of an encoding; `ValueError` says what does not fit.

    levels           number of grids; their resolutions grow geometrically (eq. 2 and 3)
    features         numbers that an entry holds: 1, 2 or 4
    coarsest, finest cells along an axis of the first and of the last grid
    table_size       most entries of a level, a power of two
    """

    levels: int
    features: int
    coarsest: int
    finest: int
    table_size: int

    def __post_init__(self) -> None:
        if self.levels < 1 or not 1 <= self.coarsest <= self.finest:
            raise ValueError(f"a hash grid needs a level, and 1 <= coarsest <= finest: {self}")
        if self.features not in source.ENTRY:
            raise ValueError(f"an entry holds 1, 2 or 4 features: {self}")
        if self.table_size < 2 or self.table_size & (self.table_size - 1):
            raise ValueError(f"the table's size is a power of two from 2 on: {self}")
        if self.entries >= 2**31:
            raise ValueError(f"the tables have 2^31 entries or more: {self}")

    @property
    def resolutions(self) -> tuple[int, ...]:
        """Cells along an axis, by level."""
        growth = (self.finest / self.coarsest) ** (1 / max(self.levels - 1, 1))
        return tuple(round(self.coarsest * growth**level) for level in range(self.levels))

    @property
    def sizes(self) -> tuple[int, ...]:
        """Entries by level; a level with fewer corners than `table_size` has one for each."""
        return tuple(min((cells + 1) ** 3, self.table_size) for cells in self.resolutions)

    @property
    def offsets(self) -> tuple[int, ...]:
        """First entry of each level."""
        return tuple(accumulate(self.sizes[:-1], initial=0))

    @property
    def entries(self) -> int:
        """Entries of all levels."""
        return sum(self.sizes)

    def is_hashed(self, level: int) -> bool:
        """Whether corners of a level share entries."""
        return (self.resolutions[level] + 1) ** 3 > self.table_size


def encode(
    points: Float32[Tensor, "points 3"],
    tables: Float32[Tensor, "entries features"],
    layout: Layout,
    *,
    levels: int | None = None,
) -> Float32[Tensor, "points encoding"]:
    """Features of points, level after level, trilinear in each level's cell; the first `levels` levels are active.

    Differentiable in the tables, and in the points where they ask for it; not twice. Points beyond [0, 1] are clamped.
    The features of inactive levels are 0. On a CPU the same input gives the same bits, on any number of threads.
    Raises `ValueError` where the tables do not have the layout's shape.
    """
    active = layout.levels if levels is None else levels
    if tables.shape != (layout.entries, layout.features):
        raise ValueError(f"tables of shape {tuple(tables.shape)} for {layout.entries} x {layout.features} features")
    if not 0 <= active <= layout.levels:
        raise ValueError(f"{active} active levels of {layout.levels}")
    return _Encode.apply(points, tables, layout, active)


@cache
def _levels(layout: Layout, device: str) -> wp.array:
    """The layout as kernels read it."""
    found = []
    for index, (cells, first) in enumerate(zip(layout.resolutions, layout.offsets, strict=True)):
        level = source.Level()
        level.resolution, level.first = cells, first
        level.mask = layout.table_size - 1 if layout.is_hashed(index) else 0
        found.append(level)
    return wp.array(found, dtype=source.Level, device=device)


def _launch(kernel: Any, layout: Layout, parts: list[Part], device: str, arrays: list[wp.array]) -> None:
    """Runs the parts of a kernel beside each other."""
    levels, block = _levels(layout, device), block_of(device)

    def run(part: Part) -> None:
        (first, end), (start, stop) = part
        inputs = [levels, first, wp.vec2i(start, stop), block, *arrays]
        wp.launch(kernel, (end - first, -(-(stop - start) // block)), inputs, device=device)

    in_threads([partial(run, part) for part in parts])


def _by_points(levels: int, points: int, device: str) -> list[Part]:
    """A part for each thread: all levels, a run of points."""
    return [((0, levels), span) for span in bands(points, workers(device))]


def _by_level(levels: int, points: int, device: str) -> list[Part]:
    """Parts of whole levels: on a CPU one thread adds to a level, point by point, so the sum is the same each time."""
    count = min(levels, 2 * workers(device)) if device == "cpu" else 1  # two a thread: levels differ in cost
    return [(span, (0, points)) for span in bands(levels, count)]


class _Encode(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, points: Tensor, tables: Tensor, layout: Layout, active: int) -> Tensor:
        device, entry = device_of(tables), source.ENTRY[layout.features]
        load(source, device)
        ctx.save_for_backward(points, tables)
        ctx.layout, ctx.active = layout, active
        result = points.new_empty((len(points), layout.levels, layout.features))
        given = ((points.detach(), wp.vec3), (tables.detach(), entry), (result, entry))
        arrays = [to_warp(array, kind, device) for array, kind in given]
        _launch(source.encode, layout, _by_points(active, len(points), device), device, arrays)
        result[:, active:] = 0
        return result.flatten(1)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor | None, None, None]:
        points, tables = (saved.detach() for saved in ctx.saved_tensors)
        layout, count = ctx.layout, len(points)
        device, entry = device_of(tables), source.ENTRY[layout.features]
        gradient = gradient.unflatten(1, (layout.levels, layout.features))
        at, by, values = (
            to_warp(array, kind, device) for array, kind in ((points, wp.vec3), (gradient, entry), (tables, entry))
        )
        to_points = to_tables = None
        if ctx.needs_input_grad[0]:
            to_points = torch.zeros_like(points, memory_format=torch.contiguous_format)
            arrays = [at, by, values, to_warp(to_points, wp.vec3, device)]
            _launch(source.add_point_gradient, layout, _by_points(ctx.active, count, device), device, arrays)
        if ctx.needs_input_grad[1]:
            to_tables = torch.zeros_like(tables, memory_format=torch.contiguous_format)
            arrays = [at, by, to_warp(to_tables, entry, device)]
            _launch(source.add_table_gradient, layout, _by_level(ctx.active, count, device), device, arrays)
        return to_points, to_tables, None, None
