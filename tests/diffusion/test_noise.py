from __future__ import annotations

import pytest
import torch
from diffusers import DDPMScheduler
from diffusers.training_utils import compute_snr
from hypothesis import given
from hypothesis import strategies as st

from mv3d_cli.diffusion.noise import (
    NoiseSettings,
    Schedule,
    clean_from_prediction,
    min_snr_weight,
    noise_from_prediction,
    noisy_from_clean,
    prediction_from_clean,
    schedule_from_settings,
)
from mv3d_cli.errors import UsageError

THEIR_CURVES = {"cosine": "squaredcos_cap_v2", "scaled_linear": "scaled_linear"}


PREDICTIONS = ["epsilon", "v_prediction", "sample"]


def schedule(curve="cosine", prediction="v_prediction", zero_terminal=False) -> Schedule:
    return schedule_from_settings(NoiseSettings(curve, prediction=prediction, zero_terminal=zero_terminal))


def theirs(curve: str, zero_terminal: bool = False) -> DDPMScheduler:
    return DDPMScheduler(
        beta_schedule=THEIR_CURVES[curve],
        beta_start=0.00085,
        beta_end=0.012,
        rescale_betas_zero_snr=zero_terminal,
        prediction_type="v_prediction",
    )


@pytest.mark.parametrize("zero_terminal", [False, True])
@pytest.mark.parametrize("curve", ["cosine", "scaled_linear"])
def test_schedules_equal_diffusers(curve: str, zero_terminal: bool) -> None:
    expected = theirs(curve, zero_terminal).alphas_cumprod
    torch.testing.assert_close(
        schedule(curve, zero_terminal=zero_terminal).alpha.float() ** 2, expected, atol=2e-6, rtol=2e-4
    )


def test_noise_and_velocity_equal_diffusers() -> None:
    clean, noise, timestep = torch.randn(3, 2, 4), torch.randn(3, 2, 4), torch.tensor([0, 500, 999])
    ours, other = schedule(), theirs("cosine")
    torch.testing.assert_close(
        noisy_from_clean(ours, clean, noise, timestep), other.add_noise(clean, noise, timestep), atol=1e-5, rtol=0
    )
    torch.testing.assert_close(
        prediction_from_clean(ours, clean, noise, timestep),
        other.get_velocity(clean, noise, timestep),
        atol=1e-5,
        rtol=0,
    )


@pytest.mark.parametrize("prediction", PREDICTIONS)
@given(timestep=st.integers(0, 900), seed=st.integers(0, 99))
def test_a_perfect_prediction_gives_back_clean_and_noise(prediction: str, timestep: int, seed: int) -> None:
    ours, generator = schedule("scaled_linear", prediction), torch.Generator().manual_seed(seed)
    clean, noise = torch.randn(2, 1, 5, generator=generator, dtype=torch.float64).split(1)
    noisy = noisy_from_clean(ours, clean, noise, timestep)
    answer = prediction_from_clean(ours, clean, noise, timestep)
    torch.testing.assert_close(clean_from_prediction(ours, answer, noisy, timestep), clean)
    torch.testing.assert_close(noise_from_prediction(ours, answer, noisy, timestep), noise)


def test_the_zero_terminal_is_pure_noise_and_v_is_then_the_clean_latents() -> None:
    ours, clean, noise = schedule(zero_terminal=True), torch.randn(1, 5), torch.randn(1, 5)
    torch.testing.assert_close(noisy_from_clean(ours, clean, noise, 999), noise)
    torch.testing.assert_close(clean_from_prediction(ours, -clean, noise, 999), clean)


def test_noise_cannot_be_predicted_from_pure_noise() -> None:
    with pytest.raises(UsageError, match="pure noise"):
        schedule(prediction="epsilon", zero_terminal=True)


@pytest.mark.parametrize("prediction", PREDICTIONS)
def test_min_snr_weights_equal_the_papers_formulas(prediction: str) -> None:
    timestep = torch.tensor([0, 10, 300, 700, 990])
    snr = compute_snr(theirs("cosine"), timestep)
    expected = snr.clamp_max(5) / {"epsilon": snr, "v_prediction": snr + 1, "sample": torch.ones(5)}[prediction]
    ours = schedule("cosine", prediction)
    torch.testing.assert_close(min_snr_weight(ours, timestep), expected, atol=1e-5, rtol=1e-3)


def test_weights_stay_finite_at_pure_noise() -> None:
    assert min_snr_weight(schedule(zero_terminal=True), torch.tensor([999])).item() == 0


@pytest.mark.parametrize(("gamma", "floor"), [(5.0, 1.0), (2.0, 0.0), (1e9, 3.0)])
def test_on_clean_latents_the_weight_is_the_ratio_between_floor_and_cap(gamma: float, floor: float) -> None:
    """An error of the clean latents seen as one of v: v' - v = (clean - clean') / sigma, whatever was predicted."""
    ours, timestep = schedule(), torch.arange(0, 1000, 9)
    clean, other, noise = (torch.randn(len(timestep), 6, dtype=torch.float64) for _ in range(3))
    noisy = noisy_from_clean(ours, clean, noise, timestep)
    answer = prediction_from_clean(ours, clean, noise, timestep)
    alpha, sigma = (x[timestep][:, None] for x in (ours.alpha, ours.sigma))
    implied = alpha * ((noisy - alpha * other) / sigma) - sigma * other
    error = (answer - implied).square().mean(dim=1)
    snr = (alpha / sigma)[:, 0] ** 2
    expected = snr.clamp(floor, gamma) * (clean - other).square().mean(dim=1)
    torch.testing.assert_close(min_snr_weight(ours, timestep, gamma, floor) * error, expected, atol=0, rtol=1e-5)
    assert snr.min() < 0.1
    assert snr.max() > 1000


def test_with_a_floor_pure_noise_teaches_as_much_as_the_floor_says() -> None:
    ours = schedule(zero_terminal=True)
    assert min_snr_weight(ours, torch.tensor([999]), floor=1.0).item() == pytest.approx(1.0)
    assert min_snr_weight(ours, torch.tensor([999]), floor=0.25).item() == pytest.approx(0.25)


def test_where_noise_is_predicted_there_is_no_floor() -> None:
    ours, timestep = schedule(prediction="epsilon"), torch.tensor([0, 500, 990])
    assert torch.equal(min_snr_weight(ours, timestep, 5.0, 1.0), min_snr_weight(ours, timestep, 5.0))
