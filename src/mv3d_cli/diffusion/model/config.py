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
    autoencoder   of diffusers' `AutoencoderKL`, working on squares of `patch` pixels
    patch_tokens  of our small photo encoder, or None
    clip          of the `CLIPVisionModelWithProjection` that stands in its place, or None
    positions     whether attention is told where in the picture its tokens are
    """

    network: dict[str, Any]
    autoencoder: dict[str, Any]
    patch_tokens: dict[str, int] | None = None
    clip: dict[str, Any] | None = None
    noise: NoiseSettings = field(default_factory=NoiseSettings)
    patch: int = 1
    positions: bool = False
    picture_size: int = 256


def text_from_config(config: ModelConfig) -> str:
    """The configuration as JSON."""
    return json.dumps(asdict(config), indent=2, sort_keys=True)


def config_from_text(text: str, name: str) -> ModelConfig:
    """The inverse of `text_from_config`; `name` says whose it is. Raises BadWeights."""
    try:
        values = json.loads(text)
        return ModelConfig(**values | {"noise": NoiseSettings(**values["noise"])})
    except (ValueError, TypeError, KeyError) as error:
        raise BadWeights(
            f"{name} is not the configuration of a model: {error}", "copy the whole model folder again, or train anew"
        ) from error


def small() -> ModelConfig:
    """The bundled model's: its parameters sit in transformer blocks at 16 x 16 and 8 x 8, where a CPU is fastest.

    Matrix products in bf16 run about three times as efficiently as convolutions there. Latents are 8 x 32 x 32.
    """
    latent = 8
    return ModelConfig(
        network={
            "sample_size": 32,
            "in_channels": 2 * latent,
            "out_channels": latent,
            "block_out_channels": (64, 160, 256),
            "down_block_types": ("DownBlock2D", "CrossAttnDownBlock2D", "CrossAttnDownBlock2D"),
            "up_block_types": ("CrossAttnUpBlock2D", "CrossAttnUpBlock2D", "UpBlock2D"),
            "layers_per_block": 1,
            "transformer_layers_per_block": (1, 1, 2),
            "attention_head_dim": (1, 2, 4),  # diffusers' name for the number of heads
            "cross_attention_dim": 192,
            "use_linear_projection": True,
        },
        autoencoder={
            "in_channels": 3 * 4**2,
            "out_channels": 3 * 4**2,
            "latent_channels": latent,
            "block_out_channels": (96, 128),
            "down_block_types": ("DownEncoderBlock2D",) * 2,
            "up_block_types": ("UpDecoderBlock2D",) * 2,
            "layers_per_block": 1,
            "norm_num_groups": 16,
            "scaling_factor": 1.0,
        },
        patch_tokens={"size": 256, "patch": 16, "width": 192, "layers": 3, "heads": 3},
        patch=4,
        positions=True,
    )
