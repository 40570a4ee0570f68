"""The loop against one written out by hand over a line with three numbers, and over the tiny model itself."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from accelerate import Accelerator
from torch import Tensor, nn

from mv3d_cli.diffusion.model import Model
from mv3d_cli.diffusion.network import colour_depth_parameters
from mv3d_cli.diffusion.training import Course, Done, State, train
from mv3d_cli.diffusion.training.objectives import DiffusionObjective, Teaching

PLAIN = Teaching(noisiest=0.0, dropout=0.0, dtype=torch.float32)
SHORT = Course(steps=6, rate=0.05, warmup=2, decay=0.5)


class Line(nn.Module):
    """The squared error of `weight . x` from one; `idle` is in no loss."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.tensor([0.3, -0.2, 0.9], dtype=torch.float64))
        self.idle = nn.Parameter(torch.ones(2))

    def forward(self, batch: Tensor) -> Tensor:
        return (batch @ self.weight - 1).square().mean()

    def parameters_in_training(self) -> list[nn.Parameter]:
        return [self.weight]


def batches(count: int = 4) -> Iterator[Tensor]:
    generator = torch.Generator().manual_seed(1)
    while True:
        yield torch.randn(count, 3, generator=generator, dtype=torch.float64) * torch.tensor([1.0, 3.0, 0.2])


def learnt(course: Course, accelerator: Accelerator, given: Iterator[Tensor]) -> tuple[State, list[Done]]:
    state = State(Line(), course, accelerator)
    return state, [*train(state, given, course, accelerator)]


def by_hand(course: Course, given: Iterator[Tensor]) -> tuple[Tensor, Tensor, list[float], list[float]]:
    """The last parameters and averages, all losses and gradients' norms: AdamW, clipping and averaging written out."""
    line = Line()
    optimizer = torch.optim.AdamW([line.weight], weight_decay=0.01)
    average, losses, norms = line.weight.detach().clone(), [], []
    for step in range(course.steps):
        optimizer.param_groups[0]["lr"] = course.rate_at(step)
        loss = torch.stack([line(batch) for batch in itertools.islice(given, course.accumulate)]).mean()
        (gradient,) = torch.autograd.grad(loss, [line.weight])
        line.weight.grad = gradient * min(1.0, course.clip / (gradient.norm().item() + 1e-6))
        optimizer.step()
        decay = min(course.ema, 1 - (1 + step) ** -0.75)  # diffusers' warm-up, at inv_gamma = 1
        average = decay * average + (1 - decay) * line.weight.detach()
        losses.append(loss.item())
        norms.append(gradient.norm().item())
    return line.weight.detach(), average, losses, norms


def test_the_rate_rises_stays_and_falls() -> None:
    course = Course(steps=100, rate=2e-3, warmup=10, decay=0.2)
    steps = np.arange(100)
    expected = 2e-3 * np.interp(steps, [-1, 9, 80, 100], [0, 1, 1, 0])
    assert [course.rate_at(int(step)) for step in steps] == pytest.approx(list(expected))


@pytest.mark.parametrize(
    ("warmup", "decay", "rates"),
    [
        (0, 0.0, [1, 1, 1, 1]),
        (0, 1.0, [1, 3 / 4, 2 / 4, 1 / 4]),
        (8, 0.0, [1 / 8, 2 / 8, 3 / 8, 4 / 8]),
        (4, 1.0, [1 / 4, 2 / 4, 2 / 4, 1 / 4]),
    ],
)
def test_a_course_may_do_without_either_end_or_be_nothing_else(warmup: int, decay: float, rates: list) -> None:
    course = Course(steps=4, rate=1.0, warmup=warmup, decay=decay)
    assert [course.rate_at(step) for step in range(4)] == pytest.approx(rates)


@pytest.mark.parametrize("course", [SHORT, replace(SHORT, accumulate=3), replace(SHORT, clip=0.1, ema=0.5)])
def test_training_is_adamw_clipped_and_averaged(accelerator: Accelerator, course: Course) -> None:
    value, average, losses, norms = by_hand(course, batches())
    state, told = learnt(course, accelerator, batches())
    torch.testing.assert_close(state.parameters[0].detach(), value, atol=1e-12, rtol=1e-7)
    torch.testing.assert_close(state.average.shadow_params[0], average, atol=1e-12, rtol=1e-7)
    assert [done.loss for done in told] == pytest.approx(losses)
    assert [done.norm for done in told] == pytest.approx(norms)
    assert [done.rate for done in told] == [course.rate_at(step) for step in range(course.steps)]
    assert [done.step for done in told] == [1, 2, 3, 4, 5, 6]
    assert state.step == 6


def test_gradients_are_clipped_to_the_norm_told(accelerator: Accelerator) -> None:
    """The first moment after one step is a tenth of the gradient."""
    far = iter([torch.full((4, 3), 50.0, dtype=torch.float64)])
    state, _ = learnt(Course(steps=1, rate=0.1, clip=0.5), accelerator, far)
    assert state.optimizer.state[state.parameters[0]]["exp_avg"].norm().item() == pytest.approx(0.05, rel=1e-5)


