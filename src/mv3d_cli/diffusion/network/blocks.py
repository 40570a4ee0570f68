"""The transformer block that lets views, and then colour and depth, see each other.

The U-Net works on rows, `row = (object * domains + domain) * views + view`, so that the tokens of all views of one
(object, domain) lie together in memory: joint attention is a reshape, and no key or value is copied.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch
from diffusers.models.attention import BasicTransformerBlock
from diffusers.models.attention_processor import Attention
from diffusers.models.transformers.transformer_2d import Transformer2DModel
from diffusers.models.unets.unet_2d_condition import UNet2DConditionModel
from jaxtyping import Float
from torch import Tensor, nn


@dataclass(frozen=True)
class Arrangement:
    """What the rows of a batch are, and who may see whom."""

    objects: int
    domains: int
    views: int
    across_views: bool = True
    across_domains: bool = True


class MultiViewBlock(nn.Module):
    """A plain block's layers under their own names, with multi-view and (where asked) colour-depth attention.

    Photo tokens come once per object. With `positions`, attention is told each token's place in the (square) picture;
    without, only the convolutions around the block know it, as in Stable Diffusion.
    """

    def __init__(self, plain: BasicTransformerBlock, colour_depth: bool, positions: bool):
        super().__init__()
        assert plain.norm2 is not None
        assert plain.attn2 is not None
        assert plain.norm3 is not None
        self.norm1, self.attn1 = plain.norm1, plain.attn1
        self.norm2, self.attn2 = plain.norm2, plain.attn2
        self.norm3, self.ff = plain.norm3, plain.ff
        self.positions = positions
        self.norm_domains = nn.LayerNorm(plain.dim) if colour_depth else None
        self.attn_domains = _silent_attention(plain) if colour_depth else None

    def forward(
        self,
        hidden_states: Float[Tensor, "rows tokens channels"],
        attention_mask: None = None,
        encoder_hidden_states: Float[Tensor, "objects photo_tokens features"] | None = None,
        encoder_attention_mask: None = None,
        timestep: None = None,
        cross_attention_kwargs: dict[str, Any] | None = None,
        class_labels: None = None,
    ) -> Float[Tensor, "rows tokens channels"]:
        """The block's output; the signature is that of `BasicTransformerBlock`."""
        assert cross_attention_kwargs is not None
        arrangement: Arrangement = cross_attention_kwargs["arrangement"]
        hidden = hidden_states + self._across_views(hidden_states, arrangement)
        if self.attn_domains is not None and arrangement.across_domains:
            hidden = hidden + self._across_domains(hidden, arrangement)
        hidden = hidden + self._from_photo(hidden, encoder_hidden_states, arrangement)
        return hidden + self.ff(self.norm3(hidden))

    def _across_views(self, hidden: Tensor, arrangement: Arrangement) -> Tensor:
        """Self-attention; the tokens of all views of one (object, domain) attend jointly."""
        rows, tokens, channels = hidden.shape
        together = arrangement.views if arrangement.across_views else 1
        joint = self._placed(self.norm1(hidden)).reshape(rows // together, together * tokens, channels)
        return self.attn1(joint).view_as(hidden)

    def _across_domains(self, hidden: Tensor, arrangement: Arrangement) -> Tensor:
        """The tokens of all domains of one (object, view) attend jointly."""
        assert self.norm_domains is not None
        assert self.attn_domains is not None
        _, tokens, channels = hidden.shape
        objects, domains, views = arrangement.objects, arrangement.domains, arrangement.views
        normed = self._placed(self.norm_domains(hidden)).view(objects, domains, views, tokens, channels)
        pairs = normed.transpose(1, 2).reshape(objects * views, domains * tokens, channels)
        attended = self.attn_domains(pairs).view(objects, views, domains, tokens, channels)
        return attended.transpose(1, 2).reshape_as(hidden)

    def _from_photo(self, hidden: Tensor, photo: Tensor | None, arrangement: Arrangement) -> Tensor:
        """Cross-attention to the photo's tokens: keys and values once per object."""
        per_object = self._placed(self.norm2(hidden)).reshape(arrangement.objects, -1, hidden.shape[-1])
        return self.attn2(per_object, encoder_hidden_states=photo).view_as(hidden)

    def _placed(self, normed: Tensor) -> Tensor:
        tokens, channels = normed.shape[1:]
        return normed + _positions(math.isqrt(tokens), channels).to(normed) if self.positions else normed


def let_views_meet(unet: UNet2DConditionModel, positions: bool) -> None:
    """Swap every transformer block of a U-Net for its multi-view self, weights and names kept.

    Colour and depth meet in the middle block and in the last up block that has cross-attention.
    """
    last_up = [block for block in unet.up_blocks if getattr(block, "has_cross_attention", False)][-1]
    meeting = {id(module) for part in (unet.mid_block, last_up) for module in part.modules()}
    for transformer in [module for module in unet.modules() if isinstance(module, Transformer2DModel)]:
        for index, plain in enumerate(transformer.transformer_blocks):
            assert isinstance(plain, BasicTransformerBlock)
            transformer.transformer_blocks[index] = MultiViewBlock(plain, id(transformer) in meeting, positions)


def _silent_attention(plain: BasicTransformerBlock) -> Attention:
    """Attention of the block's own shape whose output starts at zero."""
    attention = Attention(plain.dim, heads=plain.num_attention_heads, dim_head=plain.attention_head_dim)
    silence(attention)
    return attention


def silence(attention: Attention) -> None:
    """Make an attention's output zero until it is trained."""
    assert attention.to_out is not None
    for parameter in attention.to_out.parameters():
        nn.init.zeros_(parameter)


@lru_cache(maxsize=32)
def _positions(side: int, channels: int) -> Float[Tensor, "tokens channels"]:
    """Sines and cosines of row and column in [0, 1], frequencies from a quarter turn up to one turn in two tokens."""
    place = (torch.arange(side) + 0.5) / side
    frequencies = torch.pi * torch.logspace(-1, math.log2(max(side, 2)), channels // 4, base=2.0)
    angles = place[:, None] * frequencies
    waves = torch.cat([angles.sin(), angles.cos()], dim=1)
    rows, columns = waves[:, None].expand(-1, side, -1), waves[None].expand(side, -1, -1)
    return torch.cat([rows, columns], dim=-1).reshape(side * side, -1)
