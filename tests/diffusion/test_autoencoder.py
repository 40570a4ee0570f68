from __future__ import annotations

from typing import Any

import pytest
import torch
from diffusers import AutoencoderKL

from mv3d_cli.diffusion.autoencoder import Autoencoder, depth_from_pictures, pictures_from_depth

TINY = {
    "latent_channels": 4,
    "block_out_channels": (8, 8),
    "down_block_types": ("DownEncoderBlock2D",) * 2,
    "up_block_types": ("UpDecoderBlock2D",) * 2,
    "norm_num_groups": 4,
}


def tiny(patch: int = 1, **changes: Any) -> Autoencoder:
    torch.manual_seed(0)
    channels = 3 * patch**2
    return Autoencoder(TINY | {"in_channels": channels, "out_channels": channels} | changes, patch).eval()


@torch.no_grad()
def test_without_patches_it_is_diffusers_autoencoder() -> None:
    ours, pictures = tiny(scaling_factor=0.18215), torch.rand(2, 3, 3, 16, 16) * 2 - 1
    theirs = AutoencoderKL.from_config(ours.kl.config).eval()
    theirs.load_state_dict(ours.kl.state_dict())
    latents = ours.encode(pictures)
    expected = theirs.encode(pictures.flatten(0, 1)).latent_dist.mode() * 0.18215
    torch.testing.assert_close(latents.flatten(0, 1), expected, atol=1e-6, rtol=1e-5)
    decoded = theirs.decode(expected / 0.18215).sample
    torch.testing.assert_close(ours.decode(latents).flatten(0, 1), decoded, atol=1e-5, rtol=1e-5)


@torch.no_grad()
@pytest.mark.parametrize("patch", [1, 2, 4])
def test_patches_only_change_the_resolution(patch: int) -> None:
    ours, pictures = tiny(patch), torch.rand(1, 3, 32, 16) * 2 - 1
    latents = ours.encode(pictures)
    assert latents.shape == (1, 4, 16 // patch, 8 // patch)
    assert ours.decode(latents).shape == pictures.shape


@torch.no_grad()
def test_calibrated_latents_have_zero_mean_and_unit_deviation() -> None:
    ours, pictures = tiny(2), torch.rand(8, 3, 32, 32) ** 3
    before = ours.decode(ours.encode(pictures))
    ours.calibrate(ours.posterior(pictures).mode())
    latents = ours.encode(pictures)
    torch.testing.assert_close(latents.mean((0, 2, 3)), torch.zeros(4), atol=1e-4, rtol=0)
    torch.testing.assert_close(latents.std((0, 2, 3)), torch.ones(4), atol=1e-4, rtol=0)
    torch.testing.assert_close(ours.decode(latents), before, atol=1e-4, rtol=1e-4)


def test_it_learns_one_picture() -> None:
    ours = tiny(2).train()
    rows = torch.linspace(-1, 1, 16)
    picture = torch.stack([rows[:, None].expand(16, 16), rows.expand(16, 16), rows[:, None] * rows])[None]
    optimizer, errors = torch.optim.Adam(ours.parameters(), 5e-3), []
    for _ in range(60):
        again, posterior = ours(picture)
        error = (again - picture).square().mean()
        optimizer.zero_grad()
        (error + 1e-6 * posterior.kl().mean()).backward()
        optimizer.step()
        errors.append(error.item())
    assert errors[-1] < 0.1 * errors[0]


def test_depth_goes_to_three_channels_and_back() -> None:
    depth = torch.tensor([[1.0, 1.5, 2.0], [2.7, 0.0, 1.2]]).expand(2, 4, 2, 3)
    pictures = pictures_from_depth(depth)
    assert pictures.shape == (2, 4, 3, 2, 3)
    torch.testing.assert_close(pictures[0, 0, 1], torch.tensor([[-1.0, -0.5, 0.0], [0.7, 1.0, -0.8]]))
    torch.testing.assert_close(depth_from_pictures(pictures), depth)


def test_the_latents_normalisation_is_saved_with_the_weights() -> None:
    ours, other = tiny(), tiny()
    ours.calibrate(torch.randn(2, 4, 3, 3) * 5 + 2)
    other.load_state_dict(ours.state_dict())
    torch.testing.assert_close(other.latent_deviation, ours.latent_deviation)
    assert (other.latent_mean - 2).abs().max() < 5
    assert (other.latent_deviation > 2).all()
