from __future__ import annotations

import numpy as np
import pytest
import torch
from diffusers import AutoencoderKL
from torch import Tensor

from mv3d_cli.diffusion.autoencoder import (
    Autoencoder,
    Folding,
    Projection,
    depth_from_pictures,
    pictures_from_depth,
)

KL = {
    "latent_channels": 4,
    "block_out_channels": (8, 8),
    "down_block_types": ("DownEncoderBlock2D",) * 2,
    "up_block_types": ("UpDecoderBlock2D",) * 2,
    "norm_num_groups": 4,
}


def smooth(count: int, side: int = 16, seed: int = 0) -> Tensor:
    """Pictures of a few waves each, somewhat brighter than grey: most of a square lies along few directions."""
    draw = torch.Generator().manual_seed(seed)
    y, x = torch.meshgrid(torch.linspace(0, 3, side), torch.linspace(0, 3, side), indexing="ij")
    across, down, phase, size = torch.rand(4, count, 3, 1, 1, generator=draw)
    return 0.2 + size * torch.sin(2 * across * x + 2 * down * y + 6 * phase)


def projection(patch: int = 4, channels: int = 12) -> Projection:
    """Fitted to smooth pictures."""
    ours = Projection(patch, channels)
    ours.fit(smooth(64))
    return ours


def squares_of(pictures: Tensor, patch: int) -> np.ndarray:
    """One row a square, channels first."""
    cut = pictures.unfold(2, patch, patch).unfold(3, patch, patch)  # batch, channel, row, column, y, x
    return cut.permute(0, 2, 3, 1, 4, 5).flatten(3).flatten(0, 2).double().numpy()


