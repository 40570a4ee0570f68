"""A whole model: the multi-view network, the autoencoder of its latents, and the encoder of the photo."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from mv3d_cli.diffusion.autoencoder import Autoencoder
from mv3d_cli.diffusion.encoders import ClipTokens, PatchTokens
from mv3d_cli.diffusion.model.config import ModelConfig
from mv3d_cli.diffusion.network import MultiViewUNet
from mv3d_cli.diffusion.network.conditioning import Condition
from mv3d_cli.diffusion.noise import schedule_from_settings


class Model(nn.Module):
    """The three networks, drawn from torch's global generator, and the schedule they were made for.

    Raises MissingDependency for CLIP without its package.
    """

    def __init__(self, config: ModelConfig):
        super().__init__()
        self.config = config
        self.schedule = schedule_from_settings(config.noise)
        self.network = MultiViewUNet(config.network, config.positions)
        self.autoencoder = Autoencoder(config.autoencoder, config.patch)
        self.encoder = ClipTokens(config.clip) if config.clip else PatchTokens(**config.patch_tokens or {})

    def condition(
        self,
        photo: Float[Tensor, "objects 3 height width"],
        world_from_camera: Float[Tensor, "objects views 4 4"],
        tasks: Int[Tensor, "objects domains"],
    ) -> Condition:
        """What the network is told of these photos (in [-1, 1]); gradients reach the photo encoder only."""
        with torch.no_grad():
            photo_latent = self.autoencoder.encode(photo)
        return Condition(photo_latent, self.encoder(photo), world_from_camera, tasks)
