"""Samplers: plain generators that walk from noise to clean latents.

`predict(latents, timestep)` is the network's answer (noise or v, as the schedule says) for all objects at one timestep.
`timesteps` fall; any subset of the schedule's will do. Each generator yields after every step; the last `clean` is the
result. Coefficients are computed in Python floats, so that pure noise (alpha = 0) needs no special case.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Int
from torch import Tensor

from mv3d_cli.diffusion.noise import Schedule, clean_from_prediction, noise_from_prediction
from mv3d_cli.errors import UsageError

Predict = Callable[[Tensor, int], Tensor]
_DATA_DEVIATION = 0.5  # as consistency models have it


@dataclass(frozen=True)
class Step:
    """One step of a sampler: where it started, the clean latents seen from there, the latents for the next step."""

    timestep: int
    clean: Tensor
    latents: Tensor


def trailing_timesteps(schedule: Schedule, steps: int) -> list[int]:
    """`steps` evenly spaced timesteps that begin at the noisiest (Lin et al. 2024, section 3.3).

    Raises UsageError unless 1 <= steps <= the schedule's timesteps.
    """
    total = len(schedule.alpha)
    if not 1 <= steps <= total:
        raise UsageError(f"{steps} sampling steps are not possible", f"ask for 1 to {total} steps")
    return [round(total - total * step / steps) - 1 for step in range(steps)]


def initial_noise(shape: Sequence[int], seed: int, like: Tensor) -> Tensor:
    """The noise that `seed` stands for: the same on every device, as it is drawn on the CPU."""
    return _standard_normal(shape, torch.Generator().manual_seed(seed), like)


def ddim(predict: Predict, latents: Tensor, schedule: Schedule, timesteps: Sequence[int]) -> Iterator[Step]:
    """Deterministic DDIM (Song et al. 2021, equation 12 with eta = 0)."""
    for timestep, following in zip(timesteps, [*timesteps[1:], None], strict=True):
        prediction = predict(latents, timestep)
        clean = clean_from_prediction(schedule, prediction, latents, timestep)
        noise = noise_from_prediction(schedule, prediction, latents, timestep)
        alpha, sigma = _signal_and_noise(schedule, following)
        latents = alpha * clean + sigma * noise
        yield Step(timestep, clean, latents)


def dpm_solver(predict: Predict, latents: Tensor, schedule: Schedule, timesteps: Sequence[int]) -> Iterator[Step]:
    """DPM-Solver++(2M), whose last step is of first order (Lu et al. 2022, algorithm 2)."""
    before: tuple[Tensor, float] | None = None
    for timestep, following in zip(timesteps, [*timesteps[1:], None], strict=True):
        clean = clean_from_prediction(schedule, predict(latents, timestep), latents, timestep)
        (_, sigma_here), (alpha, sigma) = _signal_and_noise(schedule, timestep), _signal_and_noise(schedule, following)
        width = _log_snr(schedule, following) - _log_snr(schedule, timestep)
        extrapolated = clean
        if before is not None and following is not None:
            earlier, earlier_width = before
            extrapolated = clean + 0.5 * (width / earlier_width) * (clean - earlier)
        latents = sigma / sigma_here * latents - alpha * math.expm1(-width) * extrapolated
        before = clean, width
        yield Step(timestep, clean, latents)


def lcm(
    predict: Predict, latents: Tensor, schedule: Schedule, timesteps: Sequence[int], generator: torch.Generator
) -> Iterator[Step]:
    """Multistep sampling of a consistency model (Luo et al. 2023, algorithm 1); `generator` lives on the CPU."""
    for timestep, following in zip(timesteps, [*timesteps[1:], None], strict=True):
        clean = consistency(schedule, predict(latents, timestep), latents, timestep)
        alpha, sigma = _signal_and_noise(schedule, following)
        latents = clean
        if sigma > 0:
            latents = alpha * clean + sigma * _standard_normal(clean.shape, generator, clean)
        yield Step(timestep, clean, latents)


def consistency(
    schedule: Schedule, prediction: Tensor, noisy: Tensor, timestep: Int[Tensor, " objects"] | int
) -> Tensor:
    """The consistency function: the clean latents, bent to be the identity at timestep 0 (Luo et al., equation 9)."""
    if isinstance(timestep, int):
        timestep = torch.tensor([timestep])
    scaled = (10.0 * timestep.double().cpu()).view((-1,) + (1,) * (noisy.ndim - 1))
    keep = _DATA_DEVIATION**2 / (scaled**2 + _DATA_DEVIATION**2)
    give = scaled / (scaled**2 + _DATA_DEVIATION**2).sqrt()
    clean = clean_from_prediction(schedule, prediction, noisy, timestep)
    return keep.to(noisy.dtype).to(noisy.device) * noisy + give.to(noisy.dtype).to(noisy.device) * clean


def _signal_and_noise(schedule: Schedule, timestep: int | None) -> tuple[float, float]:
    """(alpha, sigma); no timestep means clean."""
    return (1.0, 0.0) if timestep is None else (schedule.alpha[timestep].item(), schedule.sigma[timestep].item())


def _log_snr(schedule: Schedule, timestep: int | None) -> float:
    """log(alpha / sigma): minus infinity at pure noise, infinity at clean."""
    alpha, sigma = _signal_and_noise(schedule, timestep)
    if alpha == 0:
        return -math.inf
    return math.inf if sigma == 0 else math.log(alpha / sigma)


def _standard_normal(shape: Sequence[int], generator: torch.Generator, like: Tensor) -> Tensor:
    return torch.randn(tuple(shape), generator=generator).to(like.dtype).to(like.device)
