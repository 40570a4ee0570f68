"""What a model is made of, as plain values: they travel in `config.json` and inside the weights file."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from typing import Any

from mv3d_cli.diffusion.noise import NoiseSettings
from mv3d_cli.errors import BadWeights


@dataclass(frozen=True)
class ModelConfig:
    """The parts of a model.

    network       of diffusers' `UNet2DConditionModel`
    autoencoder   of diffusers' `AutoencoderKL`, or None
    projection    of our small autoencoder, or None
    patch         where there is neither: side of the squares of pixels that are the latents
    patch_tokens  of our small photo encoder, or None
    clip          of the `CLIPVisionModelWithProjection` that stands in its place, or None
    positions     whether attention is told where in the picture its tokens are
    views         names of the views that it was last taught, the photo's first; none: it was taught nothing
    drafts        whether the network mends drafts of the views instead of looking at the photo's latent
    """

    network: dict[str, Any]
    autoencoder: dict[str, Any] | None = None
    projection: dict[str, int] | None = None
    patch_tokens: dict[str, int] | None = None
    clip: dict[str, Any] | None = None
    noise: NoiseSettings = field(default_factory=NoiseSettings)
    patch: int = 1
    positions: bool = False
    drafts: bool = False
    views: tuple[str, ...] = ()
    picture_size: int = 256


def text_from_config(config: ModelConfig) -> str:
    """The configuration as JSON."""
    return json.dumps(asdict(config), indent=2, sort_keys=True)


def config_from_text(text: str, name: str) -> ModelConfig:
    """The inverse of `text_from_config`; `name` says whose it is. Raises BadWeights."""
    try:
        values = json.loads(text)
        parts = {"noise": NoiseSettings(**values["noise"]), "views": tuple(values.get("views", ()))}
        return ModelConfig(**values | parts)
    except (ValueError, TypeError, KeyError) as error:
        raise BadWeights(
            f"{name} is not the configuration of a model: {error}", "copy the whole model folder again, or train anew"
        ) from error


def small() -> ModelConfig:
    """The bundled model's: latents of 64 x 16 x 16, the parameters in transformer blocks at 8 x 8 and 4 x 4.

    Matrix products in bf16 run about three times as efficiently as convolutions on a CPU, and few tokens keep joint
    attention cheap.
    """
    latent = 64
    return ModelConfig(
        network={
            "sample_size": 16,
            "in_channels": 2 * latent,
            "out_channels": latent,
            "block_out_channels": (32, 96, 192),
            "down_block_types": ("DownBlock2D", "CrossAttnDownBlock2D", "CrossAttnDownBlock2D"),
            "up_block_types": ("CrossAttnUpBlock2D", "CrossAttnUpBlock2D", "UpBlock2D"),
            "layers_per_block": 1,
            "transformer_layers_per_block": (1, 1, 1),
            "attention_head_dim": (1, 2, 4),  # diffusers' name for the number of heads
            "cross_attention_dim": 192,
            "use_linear_projection": True,
        },
        projection={"patch": 16, "channels": latent},
        patch_tokens={"size": 128, "patch": 16, "width": 192, "layers": 2, "heads": 3},
        noise=NoiseSettings(prediction="sample"),
        positions=True,
        drafts=True,
    )


def tiny() -> ModelConfig:
    """For experiments and for trying out a data set: 32 x 32 pixels in squares of 4 x 4, no autoencoder."""
    return ModelConfig(
        network={
            "sample_size": 8,
            "in_channels": 2 * 48,
            "out_channels": 48,
            "block_out_channels": (96, 192),
            "down_block_types": ("DownBlock2D", "CrossAttnDownBlock2D"),
            "up_block_types": ("CrossAttnUpBlock2D", "UpBlock2D"),
            "layers_per_block": 1,
            "transformer_layers_per_block": 1,
            "attention_head_dim": (2, 3),
            "cross_attention_dim": 128,
            "use_linear_projection": True,
        },
        patch_tokens={"size": 32, "patch": 4, "width": 128, "layers": 2, "heads": 2},
        patch=4,
        noise=NoiseSettings(prediction="sample"),
        positions=True,
        drafts=True,
        picture_size=32,
    )
