"""Time of the hash grid encoding and of its gradient in the tables, against its torch twin in the same run.

Twelve levels of two features, tables of 2^15 entries, samples along rays as a fit takes them. Each figure is the best
of several runs, milliseconds; the two sides take turns, on the same threads.
"""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter

import torch
from torch import Tensor
from torch.nn.functional import normalize

from mv3d_cli.kernels.hash_grid import Layout, encode, reference
from shared_data import table

LAYOUT = Layout(levels=12, features=2, coarsest=16, finest=1024, table_size=2**15)
COUNTS = (5_000, 27_600, 100_000)
SAMPLES = 50  # of a ray
RUNS = 12


def samples_on_rays(count: int) -> Tensor:
    """Points along short random rays inside the unit cube."""
    generator = torch.Generator().manual_seed(0)
    origins = 0.2 + 0.6 * torch.rand(count // SAMPLES, 1, 3, generator=generator)
    directions = normalize(torch.randn(count // SAMPLES, 1, 3, generator=generator), dim=-1)
    return (origins + torch.linspace(-0.15, 0.15, SAMPLES)[:, None] * directions).reshape(-1, 3)


def step(function: Callable, points: Tensor, tables: Tensor, gradient: Tensor) -> tuple[float, float]:
    """Milliseconds of one forward and of one backward pass."""
    times = [moment(points)]
    features = function(points, tables, LAYOUT)
    times.append(moment(points))
    torch.autograd.grad(features, tables, gradient)
    times.append(moment(points))
    return 1e3 * (times[1] - times[0]), 1e3 * (times[2] - times[1])


def moment(points: Tensor) -> float:
    """The time at which the device has done all that was asked of it."""
    if points.is_cuda:
        torch.cuda.synchronize()
    return perf_counter()


def row(device: str, count: int) -> list[str]:
    """Ours and the twin's: forward, backward, both; and how many times faster both are."""
    points = samples_on_rays(count).to(device)
    tables = torch.randn(LAYOUT.entries, LAYOUT.features, device=device, requires_grad=True)
    gradient = torch.randn(len(points), LAYOUT.levels * LAYOUT.features, device=device)
    sides = (encode, reference.encode)
    runs = [[step(side, points, tables, gradient) for side in sides] for _ in range(RUNS)][1:]
    best = [tuple(min(run[side][way] for run in runs) for way in (0, 1)) for side in (0, 1)]
    cells = [f"{ours:.1f} / {twin:.1f}" for ours, twin in (*zip(*best, strict=True), (sum(best[0]), sum(best[1])))]
    return [device, f"{count:,}", *cells, f"{sum(best[1]) / sum(best[0]):.1f}x"]


def main() -> None:
    devices = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
    rows = [row(device, count) for device in devices for count in COUNTS]
    table(["device", "points", "forward ours / twin", "backward", "both", "faster"], rows)


if __name__ == "__main__":
    main()
