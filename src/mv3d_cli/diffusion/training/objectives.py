"""What each stage of training wants: modules whose `forward` is the mean loss of a batch's objects.

Everything random about an object's loss comes from the object's own seed, so that a loss depends neither on the
batch's other objects nor on how a batch is spread over processes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from mv3d_cli.diffusion.model import Model
from mv3d_cli.diffusion.network import colour_depth_parameters
from mv3d_cli.diffusion.network.conditioning import COLOUR, DEPTH, Condition, with_dropout
from mv3d_cli.diffusion.noise import (
    Schedule,
    coefficients,
    min_snr_weight,
    noisy_from_clean,
    prediction_from_clean,
)


@dataclass(frozen=True)
class Batch:
    """Objects as the network is taught with them: colour, then depth, encoded; `seeds` has a number for each.

    drafts  of the latents, where the network mends them
    """

    photo: Float[Tensor, "objects 3 height width"]
    latents: Float[Tensor, "objects domains views channels rows columns"]
    photo_latent: Float[Tensor, "objects channels rows columns"]
    world_from_camera: Float[Tensor, "objects views 4 4"]
    seeds: tuple[int, ...]
    drafts: Float[Tensor, "objects domains views channels rows columns"] | None = None


@dataclass(frozen=True)
class Teaching:
    """How the diffusion stages teach.

    joint     colour and depth of an object together (stage 2), or one of them, drawn at random (stage 1)
    gamma     cap of the signal-to-noise weight; `floor`: its least value
    noisiest  share of objects that get pure noise: one step from there is what few-step sampling starts with
    dropout   share of objects without photo tokens, as many without its latent, as many without both
    """

    joint: bool = True
    gamma: float = 5.0
    floor: float = 1.0
    noisiest: float = 0.3
    dropout: float = 0.05
    dtype: torch.dtype = torch.bfloat16


class DiffusionObjective(nn.Module):
    """The weighted squared error of the network's prediction (noise or v)."""

    def __init__(self, model: Model, teaching: Teaching):
        super().__init__()
        self.network, self.encoder = model.network, model.encoder
        self.schedule: Schedule = model.schedule
        self.teaching = teaching

    def forward(self, batch: Batch) -> Float[Tensor, ""]:
        """The mean loss over the objects."""
        teaching, device = self.teaching, batch.latents.device
        draws = [*generators(batch.seeds)]
        tasks, clean = self._asked(batch.latents, draws)
        timestep = torch.tensor([self._timestep(generator) for generator in draws])
        hidden = torch.tensor([torch.rand((), generator=generator).item() for generator in draws])
        noise = torch.stack([torch.randn(clean.shape[1:], generator=generator) for generator in draws]).to(device)
        noisy = noisy_from_clean(self.schedule, clean, noise, timestep)
        target = prediction_from_clean(self.schedule, clean, noise, timestep)
        with torch.autocast(device.type, teaching.dtype, enabled=teaching.dtype != torch.float32):
            condition = condition_of(batch, self.encoder(batch.photo), tasks)
            condition = with_dropout(condition, hidden, teaching.dropout)
            prediction = self.network(noisy, timestep.to(device), condition, across_domains=teaching.joint)
        error = (prediction.float() - target).square().flatten(1).mean(dim=1)
        weight = min_snr_weight(self.schedule, timestep, teaching.gamma, teaching.floor)
        return (weight.to(device) * error).mean()

    def parameters_in_training(self) -> list[nn.Parameter]:
        """The network's and the photo encoder's; without the colour-depth layers where those are not used."""
        unused = set() if self.teaching.joint else {id(p) for p in colour_depth_parameters(self.network)}
        named = [*self.network.parameters(), *self.encoder.parameters()]
        return [parameter for parameter in named if id(parameter) not in unused]

    def _asked(
        self, latents: Tensor, draws: Sequence[torch.Generator]
    ) -> tuple[Int[Tensor, "objects domains"], Tensor]:
        """The tasks of each object, and their clean latents."""
        if self.teaching.joint:
            return torch.tensor([[COLOUR, DEPTH]], device=latents.device).expand(len(latents), -1), latents
        tasks = torch.tensor([int(torch.randint(2, (), generator=generator)) for generator in draws])
        chosen = latents[torch.arange(len(latents)), tasks.to(latents.device)]
        return tasks[:, None].to(latents.device), chosen[:, None]

    def _timestep(self, generator: torch.Generator) -> int:
        last = len(self.schedule.alpha) - 1
        if torch.rand((), generator=generator).item() < self.teaching.noisiest:
            return last
        return int(torch.randint(last + 1, (), generator=generator))


def condition_of(batch: Batch, tokens: Tensor, tasks: Int[Tensor, "objects domains"]) -> Condition:
    """What the network is told of a batch."""
    drafts = batch.drafts
    if drafts is not None:
        drafts = drafts[torch.arange(len(drafts), device=drafts.device)[:, None], tasks]
    return Condition(batch.photo_latent, tokens, batch.world_from_camera, tasks, drafts)


def signal_and_noise(schedule: Schedule, timestep: Tensor, like: Tensor) -> tuple[Tensor, Tensor]:
    """(alpha, sigma) at the timesteps; clean (1, 0) where a timestep is negative."""
    alpha, sigma = coefficients(schedule, timestep.clamp_min(0), like)
    done = (timestep < 0).to(like.device).view(alpha.shape)
    return alpha.masked_fill(done, 1.0), sigma.masked_fill(done, 0.0)


def generators(seeds: Sequence[int]) -> Iterator[torch.Generator]:
    """A generator for each object, on the CPU."""
    return (torch.Generator().manual_seed(seed) for seed in seeds)
