from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image

from mv3d_cli.diffusion.encoders import ClipTokens, PatchTokens

CLIP = {
    "hidden_size": 16,
    "intermediate_size": 32,
    "num_hidden_layers": 2,
    "num_attention_heads": 2,
    "image_size": 28,
    "patch_size": 14,
    "projection_dim": 12,
}


@torch.no_grad()
def test_each_patch_gives_a_token_and_the_photo_matters() -> None:
    encoder, photo = PatchTokens(32, 8, 16, 2, 2).eval(), torch.rand(2, 3, 32, 32) * 2 - 1
    tokens = encoder(photo)
    assert tokens.shape == (2, 16, 16)
    photo[0, :, :8, :8] *= -1
    difference = (encoder(photo) - tokens).abs().amax(-1)
    assert difference[0, 0] > difference[0, 1:].max() > 0
    assert difference[1].max() == 0


@torch.no_grad()
def test_equal_patches_in_different_places_are_different_tokens() -> None:
    tokens = PatchTokens(32, 8, 16, 1, 2).eval()(torch.ones(1, 3, 32, 32))[0]
    assert (torch.cdist(tokens, tokens) + torch.eye(16)).min() > 0.1


@torch.no_grad()
def test_other_sizes_are_brought_to_the_encoders_own() -> None:
    encoder = PatchTokens(32, 8, 16, 1, 2).eval()
    small, large = (torch.sin(3 * (torch.arange(n) + 0.5) / n).expand(1, 3, n, n) for n in (32, 64))
    assert (encoder(large) - encoder(small)).abs().max() < 0.02 * (encoder(-small) - encoder(small)).abs().max()


@torch.no_grad()
def test_clip_sees_what_its_own_processor_shows_it() -> None:
    transformers = pytest.importorskip("transformers")
    torch.manual_seed(0)
    encoder = ClipTokens(CLIP).eval()
    pixels = np.random.default_rng(0).integers(0, 256, (28, 28, 3), dtype=np.uint8)
    mean, deviation = transformers.image_utils.OPENAI_CLIP_MEAN, transformers.image_utils.OPENAI_CLIP_STD
    shown = torch.tensor((np.asarray(Image.fromarray(pixels)) / 255 - mean) / deviation).permute(2, 0, 1)[None].float()
    photo = torch.tensor(pixels).permute(2, 0, 1)[None] / 127.5 - 1
    token = encoder(photo)
    assert token.shape == (1, 1, 12)
    torch.testing.assert_close(token[:, 0], encoder.clip(pixel_values=shown).image_embeds, atol=1e-5, rtol=1e-4)
    assert (encoder(photo * 0.5) - token).abs().max() > 1e-3
