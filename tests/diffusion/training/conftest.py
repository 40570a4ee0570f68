"""Batches whose objects are told by their seeds, and a network that knows the answer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from accelerate import Accelerator
from torch import Tensor, nn

from mv3d_cli.diffusion.autoencoder import Folding
from mv3d_cli.diffusion.network import MultiViewUNet
from mv3d_cli.diffusion.network.conditioning import Condition
from mv3d_cli.diffusion.noise import Schedule
from mv3d_cli.diffusion.training.objectives import Batch
from mv3d_cli.formats.cameras import load_cameras

VIEWS = 2


@pytest.fixture
def accelerator() -> Accelerator:
    return Accelerator(cpu=True)


@pytest.fixture
def batch_of() -> Callable[..., Batch]:
    """batch_of(1, 2): the objects of these seeds, with latents (pictures folded by two)."""
    poses = [torch.tensor(camera.world_from_camera, dtype=torch.float32) for camera in load_cameras()[:VIEWS]]

    def made(*seeds: int) -> Batch:
        draws = [torch.Generator().manual_seed(1000 + seed) for seed in seeds]
        photo = torch.stack([torch.rand(3, 8, 8, generator=draw) * 2 - 1 for draw in draws])
        pictures = torch.stack([torch.rand(2, VIEWS, 3, 8, 8, generator=draw) * 2 - 1 for draw in draws])
        folding = Folding(2)
        return Batch(
            photo=photo,
            latents=folding.encode(pictures),
            photo_latent=folding.encode(photo),
            world_from_camera=torch.stack(poses).expand(len(seeds), -1, -1, -1),
            seeds=seeds,
        )

    return made


@dataclass(frozen=True)
class Call:
    """What the network was asked."""

    noisy: Tensor
    timestep: Tensor
    condition: Condition
    across_domains: bool


class Oracle(MultiViewUNet):
    """In the network's place: believes in `clean(timestep, condition)`, answers accordingly, and keeps what it heard.

    off  is added to its answer
    """

    def __init__(self, schedule: Schedule, clean: Callable[[Tensor, Condition], Tensor], off: float = 0.0):
        nn.Module.__init__(self)
        self.schedule, self.clean, self.off = schedule, clean, off
        self.calls: list[Call] = []

    def forward(
        self, noisy: Tensor, timestep: Tensor, condition: Condition, across_domains: bool = True, **_: Any
    ) -> Tensor:
        self.calls.append(Call(noisy.detach(), timestep, condition, across_domains))
        shape = (-1, *[1] * (noisy.ndim - 1))
        alpha, sigma = (x[timestep].float().view(shape) for x in (self.schedule.alpha, self.schedule.sigma))
        clean = self.clean(timestep, condition)
        noise = (noisy - alpha * clean) / sigma
        return self.off + (noise if self.schedule.prediction == "epsilon" else alpha * noise - sigma * clean)


@pytest.fixture
def oracle() -> type[Oracle]:
    return Oracle
