"""Photo -> tokens for cross-attention. Photos are (channel, height, width) in [-1, 1]."""

from __future__ import annotations

from typing import Any

from diffusers.models.attention import BasicTransformerBlock
from diffusers.models.embeddings import PatchEmbed
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from mv3d_cli.errors import MissingDependency

_CLIP_MEAN = (0.48145466, 0.4578275, 0.40821073)
_CLIP_DEVIATION = (0.26862954, 0.26130258, 0.27577711)


class PatchTokens(nn.Module):
    """A small vision transformer, trained with the model: one token for each patch of the photo."""

    def __init__(self, size: int, patch: int, width: int, layers: int, heads: int):
        super().__init__()
        self.size = size
        self.patches = PatchEmbed(size, size, patch, in_channels=3, embed_dim=width)
        self.blocks = nn.ModuleList(BasicTransformerBlock(width, heads, width // heads) for _ in range(layers))
        self.norm = nn.LayerNorm(width)

    def forward(self, photo: Float[Tensor, "objects 3 height width"]) -> Float[Tensor, "objects photo_tokens features"]:
        """The photo's tokens; other sizes are brought to the encoder's own."""
        photo = photo.to(self.norm.weight.dtype)
        if photo.shape[-1] != self.size or photo.shape[-2] != self.size:
            photo = functional.interpolate(photo, (self.size, self.size), mode="bilinear", antialias=True)
        tokens = self.patches(photo)
        for block in self.blocks:
            tokens = block(tokens)
        return self.norm(tokens)


class ClipTokens(nn.Module):
    """CLIP's image embedding as a single token, as in Stable Diffusion Image Variations.

    Raises MissingDependency without `transformers`.
    """

    def __init__(self, config: dict[str, Any]):
        super().__init__()
        try:
            from transformers import CLIPVisionConfig, CLIPVisionModelWithProjection
        except ImportError as error:
            raise MissingDependency(
                "a Stable Diffusion model needs the package transformers", "pip install 'mv3d-cli[sd]'"
            ) from error
        self.clip = CLIPVisionModelWithProjection(CLIPVisionConfig(**config))
        self.size: int = config["image_size"]

    def forward(self, photo: Float[Tensor, "objects 3 height width"]) -> Float[Tensor, "objects 1 features"]:
        """The photo's only token."""
        side = (self.size, self.size)
        resized = functional.interpolate(photo.float(), side, mode="bicubic", antialias=True).clamp(-1, 1)
        mean, deviation = resized.new_tensor([_CLIP_MEAN, _CLIP_DEVIATION])[..., None, None]
        pixels = ((resized + 1) / 2 - mean) / deviation
        weight = self.clip.visual_projection.weight
        return self.clip(pixel_values=pixels.to(weight.dtype)).image_embeds[:, None]
