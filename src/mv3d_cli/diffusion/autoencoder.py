"""Pictures <-> latents. Pictures are (channel, height, width) in [-1, 1]; latents have zero mean and unit deviation.

Depth has one channel, in scene units; it becomes three only on its way into the autoencoder.
"""

from __future__ import annotations

from typing import Any

import torch
from diffusers.models.autoencoders.autoencoder_kl import AutoencoderKL
from diffusers.models.autoencoders.vae import DiagonalGaussianDistribution
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from mv3d_cli.scene.conventions import RIG_RADIUS


class Autoencoder(nn.Module):
    """A KL autoencoder, optionally on small patches instead of pixels: its convolutions then run at low resolution.

    config  of the `AutoencoderKL`; its channels are 3 * patch^2
    patch   side, in pixels, of the squares that are folded into channels
    """

    latent_mean: Tensor
    latent_deviation: Tensor

    def __init__(self, config: dict[str, Any], patch: int = 1):
        super().__init__()
        self.kl: AutoencoderKL = AutoencoderKL.from_config(config)  # type: ignore[assignment]
        self.patch = patch
        channels = self.kl.config["latent_channels"]
        shift, scale = self.kl.config["shift_factor"] or 0.0, self.kl.config["scaling_factor"]
        self.register_buffer("latent_mean", torch.full((channels,), shift))
        self.register_buffer("latent_deviation", torch.full((channels,), 1 / scale))

    def forward(self, pictures: Float[Tensor, "batch 3 height width"]) -> tuple[Tensor, DiagonalGaussianDistribution]:
        """(the pictures again, from one draw of their latents; the posterior), for training."""
        posterior = self.posterior(pictures)
        return self._pictures(posterior.sample()), posterior

    def posterior(self, pictures: Float[Tensor, "batch 3 height width"]) -> DiagonalGaussianDistribution:
        """Mean and variance of the latents, not yet normalised."""
        return self.kl.encode(functional.pixel_unshuffle(pictures, self.patch), return_dict=False)[0]

    def encode(self, pictures: Float[Tensor, "*batch 3 height width"]) -> Float[Tensor, "*batch channels rows columns"]:
        """The pictures' mean latents, normalised."""
        batch = pictures.shape[:-3]
        mean = self.posterior(pictures.reshape(-1, *pictures.shape[-3:]).to(self._dtype)).mode()
        latents = (mean - self.latent_mean.view(-1, 1, 1)) / self.latent_deviation.view(-1, 1, 1)
        return latents.reshape(*batch, *latents.shape[-3:])

    def decode(self, latents: Float[Tensor, "*batch channels rows columns"]) -> Float[Tensor, "*batch 3 height width"]:
        """The pictures of normalised latents: the inverse of `encode`, as well as it is learned. Not clipped."""
        batch = latents.shape[:-3]
        flat = latents.reshape(-1, *latents.shape[-3:]).to(self._dtype)
        pictures = self._pictures(flat * self.latent_deviation.view(-1, 1, 1) + self.latent_mean.view(-1, 1, 1))
        return pictures.reshape(*batch, *pictures.shape[-3:])

    def calibrate(self, mean_latents: Float[Tensor, "batch channels rows columns"]) -> None:
        """Take the normalisation from posterior means of typical pictures."""
        self.latent_mean.copy_(mean_latents.mean(dim=(0, 2, 3)))
        self.latent_deviation.copy_(mean_latents.std(dim=(0, 2, 3)).clamp_min(1e-4))

    def _pictures(self, latents: Tensor) -> Tensor:
        folded = self.kl.decode(latents, return_dict=False)[0]  # type: ignore[arg-type]
        return functional.pixel_shuffle(folded, self.patch)

    @property
    def _dtype(self) -> torch.dtype:
        return self.latent_mean.dtype


def pictures_from_depth(depth: Float[Tensor, "*batch height width"]) -> Float[Tensor, "*batch 3 height width"]:
    """Depth as the model sees it: -1 at the unit sphere's near side, 1 at its far side or without a surface."""
    near = RIG_RADIUS - 1
    unit = torch.where(depth > 0, (depth - near) / 2, 1.0).clamp(0, 1)
    return (unit * 2 - 1).unsqueeze(-3).expand(*unit.shape[:-2], 3, *unit.shape[-2:])


def depth_from_pictures(
    pictures: Float[Tensor, "*batch 3 height width"], farthest: float = 0.95
) -> Float[Tensor, "*batch height width"]:
    """Depth in scene units: the inverse of `pictures_from_depth`; beyond `farthest` of the range is no surface."""
    unit = ((pictures.mean(dim=-3) + 1) / 2).clamp(0, 1)
    return torch.where(unit < farthest, unit * 2 + RIG_RADIUS - 1, 0.0)