@torch.no_grad()
@pytest.mark.parametrize("shift", [None, 0.3])
def test_stable_diffusions_is_diffusers_autoencoder(shift: float | None) -> None:
    torch.manual_seed(0)
    ours = Autoencoder(KL | {"scaling_factor": 0.18215, "shift_factor": shift}).eval()
    pictures = torch.rand(2, 3, 3, 16, 16) * 2 - 1
    theirs = AutoencoderKL.from_config(ours.kl.config).eval()
    theirs.load_state_dict(ours.kl.state_dict())
    latents = ours.encode(pictures)
    expected = (theirs.encode(pictures.flatten(0, 1)).latent_dist.mode() - (shift or 0)) * 0.18215
    torch.testing.assert_close(latents.flatten(0, 1), expected, atol=1e-6, rtol=1e-5)
    decoded = theirs.decode(expected / 0.18215 + (shift or 0)).sample
    torch.testing.assert_close(ours.decode(latents).flatten(0, 1), decoded, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("patch", [4, 8])
def test_the_directions_are_the_principal_ones(patch: int) -> None:
    """Against numpy's singular vectors, whose signs are free."""
    ours, squares = projection(patch), squares_of(smooth(64), patch)
    _, lengths, directions = np.linalg.svd(squares - squares.mean(axis=0), full_matrices=False)
    assert np.allclose(ours.mean, squares.mean(axis=0), atol=1e-5)
    assert np.allclose(np.abs((ours.basis.double().numpy() * directions[:12]).sum(axis=1)), 1, atol=1e-3)
    strength = lengths[:12] / np.sqrt(len(squares))
    assert np.allclose(ours.deviation, np.sqrt(strength * strength.mean()), rtol=1e-3)


@torch.no_grad()
def test_latents_are_whitened_halfway() -> None:
    """A direction's deviation becomes the root of what it was, over all of them about one."""
    ours, pictures = projection(), smooth(64)
    latents = ours.encode(pictures)
    assert latents.shape == (64, 12, 4, 4)
    assert latents.mean(dim=(0, 2, 3)).abs().max() < 1e-3
    squares = squares_of(pictures, 4)
    strength = np.linalg.svd(squares - squares.mean(axis=0), compute_uv=False)[:12] / np.sqrt(len(squares))
    power = latents.square().mean(dim=(0, 2, 3))
    assert np.allclose(power, strength / strength.mean(), rtol=1e-2)
    assert power.mean() == pytest.approx(1, rel=1e-3)


@torch.no_grad()
def test_what_is_lost_is_what_the_other_directions_held() -> None:
    """With all directions nothing is lost. The second time none is."""
    pictures = smooth(64)
    squares = squares_of(pictures, 4)
    lengths = np.linalg.svd(squares - squares.mean(axis=0), compute_uv=False)
    for channels in (3, 12, 48):
        ours = projection(channels=channels)
        again = ours.decode(ours.encode(pictures))
        error = (again - pictures).double().square().sum().item()
        assert error == pytest.approx((lengths[channels:] ** 2).sum(), rel=1e-3, abs=1e-5)
        torch.testing.assert_close(ours.decode(ours.encode(again)), again, atol=1e-4, rtol=0)


@torch.no_grad()
@pytest.mark.parametrize("patch", [4, 8, 16])
def test_pictures_come_in_any_arrangement(patch: int) -> None:
    ours = projection(patch)
    pictures = smooth(6, 32).unflatten(0, (2, 3))
    latents = ours.encode(pictures)
    assert latents.shape == (2, 3, 12, 32 // patch, 32 // patch)
    together = ours.decode(latents)
    assert together.shape == pictures.shape
    alone = torch.stack([ours.decode(ours.encode(picture)) for picture in pictures.flatten(0, 1)])
    torch.testing.assert_close(alone, together.flatten(0, 1), atol=1e-5, rtol=1e-5)


def test_autocast_leaves_the_projection_exact() -> None:
    ours, pictures = projection(), smooth(4)
    latents, again = ours.encode(pictures), ours.decode(ours.encode(pictures))
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(ours.encode(pictures), latents)
        assert torch.equal(ours.decode(latents), again)


@torch.no_grad()
def test_decoding_in_portions_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    ours, latents = Autoencoder(KL).eval(), torch.randn(5, 4, 4, 4)
    together = ours.decode(latents)
    monkeypatch.setattr("mv3d_cli.diffusion.autoencoder._PLACES_AT_ONCE", 1)
    torch.testing.assert_close(ours.decode(latents), together, atol=1e-5, rtol=1e-5)


def test_depth_goes_to_three_channels_and_back() -> None:
    depth = torch.tensor([[1.0, 1.5, 2.0], [2.7, 0.0, 1.2]]).expand(2, 4, 2, 3)
    pictures = pictures_from_depth(depth)
    assert pictures.shape == (2, 4, 3, 2, 3)
    torch.testing.assert_close(pictures[0, 0, 1], torch.tensor([[-1.0, -0.5, 0.0], [0.7, 1.0, -0.8]]))
    torch.testing.assert_close(depth_from_pictures(pictures), depth)


def test_the_projection_is_saved_with_the_weights() -> None:
    ours, other = projection(), Projection(4, 12)
    assert not other.encode(smooth(1)).any()
    other.load_state_dict(ours.state_dict())
    assert torch.equal(other.encode(smooth(2)), ours.encode(smooth(2)))
    assert torch.equal(other.decode(torch.ones(1, 12, 2, 2)), ours.decode(torch.ones(1, 12, 2, 2)))


@pytest.mark.parametrize("patch", [1, 2, 4])
def test_folding_loses_nothing(patch: int) -> None:
    """Each place holds the pixels of its square, and unfolded they are where they were."""
    folding, pictures = Folding(patch), torch.randn(2, 3, 3, 8, 16)
    latents = folding.encode(pictures)
    assert latents.shape == (2, 3, 3 * patch**2, 8 // patch, 16 // patch)
    torch.testing.assert_close(folding.decode(latents), pictures, atol=0, rtol=0)
    square = pictures[1, 2, :, 8 - patch :, patch : 2 * patch]
    torch.testing.assert_close(latents[1, 2, :, -1, 1], square.flatten(), atol=0, rtol=0)
    assert not [*folding.parameters()]
