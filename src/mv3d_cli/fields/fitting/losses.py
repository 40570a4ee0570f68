"""What a fitted surface is held to: one function for each loss, then how losses become one number.

A loss is an error for each sample, zero at best and unweighted; distances in scene units, colours sRGB in [0, 1].
`total` weighs samples, drops the worst of them and balances the losses.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor

FLOOR = 1e-6

PerSample = Float[Tensor, "samples"]


def depth_error(distance: PerSample) -> PerSample:
    """|f(x)| where a view saw the surface."""
    return distance.abs()


def projective_error(distance: PerSample, along: PerSample, reach: float) -> PerSample:
    """|f(x) - a| where a view saw the surface a in front of (+) or behind (-) x, for |a| <= reach.

    Further in front the space is free, and f only has to be larger than the reach: max(0, reach - f).
    """
    return torch.where(along > reach, torch.relu(reach - distance), (distance - along).abs())


def hull_error(distance: PerSample, outside: PerSample) -> PerSample:
    """max(0, b - f(x)) where x lies b > 0 outside a silhouette: no surface can be nearer (Laurentini, 1994)."""
    return torch.where(outside > 0, torch.relu(outside - distance), torch.zeros_like(distance))


def eikonal_error(gradient: Float[Tensor, "samples 3"]) -> PerSample:
    """(|grad f| - 1)^2 (Gropp et al., 2020)."""
    return (_length(gradient) - 1) ** 2


def normal_error(
    gradient: Float[Tensor, "samples 3"], normal: Float[Tensor, "samples 3"], facing: PerSample
) -> PerSample:
    """(1 - cos(grad f, n)) weighted by how much the surface faces the view (Wonder3D, Long et al. 2023, eq. 10).

    facing  cosine between the seen normal n and the direction towards the viewer; exp(cosine) is the weight, and
            what looks away counts nothing
    """
    cosine = (gradient * normal).sum(1) / _length(gradient)
    weight = torch.where(facing > 0, torch.exp(facing), torch.zeros_like(facing))
    return weight * (1 - cosine)


def color_error(rendered: Float[Tensor, "samples 3"], seen: Float[Tensor, "samples 3"]) -> PerSample:
    """Mean of |c - c'| over the channels."""
    return (rendered - seen).abs().mean(1)


def mask_error(opacity: PerSample, inside: PerSample) -> PerSample:
    """Binary cross entropy of a ray's opacity and whether it meets the object (NeuS, Wang et al. 2021, eq. 17)."""
    opacity = opacity.clamp(1e-3, 1 - 1e-3)
    return -(inside * opacity.log() + (1 - inside) * (1 - opacity).log())


def ranked(error: PerSample, weight: PerSample, dropped: float) -> Tensor:
    """Weighted mean of the errors without the largest `dropped` (0 to 1) of them; 0 where there are none."""
    if not len(error):
        return error.sum()
    kept = len(error) - int(dropped * len(error))
    if kept < len(error):
        which = error.detach().topk(kept, largest=False, sorted=False).indices
        error, weight = error[which], weight[which]
    return (error * weight).sum() / weight.sum().clamp_min(FLOOR)


class Balance:
    """Losses of any unit become one: each is divided by its own size, so that its share says how much it pulls.

    The size is that of the loss over the last steps (an exponential mean), at least `least`, so that a loss that is
    satisfied falls silent instead of being blown up.
    """

    def __init__(self, shares: Mapping[str, float], least: float, memory: float = 0.95):
        self.shares, self.least, self.memory = dict(shares), least, memory
        self.sizes: dict[str, float] = {}

    def total(self, losses: Mapping[str, Tensor]) -> Tensor:
        """Sum of share * loss / size."""
        parts = []
        for name, loss in losses.items():
            value = float(loss.detach())
            size = self.sizes.get(name, value)
            self.sizes[name] = size = self.memory * size + (1 - self.memory) * value
            parts.append(self.shares[name] * loss / max(size, self.least))
        return torch.stack(parts).sum()

    def state_dict(self) -> dict[str, float]:
        """The sizes, by loss."""
        return dict(self.sizes)

    def load_state_dict(self, state: Mapping[str, float]) -> None:
        """Goes on from the sizes that `state_dict` gave."""
        self.sizes = dict(state)


def _length(vectors: Float[Tensor, "samples 3"]) -> PerSample:
    return (vectors.square().sum(1) + FLOOR**2).sqrt()
