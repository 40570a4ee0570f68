"""From objects to batches: examples are drawn in processes of their own, encoded once, and kept while they serve."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler

from mv3d_cli.capture.examples import EVALUATION, Drawing
from mv3d_cli.diffusion.autoencoder import pictures_from_bytes, stacked_pictures
from mv3d_cli.diffusion.model import Model
from mv3d_cli.diffusion.model.config import ModelConfig
from mv3d_cli.diffusion.training.objectives import Batch
from mv3d_cli.errors import InputError, MissingInput
from mv3d_cli.kernels.runtime import use_threads
from mv3d_cli.steps.settings import Tell, Warned, silent
from mv3d_cli.steps.train.order import Order
from mv3d_cli.steps.train.sources import Source, example_of

if TYPE_CHECKING:
    from mv3d_cli.steps.train import Config

TRIES = 32  # objects that may fail one after another
AHEAD = 4  # examples drawn ahead by each process
TYPICAL = 48  # examples by which drafts are judged


def drawing_of(config: Config, model: ModelConfig) -> Drawing:
    """How the settings want examples to be drawn for such a model."""
    size = model.picture_size
    if config.clean:
        return evaluation_drawing(model)
    how = Drawing(size, config.elevation, config.least, config.lighting, config.facing)
    return replace(how, drafts=model.drafts, backgrounds=config.backgrounds)


def evaluation_drawing(model: ModelConfig) -> Drawing:
    """How such a model is scored: every object always the same."""
    return Drawing(size=model.picture_size, drafts=model.drafts, **EVALUATION)


@dataclass(frozen=True)
class Examples(Dataset):
    """Examples by number, as tensors that travel between processes; an object that fails gives way to the next."""

    sources: Sequence[Source]
    config: Config
    drawing: Drawing
    order: Order

    def __getitem__(self, number: int) -> dict[str, Any]:
        rng = np.random.default_rng([self.config.seed, 3, number])
        first, failed = self.order.object_of(number), []
        for step in range(min(TRIES, len(self.sources))):
            source = self.sources[(first + step) % len(self.sources)]
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    example = example_of(source, self.config, self.drawing, rng)
            except InputError as error:
                failed.append((source.name, str(error), error.hint))
                continue
            arrays = {name: torch.from_numpy(value) for name, value in vars(example).items() if value is not None}
            return {"number": number, "failed": failed, **arrays}
        return {"number": number, "failed": failed}


class _Numbers(Sampler):
    """The numbers of the examples in the order in which they are needed."""

    def __init__(self, order: Order, start: int):
        self.order, self.start = order, start

    def __iter__(self) -> Iterator[int]:
        return self.order.arriving(self.start)


def drawn(examples: Examples, start: int, jobs: int, tell: Tell) -> Iterator[dict[str, Any]]:
    """Examples in the order of their first need from a step on. Raises MissingInput where no object can be used."""
    loader = DataLoader(
        examples,
        batch_size=None,
        sampler=_Numbers(examples.order, start),
        num_workers=jobs,
        worker_init_fn=_start_worker,
        multiprocessing_context="spawn" if jobs else None,
        prefetch_factor=AHEAD if jobs else None,
    )
    told: set[str] = set()
    for item in loader:
        for name, reason, _ in item["failed"]:
            if name not in told:
                told.add(name)
                tell(Warned(f"{name} is left out: {reason}"))
        if "photo" not in item:
            name, reason, hint = item["failed"][0]
            raise MissingInput(f"no object of the data can be used; {name}: {reason}", hint)
        yield item


def _start_worker(number: int) -> None:
    use_threads(1)


@dataclass(frozen=True)
class Encoded:
    """An example as the network is taught with it, on the training device."""

    photo: Tensor
    latents: Tensor
    photo_latent: Tensor
    world_from_camera: Tensor
    drafts: Tensor | None


def encoded(example: dict[str, Any], model: Model, device: torch.device, dtype: torch.dtype) -> Encoded:
    """An example's latents; one at a time, so that the bytes do not depend on what else is encoded beside it."""
    photo = pictures_from_bytes(example["photo"].to(device))
    pictures = stacked_pictures(example["color"].to(device), example["depth"].to(device))
    drafts = None
    with torch.no_grad(), torch.autocast(device.type, dtype, enabled=dtype != torch.float32):
        latents = model.autoencoder.encode(torch.cat([pictures.flatten(0, 1), photo[None]])).float()
        if "draft_color" in example:
            guesses = stacked_pictures(example["draft_color"].to(device), example["draft_depth"].to(device))
            drafts = model.autoencoder.encode(guesses).float()
    poses = example["world_from_camera"].to(device)
    return Encoded(photo, latents[:-1].unflatten(0, pictures.shape[:2]), latents[-1], poses, drafts)


@dataclass
class Supply:
    """Batches for this process, from a step on; `accumulate` of them a step.

    accumulate  the batches of a step use lanes of their own, so that two of 8 are one of 16
    """

    examples: Examples
    model: Model
    device: torch.device
    dtype: torch.dtype
    accumulate: int
    jobs: int
    tell: Tell

    def batches(self, start: int) -> Iterator[Batch]:
        """The batches, without end."""
        order, seed = self.examples.order, self.examples.config.seed
        arriving = drawn(self.examples, start, self.jobs, self.tell)
        kept: dict[int, Encoded] = {}
        step = start
        share = len(order.lanes) // self.accumulate
        while True:
            wanted = order.living(step)
            kept = {number: example for number, example in kept.items() if number in wanted}
            while not wanted <= kept.keys():
                example = next(arriving)
                kept[example["number"]] = encoded(example, self.model, self.device, self.dtype)
            for part in range(self.accumulate):
                lanes = order.lanes[part * share : (part + 1) * share]
                chosen = [kept[order.chosen(lane, step)] for lane in lanes]
                yield _together(chosen, tuple(_seed_of(seed, lane, step) for lane in lanes))
            step += 1


def _together(chosen: Sequence[Encoded], seeds: tuple[int, ...]) -> Batch:
    parts = [name for name, value in vars(chosen[0]).items() if value is not None]
    stacked = {name: torch.stack([getattr(example, name) for example in chosen]) for name in parts}
    return Batch(**stacked, seeds=seeds)


def _seed_of(seed: int, lane: int, step: int) -> int:
    """The seed of an object's loss: it stands for the place in the training and not for the process."""
    return int(np.random.SeedSequence([seed, 4, lane, step]).generate_state(1, np.uint64)[0] >> 1)


def trust_drafts(model: Model, examples: Examples) -> None:
    """Tells a network that mends drafts, before it learns anything else, how good they are on the first examples."""
    mending = model.network.mending
    if mending is None:
        return
    device = next(model.parameters()).device
    first = (examples[number] for number in range(TYPICAL))
    known = [encoded(example, model, device, torch.float32) for example in first if "photo" in example]
    clean, poses = (torch.stack([getattr(e, name) for e in known]) for name in ("latents", "world_from_camera"))
    mending.fit(clean, torch.stack([e.drafts for e in known if e.drafts is not None]), poses)


def check_usable(examples: Examples) -> None:
    """Draws one example here, so that data that cannot be used is told of at once. Raises MissingInput."""
    next(drawn(examples, 0, 0, silent))
