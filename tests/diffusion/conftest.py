"""A tiny network of the real layout, and a condition for it."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from mv3d_cli.diffusion.model import Model
from mv3d_cli.diffusion.model.config import ModelConfig
from mv3d_cli.diffusion.network import MultiViewUNet
from mv3d_cli.diffusion.network.conditioning import Condition
from mv3d_cli.formats.cameras import load_cameras

LATENT, TOKEN_WIDTH = 4, 12


@pytest.fixture
def unet_config() -> dict[str, Any]:
    return {
        "sample_size": 8,
        "in_channels": 2 * LATENT,
        "out_channels": LATENT,
        "block_out_channels": (8, 8, 16),
        "down_block_types": ("CrossAttnDownBlock2D", "CrossAttnDownBlock2D", "DownBlock2D"),
        "up_block_types": ("UpBlock2D", "CrossAttnUpBlock2D", "CrossAttnUpBlock2D"),
        "layers_per_block": 1,
        "attention_head_dim": 2,
        "cross_attention_dim": TOKEN_WIDTH,
        "norm_num_groups": 4,
    }


@pytest.fixture
def network(unet_config: dict[str, Any]) -> MultiViewUNet:
    torch.manual_seed(0)
    return MultiViewUNet(unet_config, positions=False).eval()


@pytest.fixture
def model(smallest: ModelConfig) -> Model:
    torch.manual_seed(0)
    return Model(smallest).eval()


@pytest.fixture
def latents() -> torch.Tensor:
    return torch.randn(2, 2, 3, LATENT, 8, 8, generator=torch.Generator().manual_seed(1))


@pytest.fixture
def timestep() -> torch.Tensor:
    return torch.tensor([700, 20])


@pytest.fixture
def condition() -> Condition:
    return condition_of(views=3)


def condition_of(views: int, objects: int = 2) -> Condition:
    """The first `views` cameras of the rig, for a drawn photo."""
    generator = torch.Generator().manual_seed(2)
    poses = torch.stack([torch.tensor(c.world_from_camera, dtype=torch.float32) for c in load_cameras(None)[:views]])
    return Condition(
        photo_latent=torch.randn(objects, LATENT, 8, 8, generator=generator),
        tokens=torch.randn(objects, 5, TOKEN_WIDTH, generator=generator),
        world_from_camera=poses.expand(objects, -1, -1, -1),
        tasks=torch.tensor([[0, 1]]).expand(objects, -1),
    )
