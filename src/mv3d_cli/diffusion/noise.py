"""The forward process: noisy = alpha * clean + sigma * noise with alpha^2 + sigma^2 = 1.

Timesteps run from 0 (almost clean) to `len(schedule.alpha) - 1` (almost, or only, noise). Tensors of latents have the
object as their first axis; all domains and views of an object share its timestep.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mv3d_cli.errors import UsageError

Prediction = Literal["epsilon", "v_prediction", "sample"]
"""What a network answers with: the noise, v, or the clean latents; the names are diffusers'."""


@dataclass(frozen=True)
class NoiseSettings:
    """How noise grows with the timestep, and what the network is asked for."""

    curve: Literal["cosine", "scaled_linear"] = "cosine"
    timesteps: int = 1000
    beta_start: float = 0.00085
    beta_end: float = 0.012
    zero_terminal: bool = True
    prediction: Prediction = "v_prediction"


@dataclass(frozen=True)
class Schedule:
    """Signal and noise at each timestep, float64 on the CPU."""

    alpha: Float[Tensor, " timesteps"]
    sigma: Float[Tensor, " timesteps"]
    prediction: Prediction


def schedule_from_settings(settings: NoiseSettings) -> Schedule:
    """The noise schedule; with `zero_terminal`, the last timestep is pure noise (Lin et al. 2024, algorithm 1).

    Raises UsageError for noise prediction with a zero terminal: pure noise says nothing of what is under it.
    """
    if settings.zero_terminal and settings.prediction == "epsilon":
        raise UsageError(
            "a model that predicts noise cannot start from pure noise",
            "choose prediction='v_prediction', or zero_terminal=False",
        )
    betas = _cosine_betas(settings) if settings.curve == "cosine" else _scaled_linear_betas(settings)
    alpha = (1 - betas).cumprod(0).sqrt()
    if settings.zero_terminal:
        alpha = (alpha - alpha[-1]) * alpha[0] / (alpha[0] - alpha[-1])
    return Schedule(alpha, (1 - alpha**2).sqrt(), settings.prediction)


def _cosine_betas(settings: NoiseSettings) -> Float[Tensor, " timesteps"]:
    """Nichol and Dhariwal 2021, equation 17."""
    time = torch.arange(settings.timesteps + 1, dtype=torch.float64) / settings.timesteps
    alpha_bar = ((time + 0.008) / 1.008 * math.pi / 2).cos() ** 2
    return (1 - alpha_bar[1:] / alpha_bar[:-1]).clamp_max(0.999)


def _scaled_linear_betas(settings: NoiseSettings) -> Float[Tensor, " timesteps"]:
    """Stable Diffusion's: the square roots of the betas are evenly spaced."""
    ends = settings.beta_start**0.5, settings.beta_end**0.5
    return torch.linspace(*ends, settings.timesteps, dtype=torch.float64) ** 2


def coefficients(schedule: Schedule, timestep: Int[Tensor, " objects"] | int, like: Tensor) -> tuple[Tensor, Tensor]:
    """(alpha, sigma) at the timesteps, shaped to multiply latents `like` these."""
    if isinstance(timestep, int):
        timestep = torch.full((1,), timestep)
    index = timestep.cpu()
    shape = (-1,) + (1,) * (like.ndim - 1)
    alpha, sigma = schedule.alpha[index], schedule.sigma[index]
    # cast before moving: some devices have no float64
    return alpha.to(like.dtype).to(like.device).view(shape), sigma.to(like.dtype).to(like.device).view(shape)


def noisy_from_clean(
    schedule: Schedule, clean: Tensor, noise: Tensor, timestep: Int[Tensor, " objects"] | int
) -> Tensor:
    """Latents with the noise of their timestep."""
    alpha, sigma = coefficients(schedule, timestep, clean)
    return alpha * clean + sigma * noise


def prediction_from_clean(
    schedule: Schedule, clean: Tensor, noise: Tensor, timestep: Int[Tensor, " objects"] | int
) -> Tensor:
    """What the network should answer: the noise, v = alpha * noise - sigma * clean (Salimans and Ho 2022), or what is
    clean."""
    if schedule.prediction == "sample":
        return clean
    if schedule.prediction == "epsilon":
        return noise
    alpha, sigma = coefficients(schedule, timestep, clean)
    return alpha * noise - sigma * clean


def clean_from_prediction(
    schedule: Schedule, prediction: Tensor, noisy: Tensor, timestep: Int[Tensor, " objects"] | int
) -> Tensor:
    """The clean latents that the network's answer implies: the inverse of `prediction_from_clean`."""
    if schedule.prediction == "sample":
        return prediction
    alpha, sigma = coefficients(schedule, timestep, noisy)
    if schedule.prediction == "epsilon":
        return (noisy - sigma * prediction) / alpha
    return alpha * noisy - sigma * prediction


def noise_from_prediction(
    schedule: Schedule, prediction: Tensor, noisy: Tensor, timestep: Int[Tensor, " objects"] | int
) -> Tensor:
    """The noise that the network's answer implies."""
    if schedule.prediction == "epsilon":
        return prediction
    alpha, sigma = coefficients(schedule, timestep, noisy)
    if schedule.prediction == "sample":
        return (noisy - alpha * prediction) / sigma
    return alpha * prediction + sigma * noisy


def min_snr_weight(
    schedule: Schedule, timestep: Int[Tensor, " objects"], gamma: float = 5.0, floor: float = 0.0
) -> Float[Tensor, " objects"]:
    """The weight of each object's squared error, as seen by the prediction in use: on clean latents it is the SNR, at
    most `gamma` (Hang et al. 2023) and at least `floor` (Salimans and Ho 2022: 1). Without a floor nothing is learnt
    from pure noise; where noise is predicted there is none."""
    index = timestep.cpu()
    signal, noise = schedule.alpha[index] ** 2, schedule.sigma[index] ** 2
    # |noise error|^2 = SNR |clean error|^2 and |v error|^2 = |clean error|^2 / sigma^2 with sigma^2 = 1 / (SNR + 1)
    if schedule.prediction == "sample":
        weight = (signal / noise).clamp(floor, gamma)
    elif schedule.prediction == "epsilon":
        weight = (gamma * noise / signal).clamp_max(1)
    else:
        weight = torch.maximum(torch.minimum(signal, gamma * noise), floor * noise)
    return weight.float().to(timestep.device)
