"""Scores of answers that are right, or wrong by a known amount."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from mv3d_cli.capture.examples import EVALUATION, Drawing, Example
from mv3d_cli.diffusion.generation import Sampling
from mv3d_cli.diffusion.model import Model
from mv3d_cli.errors import MissingInput
from mv3d_cli.steps.train import validation as module
from mv3d_cli.steps.train.validation import examples_for, validated, view_scores

DRAWING = Drawing(size=8, **EVALUATION)
ONE = Sampling(1, "ddim")


@pytest.fixture
def shown(settings, objects) -> list[Example]:
    return examples_for(objects[:2], settings(), DRAWING)


def test_scores_of_known_errors(shown: list[Example]) -> None:
    example = replace(shown[0], color=np.full_like(shown[0].color, 100))
    off = example.color.copy()
    off[1] += 10
    deeper = np.where(example.depth > 0, example.depth + 0.25, 3.0).astype(np.float32)
    psnr, depth = view_scores(off, deeper, example)
    assert psnr == pytest.approx(20 * np.log10(255 / 10))
    assert depth == pytest.approx(0.25, abs=1e-6)
    off[0] = 0  # the photo's own view does not count
    assert view_scores(off, example.depth, example) == (pytest.approx(psnr), 0)


def test_a_single_view_counts(shown: list[Example]) -> None:
    color = np.full_like(shown[0].color[:1], 100)
    one = replace(shown[0], color=color, depth=shown[0].depth[:1], world_from_camera=shown[0].world_from_camera[:1])
    assert view_scores(one.color + np.uint8(10), one.depth, one)[0] == pytest.approx(20 * np.log10(255 / 10))


def test_pictures_that_are_only_folded_come_back(model: Model, shown: list[Example]) -> None:
    score = validated(model, shown, "autoencoder", ONE)
    assert score.psnr == float("inf")
    assert score.depth < 1e-6


def test_true_views_score_as_true_and_others_do_not(model: Model, shown: list[Example], monkeypatch) -> None:
    """The network's answer replaced by the truth: what lies between it and the scores loses nothing."""
    asked = []

    def truth(model, photo, poses, sampling, drafts):
        example = shown[len(asked) % 2]
        asked.append((photo, poses, sampling))
        color = torch.from_numpy(example.color).permute(0, 3, 1, 2)[None] / 127.5 - 1
        return color, torch.from_numpy(example.depth)[None]

    monkeypatch.setattr(module, "generated", truth)
    score = validated(model, shown, "1", ONE)
    assert (score.psnr, score.depth) == (float("inf"), 0)
    photo, poses, sampling = asked[1]
    assert photo[0, :, 3, 4].tolist() == pytest.approx((shown[1].photo[3, 4] / 127.5 - 1).tolist(), abs=1e-6)
    assert torch.equal(poses[0], torch.from_numpy(shown[1].world_from_camera))
    assert sampling == ONE
    wrong = validated(model, shown[::-1], "1", ONE)
    assert wrong.psnr < 20
    assert wrong.depth > 0.01


@pytest.mark.parametrize("sampling", [ONE, Sampling(4, "lcm")])
def test_a_model_is_asked_the_same_each_time_and_training_does_not_notice(
    model: Model, shown: list[Example], sampling: Sampling
) -> None:
    before = torch.get_rng_state()
    first, again = (validated(model.eval(), shown, "1", sampling) for _ in range(2))
    assert torch.equal(torch.get_rng_state(), before)
    assert (first.psnr, first.depth) == (again.psnr, again.depth)
    assert np.array_equal(first.sheet, again.sheet)
    assert 0 < first.psnr < 30
    cells = [np.unique(cell.reshape(-1, 3), axis=0) for cell in np.array_split(first.sheet, 8)]
    assert all(len(colors) > 1 for colors in cells)  # two objects of four rows


def test_examples_are_always_the_same_and_broken_objects_are_left_out(settings, objects, broken) -> None:
    whole, again = (examples_for(objects[:2], settings(), DRAWING) for _ in range(2))
    assert all(np.array_equal(a.color, b.color) for a, b in zip(whole, again, strict=True))
    assert not np.array_equal(whole[0].color, whole[1].color)
    assert len(examples_for([broken, *objects[:2]], settings(), DRAWING)) == 2
    with pytest.raises(MissingInput, match=r"no object to validate on can be used; broken: .*truncated"):
        examples_for([broken], settings(), DRAWING)