def test_averages_lie_within_the_way_and_follow_it(accelerator: Accelerator) -> None:
    state = State(Line(), SHORT, accelerator)
    way = [state.parameters[0].detach().clone()]
    for _ in train(state, batches(), SHORT, accelerator):
        way.append(state.parameters[0].detach().clone())
        average = state.average.shadow_params[0]
        assert (average >= torch.stack(way).amin(dim=0) - 1e-12).all()
        assert (average <= torch.stack(way).amax(dim=0) + 1e-12).all()
    assert (average - way[-1]).abs().max() > 1e-4
    assert (average - way[0]).abs().max() > 1e-4


def test_the_averages_take_the_parameters_place_for_a_while(accelerator: Accelerator) -> None:
    state, _ = learnt(SHORT, accelerator, batches())
    value, average = state.parameters[0].detach().clone(), state.average.shadow_params[0].clone()
    with state.averaged():
        torch.testing.assert_close(state.bare.weight.detach(), average, atol=0, rtol=0)
    torch.testing.assert_close(state.parameters[0].detach(), value, atol=0, rtol=0)
    with pytest.raises(KeyError), state.averaged():
        raise KeyError
    torch.testing.assert_close(state.parameters[0].detach(), value, atol=0, rtol=0)
    assert not torch.equal(value, average)


def test_what_is_not_in_training_is_left_alone(accelerator: Accelerator) -> None:
    state, _ = learnt(SHORT, accelerator, batches())
    assert not state.bare.idle.requires_grad
    assert torch.equal(state.bare.idle, torch.ones(2))


def test_a_training_goes_on_where_its_state_is(accelerator: Accelerator) -> None:
    """The loop may be left after any step and entered again: its course, not its call, says when it ends."""
    whole, _ = learnt(SHORT, accelerator, batches())
    state, given = State(Line(), SHORT, accelerator), batches()
    first = [*itertools.islice(train(state, given, SHORT, accelerator), 2)]
    assert state.step == 2
    second = [*train(state, given, SHORT, accelerator)]
    assert [done.step for done in first + second] == [1, 2, 3, 4, 5, 6]
    assert torch.equal(state.parameters[0], whole.parameters[0])
    assert not [*train(state, given, SHORT, accelerator)]


def test_time_is_told_apart(accelerator: Accelerator, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a clock that batches move by one second, losses by ten, and what follows by a hundred."""
    now = [0.0]

    def takes(seconds: float) -> None:
        now[0] += seconds

    monkeypatch.setattr("mv3d_cli.diffusion.training.time", SimpleNamespace(perf_counter=lambda: now[0]))
    monkeypatch.setattr(Line, "forward", lambda line, batch: takes(10) or line.weight.sum())
    monkeypatch.setattr(accelerator, "clip_grad_norm_", lambda *_: takes(100))
    given = (takes(1) or batch for batch in batches())
    _, told = learnt(Course(steps=2, rate=0.1, accumulate=2), accelerator, given)
    assert [(done.waiting, done.learning, done.stepping) for done in told] == [(2.0, 20.0, 100.0)] * 2


def test_two_batches_a_step_are_one_of_both(model: Model, accelerator, batch_of, monkeypatch) -> None:
    """Plain descent, so that a parameter after a step is as exact as its gradient."""
    monkeypatch.setattr(torch.optim, "AdamW", lambda parameters, lr, **_: torch.optim.SGD(parameters, lr))
    start, after = {name: value.clone() for name, value in model.state_dict().items()}, []
    for given, accumulate in (([batch_of(1, 2, 3, 4)], 1), ([batch_of(1, 2), batch_of(3, 4)], 2)):
        model.load_state_dict(start)
        course = Course(steps=1, rate=1.0, warmup=0, accumulate=accumulate)
        state = State(DiffusionObjective(model, PLAIN), course, accelerator)
        (done,) = train(state, iter(given), course, accelerator)
        after.append((done.loss, [parameter.detach().clone() for parameter in state.parameters]))
    assert after[0][0] == pytest.approx(after[1][0], rel=1e-5)
    torch.testing.assert_close(after[0][1], after[1][1], atol=1e-6, rtol=0)
    moved = [(a - start[name]).abs().max() for a, name in zip(after[0][1], dict(model.named_parameters()), strict=True)]
    assert max(moved) > 0.01


@pytest.mark.parametrize("joint", [True, False])
def test_a_model_learns_its_batch_and_stage_one_spares_colour_depth(model, accelerator, batch_of, joint: bool) -> None:
    spared = [parameter.detach().clone() for parameter in colour_depth_parameters(model.network)]
    course = Course(steps=20, rate=1e-2, warmup=1)
    state = State(DiffusionObjective(model, replace(PLAIN, joint=joint)), course, accelerator)
    told = [*train(state, itertools.repeat(batch_of(1, 2, 3)), course, accelerator)]
    assert told[-1].loss < 0.6 * told[0].loss
    after = [*colour_depth_parameters(model.network)]
    assert all(torch.equal(a, b) for a, b in zip(spared, after, strict=True)) == (not joint)


def test_checkpointed_parts_are_recomputed_while_learning(model: Model, accelerator, batch_of) -> None:
    """A model comes in evaluation mode, in which diffusers does not save memory."""
    state = State(DiffusionObjective(model.eval(), PLAIN), SHORT, accelerator)
    next(train(state, itertools.repeat(batch_of(1)), SHORT, accelerator))
    assert model.network.training
