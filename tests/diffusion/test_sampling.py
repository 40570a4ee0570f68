from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise

import pytest
import torch
from diffusers import DDIMScheduler, DPMSolverMultistepScheduler, LCMScheduler
from torch import Tensor

from mv3d_cli.diffusion.noise import (
    NoiseSettings,
    Schedule,
    clean_from_prediction,
    prediction_from_clean,
    schedule_from_settings,
)
from mv3d_cli.diffusion.sampling import Step, consistency, ddim, dpm_solver, initial_noise, lcm, trailing_timesteps
from mv3d_cli.errors import UsageError

SHAPE = (2, 2, 3, 4, 5, 5)
PREDICTIONS = ["epsilon", "v_prediction", "sample"]


def schedule(prediction: str = "v_prediction", zero_terminal: bool = False) -> Schedule:
    return schedule_from_settings(NoiseSettings("scaled_linear", prediction=prediction, zero_terminal=zero_terminal))


def diffusers_settings(prediction: str, zero_terminal: bool = False) -> dict:
    return {
        "beta_schedule": "scaled_linear",
        "beta_start": 0.00085,
        "beta_end": 0.012,
        "prediction_type": prediction,
        "rescale_betas_zero_snr": zero_terminal,
    }


def answer(latents: Tensor, timestep: int) -> Tensor:
    """A stand-in for the network: smooth, not linear, and different at each timestep."""
    return torch.sin(latents * (1 + timestep / 1000)) + 0.1 * latents.roll(1, -1)


def last(steps: Iterable[Step]) -> Tensor:
    *_, step = steps
    return step.latents


def assert_same(actual: Tensor, expected: Tensor) -> None:
    """To 1e-5 of the largest value: a made-up noise prediction drives latents to some hundreds."""
    assert expected.std() > 0.1
    assert (actual - expected).abs().max() < 1e-5 * expected.abs().max().clamp_min(1)


def theirs(scheduler, latents: Tensor, generator: torch.Generator | None = None) -> Tensor:
    extra = {"generator": generator} if generator else {}
    for timestep in scheduler.timesteps:
        latents = scheduler.step(answer(latents, int(timestep)), timestep, latents, **extra).prev_sample
    return latents


@pytest.mark.parametrize("steps", [1, 2, 4, 5, 10, 50])
@pytest.mark.parametrize(
    ("prediction", "zero_terminal"),
    [(name, False) for name in PREDICTIONS] + [("v_prediction", True), ("sample", True)],
)
def test_ddim_equals_diffusers(prediction: str, zero_terminal: bool, steps: int) -> None:
    scheduler = DDIMScheduler(
        **diffusers_settings(prediction, zero_terminal), timestep_spacing="trailing", clip_sample=False
    )
    scheduler.set_timesteps(steps)
    ours, start = schedule(prediction, zero_terminal), initial_noise(SHAPE, 0, torch.zeros(1))
    timesteps = trailing_timesteps(ours, steps)
    assert timesteps == scheduler.timesteps.tolist()
    expected = theirs(scheduler, start)
    assert_same(last(ddim(answer, start, ours, timesteps)), expected)


@pytest.mark.parametrize("steps", [1, 2, 4, 10, 20])
@pytest.mark.parametrize("prediction", PREDICTIONS)
def test_dpm_solver_equals_diffusers(prediction: str, steps: int) -> None:
    scheduler = DPMSolverMultistepScheduler(**diffusers_settings(prediction), timestep_spacing="trailing")
    scheduler.set_timesteps(steps)
    ours, start = schedule(prediction), initial_noise(SHAPE, 0, torch.zeros(1))
    timesteps = trailing_timesteps(ours, steps)
    assert timesteps == scheduler.timesteps.tolist()
    expected = theirs(scheduler, start)
    assert_same(last(dpm_solver(answer, start, ours, timesteps)), expected)


