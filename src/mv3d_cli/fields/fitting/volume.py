"""Volume rendering of signed distances (NeuS, Wang et al. 2021), with samples only near the surface.

`ends` (rays, samples + 1) are lengths along the rays; an interval lies between two ends. Scene units; colours are sRGB
in [0, 1].
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from mv3d_cli.fields.fitting.samples import Rays
from mv3d_cli.fields.sdf import Field

MARCH = 96  # steps through the box that find the surface
FLOOR = 1e-5
SAMPLES = 24  # intervals around it
RADIUS = 1.05  # scene units: all there is lies in this sphere
WIDTH = 0.06  # scene units on either side of it

Distance = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class Rendered:
    """What rays see: colour over black, opacity in [0, 1], and the mean planar z of what is there."""

    color: Float[Tensor, "rays 3"]
    opacity: Float[Tensor, "rays"]
    depth: Float[Tensor, "rays"]


def alpha_from_sdf(
    previous: Float[Tensor, "rays samples"], following: Float[Tensor, "rays samples"], sharpness: Tensor | float
) -> Float[Tensor, "rays samples"]:
    """Opacity in [0, 1] of the interval between two signed distances (NeuS, eq. 13)."""
    # the logarithm of the ratio keeps its precision where both sigmoids are all but zero
    ratio = torch.nn.functional.logsigmoid(following * sharpness) - torch.nn.functional.logsigmoid(previous * sharpness)
    return -torch.expm1(ratio.clamp(max=0))


def weights_from_alpha(alpha: Float[Tensor, "rays samples"]) -> Float[Tensor, "rays samples"]:
    """alpha_i prod_{j < i} (1 - alpha_j): how much of a ray ends in each interval (NeuS, eq. 10)."""
    through = torch.cumprod(1 - alpha, dim=1)
    return alpha * torch.cat([torch.ones_like(through[:, :1]), through[:, :-1]], dim=1)


@torch.no_grad()
def ends_near_surface(distance: Distance, rays: Rays, generator: torch.Generator) -> Float[Tensor, "rays ends"]:
    """Ends of SAMPLES intervals around where each ray first enters the surface, or comes nearest to it; jittered."""
    near, far = span_in_sphere(rays, RADIUS)
    jitter = torch.rand(len(near), 1, generator=generator).to(near.device) - 0.5
    place = torch.linspace(-WIDTH, WIDTH, SAMPLES + 1, device=near.device)
    return first_crossing(distance, rays, near, far)[:, None] + place + jitter * (2 * WIDTH / SAMPLES)


@torch.no_grad()
def first_crossing(
    distance: Distance, rays: Rays, near: Float[Tensor, "rays"], far: Float[Tensor, "rays"]
) -> Float[Tensor, "rays"]:
    """Lengths at which rays enter the surface between `near` and `far`; where they come nearest, if they do not."""
    lengths = near[:, None] + (far - near)[:, None] * torch.linspace(0, 1, MARCH, device=near.device)
    values = distance(rays.at(lengths).flatten(0, 1)).unflatten(0, lengths.shape)
    inside = values < 0
    after = inside.int().argmax(dim=1, keepdim=True).clamp(min=1)
    before, behind = values.gather(1, after - 1), values.gather(1, after)
    share = (before / (before - behind).clamp_min(1e-9)).clamp(0, 1)
    entered = lengths.gather(1, after - 1).lerp(lengths.gather(1, after), share)
    nearest = lengths.gather(1, values.argmin(dim=1, keepdim=True))
    return torch.where(inside.any(dim=1, keepdim=True), entered, nearest)[:, 0]


def span_in_sphere(rays: Rays, radius: float) -> tuple[Float[Tensor, "rays"], Float[Tensor, "rays"]]:
    """Lengths at which rays enter and leave a sphere about the origin; where they miss it, where they pass it."""
    middle = -(rays.origins * rays.directions).sum(1)
    apart = (rays.origins + middle[:, None] * rays.directions).square().sum(1)
    half = (radius**2 - apart).clamp_min(1e-6).sqrt()
    return (middle - half).clamp_min(0), middle + half


def render(
    field: Field, rays: Rays, ends: Float[Tensor, "rays ends"], sharpness: Float[Tensor, ""] | float
) -> Rendered:
    """What rays see of a field between the `ends`; differentiable in the field and the sharpness."""
    distance, color = field.distance_and_color(rays.at(ends).flatten(0, 1))
    distance, color = (value.unflatten(0, ends.shape) for value in (distance, color))
    weights = weights_from_alpha(alpha_from_sdf(distance[:, :-1], distance[:, 1:], sharpness))
    opacity = weights.sum(1)
    depth = (weights * (ends[:, :-1] + ends[:, 1:]) / 2).sum(1) / opacity.clamp_min(FLOOR)
    shown = (weights[..., None] * (color[:, :-1] + color[:, 1:]) / 2).sum(1)
    return Rendered(shown, opacity, depth * rays.forward)


def rendered_normal(field: Field, rays: Rays, rendered: Rendered, step: float) -> Float[Tensor, "rays 3"]:
    """Gradient of the distance where rays end, by differences of `step` scene units; differentiable in the field."""
    return field.gradient(rays.at((rendered.depth / rays.forward)[:, None])[:, 0].detach(), step)
