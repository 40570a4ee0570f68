"""From a photo to views: noise, a sampler, the autoencoder. Colours in [-1, 1], depth in scene units."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from mv3d_cli.diffusion.autoencoder import depth_from_pictures
from mv3d_cli.diffusion.model import Model
from mv3d_cli.diffusion.network import guided
from mv3d_cli.diffusion.network.conditioning import COLOUR, DEPTH
from mv3d_cli.diffusion.sampling import Step, ddim, dpm_solver, initial_noise, lcm, trailing_timesteps

Sampler = Literal["ddim", "dpm", "lcm"]


@dataclass(frozen=True)
class Sampling:
    """How views are sampled."""

    steps: int = 4
    sampler: Sampler = "ddim"
    guidance: float = 1.0
    seed: int = 0


def sampled(
    model: Model,
    photo: Float[Tensor, "objects 3 height width"],
    world_from_camera: Float[Tensor, "objects views 4 4"],
    sampling: Sampling,
    drafts: Float[Tensor, "objects 2 views 3 height width"] | None = None,
) -> Iterator[Step]:
    """The sampler's steps over latents (objects, 2, views, channels, rows, columns): colour, then depth.

    drafts  guesses at the views, for a model that mends them

    Raises UsageError for a number of steps that the schedule does not have.
    """
    timesteps = trailing_timesteps(model.schedule, sampling.steps)
    tasks = torch.tensor([[COLOUR, DEPTH]], device=photo.device).expand(len(photo), -1)
    with torch.no_grad():
        condition = model.condition(photo, world_from_camera, tasks, drafts)
    shape = (len(photo), 2, world_from_camera.shape[1], *condition.photo_latent.shape[1:])
    latents = initial_noise(shape, sampling.seed, photo.float())
    predict = guided(model.network, condition, sampling.guidance)
    match sampling.sampler:
        case "ddim":
            return ddim(predict, latents, model.schedule, timesteps)
        case "dpm":
            return dpm_solver(predict, latents, model.schedule, timesteps)
        case "lcm":
            again = torch.Generator().manual_seed(sampling.seed + 1)
            return lcm(predict, latents, model.schedule, timesteps, again)


@torch.no_grad()
def generated(
    model: Model,
    photo: Float[Tensor, "objects 3 height width"],
    world_from_camera: Float[Tensor, "objects views 4 4"],
    sampling: Sampling,
    drafts: Float[Tensor, "objects 2 views 3 height width"] | None = None,
) -> tuple[Float[Tensor, "objects views 3 height width"], Float[Tensor, "objects views height width"]]:
    """(colours, depths) of the photo's views; no depth is cut off: what lies at the far side may be background."""
    *_, last = sampled(model, photo, world_from_camera, sampling, drafts)
    color, depth = model.autoencoder.decode(last.clean).float().unbind(dim=1)
    return color.clamp(-1, 1), depth_from_pictures(depth, farthest=2.0)
