"""Batches: the same objects and seeds however they are spread over processes, parts of a step, and time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
import torch

from mv3d_cli.capture.examples import EVALUATION, Drawing
from mv3d_cli.diffusion.autoencoder import pictures_from_depth
from mv3d_cli.diffusion.training.objectives import Batch
from mv3d_cli.errors import MissingInput
from mv3d_cli.steps.settings import Warned, silent
from mv3d_cli.steps.train import supply as module
from mv3d_cli.steps.train.order import Order
from mv3d_cli.steps.train.sources import Source, example_of
from mv3d_cli.steps.train.supply import Examples, Supply, check_usable, drawing_of, drawn, encoded


@pytest.fixture
def examples(settings, objects, smallest):
    """examples(lanes, total, sources=objects, reuse=2): what those lanes are taught with."""

    def made(lanes: Sequence[int], total: int, sources: Sequence[Source] = objects, reuse: int = 2) -> Examples:
        config = settings()
        return Examples(
            sources, config, drawing_of(config, smallest), Order(len(sources), lanes, total, reuse, config.seed)
        )

    return made


@pytest.fixture
def supply(examples, model):
    """supply(lanes, total, accumulate=1, jobs=0): the batches of those lanes."""

    def made(lanes: Sequence[int], total: int, accumulate: int = 1, jobs: int = 0) -> Supply:
        return Supply(examples(lanes, total), model, torch.device("cpu"), torch.float32, accumulate, jobs, silent)

    return made


def rows(batches: Sequence[Batch]) -> list[tuple]:
    """What the objects of the batches are, one after another."""
    found = []
    for batch in batches:
        parts = (batch.photo, batch.latents, batch.photo_latent, batch.world_from_camera)
        found += [(seed, *(part[i].numpy().tobytes() for part in parts)) for i, seed in enumerate(batch.seeds)]
    return found


def taken(source: Supply, start: int, count: int) -> list[Batch]:
    return [*islice(source.batches(start), count)]


def test_two_processes_are_one_with_twice_the_batch(supply) -> None:
    whole = taken(supply(range(4), 4), 0, 5)
    first, second = taken(supply(range(2), 4), 0, 5), taken(supply(range(2, 4), 4), 0, 5)
    for together, *parts in zip(whole, first, second, strict=True):
        assert rows(parts) == rows([together])


def test_two_batches_a_step_are_one_of_twice_the_size(supply) -> None:
    whole = taken(supply(range(4), 4), 0, 4)
    parts = taken(supply(range(4), 4, accumulate=2), 0, 8)
    assert [len(batch.seeds) for batch in parts] == [2] * 8
    assert rows(parts) == rows(whole)


@pytest.mark.parametrize("start", [1, 3, 6])
def test_a_later_start_goes_on_alike(supply, start: int) -> None:
    assert rows(taken(supply(range(2), 2), start, 3)) == rows(taken(supply(range(2), 2), 0, start + 3)[start:])


def test_a_process_of_its_own_draws_the_same(supply) -> None:
    assert rows(taken(supply(range(2), 2, jobs=1), 2, 4)) == rows(taken(supply(range(2), 2), 2, 4))


def test_objects_and_seeds_change_from_step_to_step(supply) -> None:
    batches = taken(supply(range(3), 3), 0, 12)
    seeds = [seed for batch in batches for seed in batch.seeds]
    assert len(set(seeds)) == len(seeds)
    photos = {photo for _, photo, *_ in rows(batches)}
    assert len(seeds) / 3 < len(photos) < len(seeds)


def test_each_example_is_encoded_once_and_kept_while_it_serves(supply, monkeypatch) -> None:
    asked = []

    def counted(example, *rest):
        asked.append(example["number"])
        return encoded(example, *rest)

    monkeypatch.setattr(module, "encoded", counted)
    source = supply(range(4), 4)
    taken(source, 0, 9)
    assert len(set(asked)) == len(asked)
    assert set(asked) == set().union(*(source.examples.order.living(step) for step in range(9)))


def test_latents_are_those_of_the_pictures(settings, model) -> None:
    drawing = Drawing(size=8, **EVALUATION)
    example = example_of(Source("a", "", seed=1), settings(), drawing, np.random.default_rng(0))
    arrays = {name: torch.from_numpy(value) for name, value in vars(example).items() if value is not None}
    taught = encoded(arrays, model, torch.device("cpu"), torch.float32)
    pictures = model.autoencoder.decode(taught.latents)
    color = torch.from_numpy(example.color).permute(0, 3, 1, 2).double() / 255 * 2 - 1
    torch.testing.assert_close(pictures[0].double(), color, atol=1e-6, rtol=0)
    assert torch.equal(pictures[1], pictures_from_depth(torch.from_numpy(example.depth)))
    assert torch.equal(model.autoencoder.decode(taught.photo_latent), taught.photo)
    assert torch.equal(taught.photo, pictures[0, 0])  # a clean photo is the first view


def test_clean_objects_are_always_the_same(settings, smallest) -> None:
    clean, varied = (
        drawing_of(settings(**how), smallest) for how in ({"clean": True}, {"elevation": 10.0, "least": 0.7})
    )
    assert clean == Drawing(size=8, **EVALUATION)
    assert (varied.elevation, varied.least, varied.lighting, varied.varied) == (10, 0.7, "random", True)


def test_a_broken_object_gives_way_and_is_told_of_once(examples, objects, broken) -> None:
    told: list[Warned] = []
    sources = [objects[0], broken, objects[1]]
    items = [*islice(drawn(examples(range(1), 1, sources, reuse=1), 0, 0, told.append), 9)]
    assert all("photo" in item for item in items)
    assert sum(bool(item["failed"]) for item in items) == 3  # once an epoch
    assert [warned.text.split(":")[0] for warned in told] == ["broken is left out"]


def test_data_without_a_usable_object_is_told_at_once(examples, broken) -> None:
    sources = [broken, replace(broken, name="again")]
    with pytest.raises(MissingInput, match=r"no object of the data can be used; .*truncated") as caught:
        check_usable(examples(range(1), 1, sources))
    assert caught.value.hint
    check_usable(examples(range(1), 1, [broken, Source("good", "", seed=1)]))
