"""Distillation between networks whose beliefs are known: what is compared with what, and what is taught."""

from __future__ import annotations

import itertools
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from mv3d_cli.diffusion.model import Model
from mv3d_cli.diffusion.network.conditioning import Condition
from mv3d_cli.diffusion.noise import noisy_from_clean
from mv3d_cli.diffusion.training import Course, State, train
from mv3d_cli.diffusion.training.distillation import DDIM_STEPS, HUBER, DistillationObjective
from mv3d_cli.diffusion.training.objectives import Batch, generators, signal_and_noise

STRIDE = 1000 // DDIM_STEPS
SEEDS = (3, 8, 1, 14)


def rung(seed: int) -> int:
    """Where on the teacher's path an object begins: 1 is next to clean."""
    return int(torch.randint(1, DDIM_STEPS + 1, (), generator=next(generators([seed]))))


FIRST = [seed for seed in range(400) if rung(seed) == 1][:4]
LATER = [seed for seed in range(40) if rung(seed) > 1]


def huber(distance: float) -> float:
    return (distance**2 + HUBER**2) ** 0.5 - HUBER


def between(model: Model, teacher: nn.Module, student: nn.Module, guidance: float = 1.0) -> DistillationObjective:
    """The objective of this teacher and this student."""
    model.network = teacher
    objective = DistillationObjective(model, guidance, torch.float32)
    objective.network = student
    return objective


def knows(batch: Batch):
    return lambda *_: batch.latents


def says(value: float):
    return lambda *_: torch.tensor(value)


def test_who_knows_the_answer_has_nothing_to_learn(model: Model, oracle: Any, batch_of) -> None:
    batch = batch_of(*LATER, *FIRST)
    objective = between(model, oracle(model.schedule, knows(batch)), oracle(model.schedule, knows(batch)))
    assert objective(batch).abs() < 1e-6


def test_a_random_network_has(model: Model, batch_of) -> None:
    loss = DistillationObjective(model, dtype=torch.float32)(batch_of(*SEEDS))
    assert 1e-3 < loss < 2


