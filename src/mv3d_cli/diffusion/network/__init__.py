"""The multi-view, colour-and-depth U-Net: diffusers' `UNet2DConditionModel` with its transformer blocks swapped.

Latents have the axes (object, domain, view, channel, height, width). Cameras and tasks enter through the U-Net's own
class embedding, a two-layer MLP whose output is added to the time embedding; it is never zero at the start. A network
that mends drafts sees each view's draft where others see the photo.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import torch
from diffusers.models.attention_processor import Attention
from diffusers.models.unets.unet_2d_condition import UNet2DConditionModel
from jaxtyping import Float, Int
from torch import Tensor, nn

from mv3d_cli.diffusion.network.blocks import Arrangement, MultiViewBlock, let_views_meet, silence
from mv3d_cli.diffusion.network.conditioning import FEATURES, Condition, stacked, view_features, without_photo
from mv3d_cli.diffusion.network.mending import Mending


class MultiViewUNet(nn.Module):
    """Predicts noise, v or what is clean for all views and domains of each object, given its photo.

    config     of the `UNet2DConditionModel`; `in_channels` is twice the latent's (noisy latent, photo's latent)
    positions  whether self-attention is told where in the picture its tokens are
    mending    how drafts are mended, if they are: what is clean is predicted, at first a share of the draft; the
               U-Net then has one output more, its belief in the draft
    """

    def __init__(self, config: dict[str, Any], positions: bool, mending: Mending | None = None):
        super().__init__()
        view_embedding = {"class_embed_type": "projection", "projection_class_embeddings_input_dim": FEATURES}
        if mending is not None:
            config = config | {"out_channels": config["out_channels"] + 1}
        self.unet: UNet2DConditionModel = UNet2DConditionModel.from_config(config | view_embedding)  # type: ignore[assignment]
        let_views_meet(self.unet, positions)
        self.mending = mending
        if mending is not None:
            for parameter in self.unet.conv_out.parameters():
                nn.init.zeros_(parameter)

    def forward(
        self,
        latents: Float[Tensor, "objects domains views channels height width"],
        timestep: Int[Tensor, " objects"],
        condition: Condition,
        across_views: bool = True,
        across_domains: bool = True,
    ) -> Float[Tensor, "objects domains views channels height width"]:
        """The prediction for noisy latents; `across_domains=False` leaves out colour-depth attention (stage 1)."""
        objects, domains, views = latents.shape[:3]
        seen, known = self._before(latents, timestep, condition)
        rows = torch.cat([seen, known], dim=3).flatten(0, 2).to(self.unet.dtype)
        arrangement = Arrangement(objects, domains, views, across_views, across_domains)
        prediction = self.unet(
            rows,
            timestep.repeat_interleave(domains * views),
            encoder_hidden_states=condition.tokens.to(rows),
            class_labels=view_features(condition).flatten(0, 2).to(rows),
            cross_attention_kwargs={"arrangement": arrangement},
            return_dict=False,
        )[0]
        prediction = prediction.unflatten(0, latents.shape[:3]).to(latents)
        return prediction if self.mending is None else self.mending.clean(prediction, condition)

    def _before(self, latents: Tensor, timestep: Tensor, condition: Condition) -> tuple[Tensor, Tensor]:
        """What the U-Net is shown: of the noisy latents, and beside them."""
        if self.mending is None:
            return latents, condition.photo_latent[:, None, None].expand_as(latents).to(latents)
        return self.mending.surprise(latents, timestep, condition), self.mending.drafts(condition, latents)


def colour_depth_parameters(network: MultiViewUNet) -> Iterator[nn.Parameter]:
    """The parameters that only colour-depth attention uses."""
    for layer in _colour_depth_layers(network):
        yield from layer.parameters()


def reset_additions(network: MultiViewUNet) -> None:
    """Fresh values for what a plain U-Net lacks: the camera and task embedding, and (silent) colour-depth attention."""
    assert network.unet.class_embedding is not None
    for addition in (network.unet.class_embedding, *_colour_depth_layers(network)):
        addition.to_empty(device="cpu")
        for layer in addition.modules():
            if isinstance(layer, nn.Linear | nn.LayerNorm):
                layer.reset_parameters()
    for layer in _colour_depth_layers(network):
        if isinstance(layer, Attention):
            silence(layer)


def _colour_depth_layers(network: MultiViewUNet) -> Iterator[nn.Module]:
    for block in network.modules():
        if isinstance(block, MultiViewBlock) and block.norm_domains is not None and block.attn_domains is not None:
            yield block.norm_domains
            yield block.attn_domains


def guided(network: MultiViewUNet, condition: Condition, scale: float = 1.0) -> Callable[[Tensor, int], Tensor]:
    """The `predict(latents, timestep)` of the samplers, led away from the photo-less answer (Ho and Salimans 2022).

    At scale 1 there is nothing to lead away from, and each step costs one pass over the objects instead of two.
    """
    both = condition if scale == 1 else stacked(without_photo(condition), condition)

    @torch.no_grad()
    def predict(latents: Tensor, timestep: int) -> Tensor:
        rows = latents if scale == 1 else torch.cat([latents, latents])
        when = torch.full((len(rows),), timestep, device=latents.device)
        prediction = network(rows, when, both)
        if scale == 1:
            return prediction
        without, with_photo = prediction.unflatten(0, (2, -1))
        return without + scale * (with_photo - without)

    return predict
