"""Pictures <-> latents. Pictures are (channel, height, width) in [-1, 1]; latents have about unit deviation.

Depth has one channel, in scene units; it becomes three only on its way into the autoencoder.
"""

from __future__ import annotations

from typing import Any

import torch
from diffusers.models.autoencoders.autoencoder_kl import AutoencoderKL
from jaxtyping import Float, UInt8
from torch import Tensor, nn
from torch.nn import functional

from mv3d_cli.scene.conventions import RIG_RADIUS

_PLACES_AT_ONCE = 4096  # rows times columns of latents that are decoded together: it bounds memory, and costs no time

Pictures = Float[Tensor, "*batch 3 height width"]
Latents = Float[Tensor, "*batch channels rows columns"]


class Autoencoder(nn.Module):
    """Stable Diffusion's: diffusers' `AutoencoderKL` of that configuration, whose latents are the posterior's mean."""

    def __init__(self, config: dict[str, Any]):
        super().__init__()
        self.kl: AutoencoderKL = AutoencoderKL.from_config(config)  # type: ignore[assignment]
        self.shift: float = self.kl.config["shift_factor"] or 0.0
        self.scale: float = self.kl.config["scaling_factor"]

    def encode(self, pictures: Pictures) -> Latents:
        """The pictures' mean latents, normalised."""
        flat = pictures.reshape(-1, *pictures.shape[-3:]).to(self._dtype)
        mean = self.kl.encode(flat, return_dict=False)[0].mode()
        return ((mean - self.shift) * self.scale).reshape(*pictures.shape[:-3], *mean.shape[1:])

    def decode(self, latents: Latents) -> Pictures:
        """The pictures of normalised latents: the inverse of `encode`, as well as it is learned. Not clipped."""
        flat = latents.reshape(-1, *latents.shape[-3:]).to(self._dtype) / self.scale + self.shift
        pictures = torch.cat([self.kl.decode(part, return_dict=False)[0] for part in _portions(flat)])  # type: ignore[arg-type]
        return pictures.reshape(*latents.shape[:-3], *pictures.shape[1:])

    @property
    def _dtype(self) -> torch.dtype:
        return next(self.kl.parameters()).dtype


class Projection(nn.Module):
    """Squares of pixels projected on the few directions that keep most of them: their principal components.

    The directions are orthonormal, and to encode costs next to nothing. Latents are not whitened but halfway: a
    direction's deviation is the square root of what it is in pixels. So what matters most in a picture is strongest in
    its latent, and the weakest direction still stands out of the noise while there is any sense in it.

    patch     side of the squares, pixels
    channels  directions kept: of a latent
    """

    basis: Float[Tensor, "channels numbers"]
    mean: Float[Tensor, " numbers"]
    deviation: Float[Tensor, " channels"]

    def __init__(self, patch: int, channels: int):
        super().__init__()
        self.patch = patch
        self.register_buffer("basis", torch.zeros(channels, 3 * patch**2))
        self.register_buffer("mean", torch.zeros(3 * patch**2))
        self.register_buffer("deviation", torch.ones(channels))

    @torch.no_grad()
    def fit(self, pictures: Float[Tensor, "batch 3 height width"]) -> None:
        """Take the directions of greatest variance of these pictures' squares (principal components)."""
        squares = functional.pixel_unshuffle(pictures, self.patch).permute(0, 2, 3, 1).flatten(0, 2).double()
        mean = squares.mean(dim=0)
        strengths, directions = torch.linalg.eigh((squares - mean).T @ (squares - mean) / len(squares))
        kept = len(self.basis)
        self.mean.copy_(mean)
        self.basis.copy_(directions[:, -kept:].flip(1).T)
        deviations = strengths[-kept:].flip(0).clamp_min(1e-12).sqrt()
        self.deviation.copy_((deviations * deviations.mean()).sqrt())

    def encode(self, pictures: Pictures) -> Latents:
        """The squares' places along the directions."""
        squares = functional.pixel_unshuffle(pictures.to(self.mean.dtype), self.patch) - self.mean[:, None, None]
        with torch.autocast(squares.device.type, enabled=False):  # eight bits are too few for a white page
            return torch.einsum("kn,...nrc->...krc", self.basis / self.deviation[:, None], squares)

    def decode(self, latents: Latents) -> Pictures:
        """The pictures nearest to those of the latents: the inverse of `encode`, but for what was lost. Not clipped."""
        with torch.autocast(latents.device.type, enabled=False):
            basis = self.basis * self.deviation[:, None]
            squares = torch.einsum("kn,...krc->...nrc", basis, latents.to(self.mean.dtype))
        return functional.pixel_shuffle(squares + self.mean[:, None, None], self.patch)


def _portions(latents: Float[Tensor, "batch channels rows columns"]) -> tuple[Tensor, ...]:
    """The batch in parts that are decoded one after another."""
    return latents.split(max(1, _PLACES_AT_ONCE // (latents.shape[-2] * latents.shape[-1])))


class Folding(nn.Module):
    """No compression: squares of `patch` pixels folded into channels. For small pictures, where nothing is to gain."""

    def __init__(self, patch: int):
        super().__init__()
        self.patch = patch

    def encode(self, pictures: Pictures) -> Latents:
        """The pictures, folded."""
        return functional.pixel_unshuffle(pictures, self.patch)

    def decode(self, latents: Latents) -> Pictures:
        """The inverse of `encode`."""
        return functional.pixel_shuffle(latents, self.patch)


def pictures_from_bytes(color: UInt8[Tensor, "*batch height width 3"]) -> Float[Tensor, "*batch 3 height width"]:
    """Colours in [-1, 1] from sRGB bytes."""
    return color.movedim(-1, -3).float() / 127.5 - 1


def stacked_pictures(
    color: UInt8[Tensor, "views height width 3"], depth: Float[Tensor, "views height width"]
) -> Float[Tensor, "2 views 3 height width"]:
    """Colour and depth of the same views, as the model has them."""
    return torch.stack([pictures_from_bytes(color), pictures_from_depth(depth)])


def pictures_from_depth(depth: Float[Tensor, "*batch height width"]) -> Float[Tensor, "*batch 3 height width"]:
    """Depth as the model sees it: -1 at the unit sphere's near side, 1 at its far side or without a surface."""
    near = RIG_RADIUS - 1
    unit = torch.where(depth > 0, (depth - near) / 2, 1.0).clamp(0, 1)
    return (unit * 2 - 1).unsqueeze(-3).expand(*unit.shape[:-2], 3, *unit.shape[-2:])


def depth_from_pictures(
    pictures: Float[Tensor, "*batch 3 height width"], farthest: float = 0.95
) -> Float[Tensor, "*batch height width"]:
    """Depth in scene units: the inverse of `pictures_from_depth`; beyond `farthest` of the range is no surface."""
    unit = ((pictures.mean(dim=-3) + 1) / 2).clamp(0, 1)
    return torch.where(unit < farthest, unit * 2 + RIG_RADIUS - 1, 0.0)
