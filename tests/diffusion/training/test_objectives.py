"""Losses against networks that know the answer, or miss it by as much as is told; and what may not matter to them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from mv3d_cli.diffusion.model import Model
from mv3d_cli.diffusion.model.config import ModelConfig
from mv3d_cli.diffusion.network import colour_depth_parameters
from mv3d_cli.diffusion.network.conditioning import COLOUR, DEPTH, Condition
from mv3d_cli.diffusion.noise import NoiseSettings, noisy_from_clean
from mv3d_cli.diffusion.training.objectives import Batch, DiffusionObjective, Teaching, signal_and_noise

SEEDS = (3, 8, 1, 14)
PLAIN = Teaching(noisiest=0.0, dropout=0.0, dtype=torch.float32)
EPSILON = NoiseSettings("scaled_linear", prediction="epsilon", zero_terminal=False)


@pytest.fixture
def awake(model: Model) -> Model:
    """The tiny model, with colour-depth attention that is heard."""
    for parameter in colour_depth_parameters(model.network):
        torch.nn.init.normal_(parameter, std=0.3, generator=torch.Generator().manual_seed(0))
    return model


@pytest.fixture
def knowing(model: Model, oracle: Any) -> Callable[..., DiffusionObjective]:
    """An objective whose network knows the clean latents of a batch, and errs by `off`."""

    def made(batch: Batch, teaching: Teaching, off: float = 0.0) -> DiffusionObjective:
        def clean(timestep: Tensor, condition: Condition) -> Tensor:
            objects = torch.arange(len(batch.seeds))[:, None]
            return batch.latents[objects, condition.tasks]

        objective = DiffusionObjective(model, teaching)
        objective.network = oracle(model.schedule, clean, off)
        return objective

    return made


@pytest.mark.parametrize("joint", [True, False])
def test_an_objects_loss_depends_on_nobody_else(awake: Model, batch_of, joint: bool) -> None:
    """The mean over single objects is the batch's loss, in any order."""
    objective = DiffusionObjective(awake, replace(PLAIN, joint=joint, noisiest=0.3, dropout=0.3))
    alone = torch.stack([objective(batch_of(seed)) for seed in SEEDS])
    together, turned = objective(batch_of(*SEEDS)), objective(batch_of(*SEEDS[::-1]))
    torch.testing.assert_close(together, alone.mean(), atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(turned, together, atol=1e-6, rtol=1e-5)
    assert alone.std() > 0.01
    other = objective(replace(batch_of(*SEEDS), seeds=(4, 9, 2, 15)))
    assert (other - together).abs() > 0.01


@pytest.mark.parametrize("joint", [True, False])
@pytest.mark.parametrize("noise", [NoiseSettings(), EPSILON], ids=["v", "epsilon"])
def test_a_perfect_prediction_costs_nothing(smallest: ModelConfig, oracle, batch_of, noise, joint: bool) -> None:
    model, batch = Model(replace(smallest, noise=noise)), batch_of(*range(20))
    objective = DiffusionObjective(model, replace(PLAIN, joint=joint, noisiest=0.2))
    objects = torch.arange(20)[:, None]
    objective.network = oracle(model.schedule, lambda _, condition: batch.latents[objects, condition.tasks])
    assert objective(batch) < 1e-8


@pytest.mark.parametrize(("gamma", "floor"), [(5.0, 1.0), (1.5, 0.0)])
@pytest.mark.parametrize("noise", [NoiseSettings(), EPSILON], ids=["v", "epsilon"])
def test_a_wrong_prediction_costs_its_square_weighted(smallest, oracle, batch_of, noise, gamma, floor) -> None:
    """Min-SNR in terms of the ratio, as in the papers: capped (and floored), over SNR for noise or SNR + 1 for v."""
    model, batch = Model(replace(smallest, noise=noise)), batch_of(*range(30))
    objective = DiffusionObjective(model, replace(PLAIN, gamma=gamma, floor=floor))
    objective.network = oracle(model.schedule, lambda *_: batch.latents, 0.5)
    loss = objective(batch)
    timestep = objective.network.calls[0].timestep
    snr = (model.schedule.alpha / model.schedule.sigma)[timestep] ** 2
    weight = snr.clamp_max(gamma) / snr if noise.prediction == "epsilon" else snr.clamp(floor, gamma) / (snr + 1)
    assert loss.item() == pytest.approx(0.25 * weight.mean().item(), rel=1e-4)
    assert weight.std() > 0.05


def test_colour_and_depth_share_timestep_and_photo_but_not_noise(knowing, batch_of) -> None:
    batch = batch_of(*SEEDS)
    objective = knowing(batch, PLAIN)
    objective(batch)
    (call,) = objective.network.calls
    assert call.timestep.shape == (len(SEEDS),)
    assert call.condition.tasks.tolist() == [[COLOUR, DEPTH]] * len(SEEDS)
    assert call.across_domains
    alpha, sigma = signal_and_noise(objective.schedule, call.timestep, batch.latents)
    noise = (call.noisy - alpha * batch.latents) / sigma
    torch.testing.assert_close(call.noisy, noisy_from_clean(objective.schedule, batch.latents, noise, call.timestep))
    assert 0.9 < noise[:, COLOUR].std() < 1.1
    assert 0.9 < noise[:, DEPTH].std() < 1.1
    pairs = noise.transpose(0, 1).flatten(1)
    assert abs(torch.corrcoef(pairs)[0, 1]) < 0.1
    assert torch.equal(call.condition.photo_latent, batch.photo_latent)
    assert torch.equal(call.condition.world_from_camera, batch.world_from_camera)


def test_stage_one_asks_for_colour_or_depth_as_the_seed_has_it(knowing, batch_of) -> None:
    batch = batch_of(*range(200))
    objective = knowing(batch, replace(PLAIN, joint=False))
    objective(batch)
    (call,) = objective.network.calls
    assert call.noisy.shape == (200, 1, *batch.latents.shape[2:])
    assert call.condition.tasks.shape == (200, 1)
    assert 70 < (call.condition.tasks == DEPTH).sum() < 130
    assert not call.across_domains


def test_stage_one_leaves_colour_depth_attention_without_gradient(awake: Model, batch_of) -> None:
    objective = DiffusionObjective(awake, replace(PLAIN, joint=False))
    objective(batch_of(*SEEDS)).backward()
    silent = {id(parameter) for parameter in colour_depth_parameters(awake.network)}
    training = objective.parameters_in_training()
    assert silent
    assert not silent & {id(parameter) for parameter in training}
    assert len(training) + len(silent) == len([*awake.parameters()])
    assert all(parameter.grad is None for parameter in colour_depth_parameters(awake.network))
    assert all(parameter.grad is not None and parameter.grad.isfinite().all() for parameter in training)


def test_stage_two_teaches_everything(awake: Model, batch_of) -> None:
    objective = DiffusionObjective(awake, PLAIN)
    objective(batch_of(*SEEDS)).backward()
    training = objective.parameters_in_training()
    assert {id(parameter) for parameter in training} == {id(parameter) for parameter in awake.parameters()}
    assert all(parameter.grad.abs().max() > 0 for parameter in training)


def test_the_share_of_pure_noise_is_as_told(knowing, batch_of) -> None:
    batch = batch_of(*range(300))
    timesteps = {}
    for share in (0.0, 0.3, 1.0):
        objective = knowing(batch, replace(PLAIN, noisiest=share))
        objective(batch)
        timesteps[share] = objective.network.calls[0].timestep
    assert (timesteps[1.0] == 999).all()
    assert 65 < (timesteps[0.3] == 999).sum() < 115
    even = timesteps[0.0]
    assert torch.histc(even.float(), bins=5, min=0, max=1000).min() > 35
    assert even.max() < 1000
    assert even.min() < 20


@pytest.mark.parametrize(("rate", "shown"), [(0.0, 1.0), (0.2, 0.4), (1 / 3, 0.0)])
def test_dropout_hides_the_photo_as_often_as_told(knowing, batch_of, rate: float, shown: float) -> None:
    batch = batch_of(*range(300))
    objective = knowing(batch, replace(PLAIN, dropout=rate))
    objective(batch)
    condition = objective.network.calls[0].condition
    no_tokens = (condition.tokens == 0).all(dim=(1, 2))
    no_latent = (condition.photo_latent == 0).all(dim=(1, 2, 3))
    assert (~no_tokens & ~no_latent).float().mean() == pytest.approx(shown, abs=0.08)
    for hidden in (no_tokens & ~no_latent, no_latent & ~no_tokens, no_tokens & no_latent):
        assert hidden.float().mean() == pytest.approx(rate, abs=0.08)


def test_half_precision_hardly_moves_the_loss(awake: Model, batch_of) -> None:
    batch = batch_of(*range(8))
    exact, rough = (DiffusionObjective(awake, replace(PLAIN, dtype=d))(batch) for d in (torch.float32, torch.bfloat16))
    assert rough.dtype == torch.float32
    assert 0 < (rough - exact).abs() < 0.02 * exact


def test_below_zero_a_timestep_is_clean(model: Model) -> None:
    like = torch.zeros(3, 2, 2)
    alpha, sigma = signal_and_noise(model.schedule, torch.tensor([-1, 0, 500]), like)
    assert (alpha.shape, sigma.shape) == ((3, 1, 1), (3, 1, 1))
    expected = [1.0, *model.schedule.alpha[[0, 500]].tolist()]
    assert alpha.flatten().tolist() == pytest.approx(expected)
    assert sigma.flatten().tolist() == pytest.approx([0.0, *model.schedule.sigma[[0, 500]].tolist()])
