"""Teaching a model: the loop is a generator, and what an objective, a batch and a course are is said once.

The state after a step depends on the step's number, the batches and the start alone, so a training that was killed and
goes on from its state equals an unbroken one.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Protocol

import torch
from accelerate import Accelerator
from diffusers.training_utils import EMAModel
from torch import Tensor, nn

from mv3d_cli.diffusion.training.objectives import Batch


class Objective(Protocol):
    """A module whose `forward(batch)` is a mean loss."""

    def parameters_in_training(self) -> list[nn.Parameter]: ...


@dataclass(frozen=True)
class Course:
    """How long and how fast: `rate` rises over `warmup` steps and falls to zero over the last `decay` of them all.

    accumulate  batches a step; `clip`: the gradient's greatest norm; `ema`: the greatest decay of the moving average
    """

    steps: int
    rate: float
    warmup: int = 100
    decay: float = 0.2
    accumulate: int = 1
    clip: float = 1.0
    ema: float = 0.9999

    def rate_at(self, step: int) -> float:
        """The learning rate of a step, counted from 0."""
        rising = (step + 1) / max(self.warmup, 1)
        falling = (self.steps - step) / max(self.decay * self.steps, 1)
        return self.rate * min(rising, falling, 1.0)


@dataclass(frozen=True)
class Done:
    """One step: its number from 1, its mean loss over all processes, its gradient, and where its seconds went."""

    step: int
    loss: float
    norm: float
    rate: float
    waiting: float
    learning: float
    stepping: float


class State:
    """Everything that a step changes: an objective's parameters, their moving average, the optimizer, the step."""

    def __init__(self, objective: nn.Module, course: Course, accelerator: Accelerator):
        self.bare = objective
        self.parameters: list[nn.Parameter] = objective.parameters_in_training()  # type: ignore[operator]
        chosen = {id(parameter) for parameter in self.parameters}
        for parameter in objective.parameters():
            parameter.requires_grad_(id(parameter) in chosen)
        optimizer = torch.optim.AdamW(self.parameters, lr=course.rate, weight_decay=0.01, fused=True)
        self.average = EMAModel(self.parameters, decay=course.ema, use_ema_warmup=True, power=3 / 4)
        self.step = 0
        self.objective, self.optimizer = accelerator.prepare(objective, optimizer)

    def averaged(self) -> Averaged:
        """A context in which the parameters are their moving averages."""
        return Averaged(self)


class Averaged:
    """The moving averages put in the parameters' place, and taken out again."""

    def __init__(self, state: State):
        self.state = state

    def __enter__(self) -> None:
        self.state.average.store(self.state.parameters)
        self.state.average.copy_to(self.state.parameters)

    def __exit__(self, *error: object) -> None:
        self.state.average.restore(self.state.parameters)


def train(state: State, batches: Iterator[Batch], course: Course, accelerator: Accelerator) -> Iterator[Done]:
    """Go on from `state` to the course's end, changing it; each step is yielded when it is whole."""
    state.objective.train()
    while state.step < course.steps:
        rate = course.rate_at(state.step)
        for group in state.optimizer.param_groups:
            group["lr"] = rate
        loss, waiting, learning = _gradients(state, batches, course, accelerator)
        started = time.perf_counter()
        norm = accelerator.clip_grad_norm_(state.parameters, course.clip)
        state.optimizer.step()
        state.optimizer.zero_grad()
        state.average.step(state.parameters)
        state.step += 1
        loss = accelerator.reduce(loss, "mean").item()  # type: ignore[union-attr]
        steepness = 0.0 if norm is None else float(norm)  # none where another engine clips
        yield Done(state.step, loss, steepness, rate, waiting, learning, time.perf_counter() - started)


def _gradients(
    state: State, batches: Iterator[Batch], course: Course, accelerator: Accelerator
) -> tuple[Tensor, float, float]:
    """The gradients of one step's batches in the parameters; mean loss, seconds of waiting, seconds of learning."""
    total, waiting, started = torch.zeros((), device=accelerator.device), 0.0, time.perf_counter()
    for part in range(course.accumulate):
        asked = time.perf_counter()
        batch = next(batches)
        waiting += time.perf_counter() - asked
        last = part == course.accumulate - 1
        with nullcontext() if last else accelerator.no_sync(state.objective):
            loss = state.objective(batch) / course.accumulate
            accelerator.backward(loss)
        total += loss.detach()
    return total, waiting, time.perf_counter() - started - waiting
