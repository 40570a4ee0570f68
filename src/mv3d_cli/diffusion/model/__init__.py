"""A whole model: the multi-view network, the autoencoder of its latents, and the encoder of the photo."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from mv3d_cli.diffusion.autoencoder import Autoencoder, Folding, Projection
from mv3d_cli.diffusion.encoders import ClipTokens, PatchTokens
from mv3d_cli.diffusion.model.config import ModelConfig
from mv3d_cli.diffusion.network import MultiViewUNet
from mv3d_cli.diffusion.network.conditioning import Condition
from mv3d_cli.diffusion.network.mending import Mending
from mv3d_cli.diffusion.noise import schedule_from_settings


class Model(nn.Module):
    """The three networks, drawn from torch's global generator, and the schedule they were made for.

    Raises MissingDependency for CLIP without its package, ValueError where the parts do not go together.
    """

    def __init__(self, config: ModelConfig):
        super().__init__()
        self.config = config
        self.schedule = schedule_from_settings(config.noise)
        mending = Mending(self.schedule, config.network["out_channels"]) if config.drafts else None
        self.network = MultiViewUNet(config.network, config.positions, mending)
        self.autoencoder = _autoencoder(config)
        _check_parts(config)
        self.encoder = ClipTokens(config.clip) if config.clip else PatchTokens(**config.patch_tokens or {})

    def condition(
        self,
        photo: Float[Tensor, "objects 3 height width"],
        world_from_camera: Float[Tensor, "objects views 4 4"],
        tasks: Int[Tensor, "objects domains"],
        drafts: Float[Tensor, "objects domains views 3 height width"] | None = None,
    ) -> Condition:
        """What the network is told of these photos and drafts (in [-1, 1], depth too).

        Gradients reach the photo encoder only.
        """
        with torch.no_grad():
            photo_latent = self.autoencoder.encode(photo)
            known = self.autoencoder.encode(drafts) if self.config.drafts and drafts is not None else None
        return Condition(photo_latent, self.encoder(photo), world_from_camera, tasks, known)


def _check_parts(config: ModelConfig) -> None:
    """Raises ValueError unless the network takes a noisy latent and the photo's, and says what is clean of drafts."""
    if config.drafts and config.noise.prediction != "sample":
        raise ValueError("a network that mends drafts predicts what is clean")
    if config.autoencoder:
        channels = config.autoencoder.get("latent_channels", 4)
    else:
        channels = config.projection["channels"] if config.projection else 3 * config.patch**2
    if config.network.get("in_channels", 4) != 2 * channels:
        taken = config.network.get("in_channels", 4)
        raise ValueError(f"its conv_in takes {taken} channels, and two latents have {2 * channels}")


def _autoencoder(config: ModelConfig) -> Autoencoder | Projection | Folding:
    if config.autoencoder:
        return Autoencoder(config.autoencoder)
    return Projection(**config.projection) if config.projection else Folding(config.patch)