@pytest.mark.parametrize("steps", [1, 2, 4, 8])
@pytest.mark.parametrize("prediction", PREDICTIONS)
def test_lcm_equals_diffusers(prediction: str, steps: int) -> None:
    scheduler = LCMScheduler(**diffusers_settings(prediction), clip_sample=False)
    scheduler.set_timesteps(steps)
    ours, start = schedule(prediction), initial_noise(SHAPE, 0, torch.zeros(1))
    expected = theirs(scheduler, start, torch.Generator().manual_seed(7))
    timesteps = scheduler.timesteps.tolist()
    actual = last(lcm(answer, start, ours, timesteps, torch.Generator().manual_seed(7)))
    assert_same(actual, expected)


@pytest.mark.parametrize("steps", [1, 2, 4, 8])
@pytest.mark.parametrize("zero_terminal", [False, True])
@pytest.mark.parametrize("sampler", [ddim, dpm_solver])
def test_a_network_that_knows_the_answer_is_led_to_it(sampler, zero_terminal: bool, steps: int) -> None:
    ours, clean = schedule(zero_terminal=zero_terminal), torch.randn(SHAPE, dtype=torch.float64)

    def knows(latents: Tensor, timestep: int) -> Tensor:
        alpha, sigma = ours.alpha[timestep], ours.sigma[timestep]
        return prediction_from_clean(ours, clean, (latents - alpha * clean) / sigma, timestep)

    records = list(sampler(knows, torch.randn_like(clean), ours, trailing_timesteps(ours, steps)))
    assert [record.timestep for record in records] == trailing_timesteps(ours, steps)
    torch.testing.assert_close(records[0].clean, clean)
    torch.testing.assert_close(records[-1].latents, clean)


def test_any_number_of_steps_begins_at_the_noisiest() -> None:
    ours = schedule()
    for steps in (1, 3, 7, 999, 1000):
        timesteps = trailing_timesteps(ours, steps)
        assert timesteps[0] == 999
        assert len(timesteps) == steps
        assert all(a > b >= 0 for a, b in pairwise(timesteps))


@pytest.mark.parametrize("steps", [0, 1001])
def test_impossible_numbers_of_steps_are_refused(steps: int) -> None:
    with pytest.raises(UsageError, match="not possible"):
        trailing_timesteps(schedule(), steps)


def test_a_seed_is_the_same_noise_in_any_precision() -> None:
    one, same, other = (initial_noise(SHAPE, seed, torch.zeros(1)) for seed in (3, 3, 4))
    torch.testing.assert_close(one, same, atol=0, rtol=0)
    assert (one - other).abs().mean() > 0.5
    torch.testing.assert_close(initial_noise(SHAPE, 3, torch.zeros(1, dtype=torch.bfloat16)), one.bfloat16())


@pytest.mark.parametrize("prediction", PREDICTIONS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_each_object_has_a_consistency_of_its_own(prediction: str, dtype: torch.dtype) -> None:
    """With a timestep an object it is what it is for each alone; at 0 it is the identity, late the clean latents."""
    ours, timestep = schedule(prediction), torch.tensor([0, 1, 19, 500, 999])
    noisy, answers = (torch.randn(5, *SHAPE[1:], dtype=dtype) for _ in range(2))
    together = consistency(ours, answers, noisy, timestep)
    alone = [consistency(ours, answers[i : i + 1], noisy[i : i + 1], int(t)) for i, t in enumerate(timestep)]
    torch.testing.assert_close(together, torch.cat(alone), atol=0, rtol=0)
    torch.testing.assert_close(together[0], noisy[0], atol=0, rtol=0)
    clean = clean_from_prediction(ours, answers, noisy, timestep)
    torch.testing.assert_close(together[3:], clean[3:], atol=1e-4, rtol=1e-4)
    assert together.dtype == dtype


def test_consistency_weights_are_those_of_the_papers_scheduler() -> None:
    ours, scheduler = schedule(), LCMScheduler(**diffusers_settings("v_prediction"))
    noisy, answers = torch.randn(2, 3), torch.randn(2, 3)
    clean = clean_from_prediction(ours, answers, noisy, torch.tensor([1, 7]))
    weights = [scheduler.get_scalings_for_boundary_condition_discrete(t) for t in (1, 7)]
    expected = [keep * noisy[i] + give * clean[i] for i, (keep, give) in enumerate(weights)]
    torch.testing.assert_close(consistency(ours, answers, noisy, torch.tensor([1, 7])), torch.stack(expected))