def test_an_objects_loss_depends_on_nobody_else(model: Model, batch_of) -> None:
    objective = DistillationObjective(model, 2.0, torch.float32)
    alone = torch.stack([objective(batch_of(seed)) for seed in SEEDS])
    torch.testing.assert_close(objective(batch_of(*SEEDS)), alone.mean(), atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(objective(batch_of(*SEEDS[::-1])), alone.mean(), atol=1e-6, rtol=1e-5)
    assert alone.std() > 1e-4


def test_next_to_clean_the_teacher_is_right(model: Model, oracle: Any, batch_of) -> None:
    """Where the teacher's step ends in clean latents, those are what is wanted, and the student is not asked."""
    batch = batch_of(*FIRST)
    objective = between(model, oracle(model.schedule, says(0.2)), oracle(model.schedule, says(0.5)))
    assert objective(batch).item() == pytest.approx(huber(0.3), abs=2e-4)
    assert (objective.network.calls[-1].timestep == STRIDE - 1).all()


def test_elsewhere_the_student_is_held_against_itself(model: Model, oracle: Any, batch_of) -> None:
    """It says the same at both points, so whatever the teacher believes, nothing is to learn."""
    batch = batch_of(*LATER)
    objective = between(model, oracle(model.schedule, says(0.2)), oracle(model.schedule, says(0.5)))
    assert objective(batch).abs() < 1e-5


def test_the_teacher_steps_along_the_path_to_the_nearer_point(model: Model, oracle: Any, batch_of) -> None:
    """A teacher who knows the clean latents keeps the noise: the student sees the same noise one rung down."""
    batch = batch_of(*LATER)
    objective = between(model, oracle(model.schedule, knows(batch)), oracle(model.schedule, knows(batch)))
    objective(batch)
    (asked,), (nearer, farther) = objective._frozen[0].calls, objective.network.calls
    assert torch.equal(asked.timestep, farther.timestep)
    assert torch.equal(asked.timestep, torch.tensor([rung(seed) * STRIDE - 1 for seed in LATER]))
    assert torch.equal(nearer.timestep, farther.timestep - STRIDE)
    alpha, sigma = signal_and_noise(model.schedule, farther.timestep, batch.latents)
    noise = (farther.noisy - alpha * batch.latents) / sigma
    assert 0.9 < noise.std() < 1.1
    expected = noisy_from_clean(model.schedule, batch.latents, noise, nearer.timestep)
    torch.testing.assert_close(nearer.noisy, expected, atol=1e-3, rtol=0)


def test_every_rung_is_a_beginning() -> None:
    assert {rung(seed) for seed in range(1000)} == set(range(1, DDIM_STEPS + 1))


def test_a_teachers_guidance_is_in_its_step(model: Model, oracle: Any, batch_of) -> None:
    """With the photo it says 0.4 and without 0.1: led away by 2, 0.7. The student is asked once, with the photo."""

    def believes(_: Tensor, condition: Condition) -> Tensor:
        hidden = (condition.tokens == 0).all(dim=(1, 2)) & (condition.photo_latent == 0).all(dim=(1, 2, 3))
        return torch.where(hidden, 0.1, 0.4).view(-1, 1, 1, 1, 1, 1)

    batch = batch_of(*FIRST)
    for guidance, led in ((1.0, 0.4), (2.0, 0.7)):
        objective = between(model, oracle(model.schedule, believes), oracle(model.schedule, says(0.0)), guidance)
        assert objective(batch).item() == pytest.approx(huber(led), abs=5e-4)
        assert len(objective._frozen[0].calls) == guidance
        assert all((call.condition.tokens != 0).any() for call in objective.network.calls)


def test_the_wanted_answer_has_no_gradient(model: Model, oracle: Any, batch_of) -> None:
    """A student that believes in slope * timestep: pulled at the farther point only, the slope feels all of it."""
    (seed,) = LATER[:1]
    batch, slope = batch_of(seed), torch.tensor(1e-3, requires_grad=True)
    far = rung(seed) * STRIDE - 1
    student = oracle(model.schedule, lambda timestep, _: slope * timestep.view(-1, 1, 1, 1, 1, 1))
    objective = between(model, oracle(model.schedule, says(0.0)), student)
    loss = objective(batch)
    loss.backward()
    distance = 1e-3 * STRIDE
    assert loss.item() == pytest.approx(huber(distance), rel=1e-2)
    assert slope.grad.item() == pytest.approx(far * distance / (distance**2 + HUBER**2) ** 0.5, rel=1e-2)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_the_student_learns_and_the_teacher_stays(model: Model, accelerator, batch_of, dtype: torch.dtype) -> None:
    objective = DistillationObjective(model, dtype=dtype)
    teacher, encoder = objective._frozen
    before = [value.clone() for part in (teacher, encoder) for value in part.state_dict().values()]
    course = Course(steps=12, rate=5e-3, warmup=1)
    state = State(objective, course, accelerator)
    told = [*train(state, itertools.repeat(batch_of(*range(6))), course, accelerator)]
    assert told[-1].loss < 0.7 * told[0].loss
    after = [value for part in (teacher, encoder) for value in part.state_dict().values()]
    assert all(torch.equal(a, b) for a, b in zip(before, after, strict=True))
    moved = [not torch.equal(a, b) for a, b in zip(teacher.parameters(), model.network.parameters(), strict=True)]
    assert sum(moved) > 0.9 * len(moved)


def test_only_the_network_is_taught(model: Model) -> None:
    """Neither the teacher nor the photo encoder are among the objective's modules."""
    objective = DistillationObjective(model)
    ids = {id(parameter) for parameter in model.network.parameters()}
    assert {id(parameter) for parameter in objective.parameters_in_training()} == ids
    assert {id(parameter) for parameter in objective.parameters()} == ids
    assert not any(parameter.requires_grad for parameter in model.encoder.parameters())


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_every_part_of_the_student_feels_the_loss(model: Model, batch_of, dtype: torch.dtype) -> None:
    """Its own answer without a gradient comes first under the same autocast: the casts must not be shared."""
    objective = DistillationObjective(model, dtype=dtype)
    objective(batch_of(*SEEDS)).backward()
    felt = [parameter.grad is not None for parameter in objective.parameters_in_training()]
    assert all(felt)
    strong = [bool(parameter.grad.abs().max() > 0) for parameter in objective.parameters_in_training()]
    assert sum(strong) > 0.9 * len(strong)
