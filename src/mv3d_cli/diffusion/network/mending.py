"""Clean latents from a draft: a share of it that can be trusted, and what the network adds.

Clean latents lie around a trusted share of their draft d, at trust * d, with deviation s. Trust and deviation are told
for each channel of colour and of depth, and by how far the view is turned away from the photo's: the front is the
photo, the back has at least its outline. The network sees the draft, and by how much the noisy latents
x = alpha * clean + sigma * noise differ from what was expected, at unit deviation: (x - alpha trust d) divided by
(alpha^2 s^2 + sigma^2)^1/2. It answers, in deviations, what to add, and at each place how far to believe the draft
instead of its trusted share (0: not at all, 1: wholly). Silent, it says trust * d.

The noisy latents do not enter the result but through the network: to add their noise, as the posterior's mean does
(Karras et al. 2022, table 1), would ask a small network to carry it out again.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from mv3d_cli.diffusion.network.conditioning import Condition
from mv3d_cli.diffusion.noise import Schedule, coefficients

Latents = Float[Tensor, "objects domains views channels rows columns"]
Answer = Float[Tensor, "objects domains views channels_and_belief rows columns"]

TURNS = 5  # at which trust is told, evenly spaced from the photo's direction to the opposite one
LEAST = 0.03  # deviation: a channel that the draft always gets right may still be wrong once


def between_turns(world_from_camera: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch turns"]:
    """Weights of the two turns nearest to a view's; the photo looks along +Y."""
    along = world_from_camera[..., 1, 2].clamp(-1, 1)
    place = along.acos() / torch.pi * (TURNS - 1)
    return (1 - (place[..., None] - torch.arange(TURNS, device=place.device)).abs()).clamp_min(0)


class Mending(nn.Module):
    """What is known before the network is asked; fitted, not trained."""

    trust: Float[Tensor, "2 turns channels"]
    deviation: Float[Tensor, "2 turns channels"]

    def __init__(self, schedule: Schedule, channels: int):
        super().__init__()
        self.schedule = schedule
        self.register_buffer("trust", torch.ones(2, TURNS, channels))
        self.register_buffer("deviation", torch.ones(2, TURNS, channels))

    @torch.no_grad()
    def fit(
        self,
        clean: Float[Tensor, "objects 2 views channels rows columns"],
        drafts: Float[Tensor, "objects 2 views channels rows columns"],
        world_from_camera: Float[Tensor, "objects views 4 4"],
    ) -> None:
        """Trust by least squares, and what it leaves. A turn that no view is near is trusted as it was."""
        weights = between_turns(world_from_camera)

        def by_turn(values: Latents) -> Float[Tensor, "2 turns channels"]:
            return torch.einsum("odvc,ovt->dtc", values.mean(dim=(-2, -1)), weights)

        seen = weights.sum(dim=(0, 1))[:, None]
        products, squares = by_turn(clean * drafts), by_turn(drafts.square())
        self.trust.copy_(torch.where(seen > 0, products / squares.clamp_min(1e-9), self.trust))
        left = by_turn((clean - _told(self.trust, weights) * drafts).square()) / seen.clamp_min(1e-9)
        self.deviation.copy_(torch.where(seen > 0, left.sqrt().clamp_min(LEAST), self.deviation))

    def surprise(self, noisy: Latents, timestep: Int[Tensor, " objects"], condition: Condition) -> Latents:
        """What the noisy latents have that nobody expected, at about unit deviation."""
        alpha, sigma = coefficients(self.schedule, timestep, noisy)
        _, trusted, deviation = self._expected(condition, noisy)
        return (noisy - alpha * trusted) / (alpha**2 * deviation**2 + sigma**2).sqrt()

    @staticmethod
    def drafts(condition: Condition, like: Tensor) -> Latents:
        """The drafts of a condition, of the device and dtype of `like`. Raises ValueError where there are none."""
        if condition.drafts is None:
            raise ValueError("this network mends drafts, and there are none")
        return condition.drafts.to(like)

    def clean(self, answer: Answer, condition: Condition) -> Latents:
        """The clean latents.

        answer  one channel more than the latents have: the belief in the draft
        """
        drafts, trusted, deviation = self._expected(condition, answer)
        answer, belief = answer[..., :-1, :, :], answer[..., -1:, :, :]
        return trusted + belief * (drafts - trusted) + deviation * answer

    def _expected(self, condition: Condition, like: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(the drafts, their trusted share, deviation of clean latents from it). Raises ValueError without drafts."""
        weights, drafts = between_turns(condition.world_from_camera), self.drafts(condition, like)
        trust, deviation = (_told(part[condition.tasks], weights).to(like) for part in (self.trust, self.deviation))
        return drafts, trust * drafts, deviation


def _told(
    values: Float[Tensor, "*objects domains turns channels"], weights: Float[Tensor, "objects views turns"]
) -> Float[Tensor, "objects domains views channels 1 1"]:
    """What each view is told, between its nearest turns."""
    together = "odtc,ovt->odvc" if values.ndim == 4 else "dtc,ovt->odvc"
    return torch.einsum(together, values, weights.to(values))[..., None, None]
