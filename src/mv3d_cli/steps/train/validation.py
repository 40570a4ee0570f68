"""How good a model is by now: objects it is not taught with, their true views beside its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import UInt8

from mv3d_cli.capture.examples import Drawing, Example
from mv3d_cli.capture.sheet import sheet_of_rows
from mv3d_cli.diffusion.autoencoder import depth_from_pictures, pictures_from_bytes, stacked_pictures
from mv3d_cli.diffusion.devices import has_quick_bf16
from mv3d_cli.diffusion.generation import Sampling, generated
from mv3d_cli.diffusion.model import Model
from mv3d_cli.errors import InputError, MissingInput
from mv3d_cli.metrics.depth import depth_error
from mv3d_cli.metrics.image import psnr
from mv3d_cli.steps.train import Config
from mv3d_cli.steps.train.sources import Source, example_of

FAR = 2.95  # scene units: what is predicted beyond is shown as background


Answer = Callable[[Model, Example, Sampling], tuple[np.ndarray, np.ndarray]]
"""(colours, depths) of an example's views, as a model has them."""


@dataclass(frozen=True)
class Validation:
    """Means over the objects: PSNR of the views beside the photo (dB), depth error (scene units), and the pictures."""

    psnr: float
    depth: float
    sheet: UInt8[np.ndarray, "rows columns 3"]


def examples_for(
    sources: Sequence[Source], config: Config, drawing: Drawing, use: str = "validate on"
) -> list[Example]:
    """An example of each object, always the same; objects that cannot be used are left out.

    Raises MissingInput where not one can be used.
    """
    found, failed = [], []
    for number, source in enumerate(sources):
        try:
            found.append(example_of(source, config, drawing, np.random.default_rng([config.seed, 5, number])))
        except InputError as error:
            failed.append((source.name, error))
    if not found:
        name, error = failed[0]
        raise MissingInput(f"no object to {use} can be used; {name}: {error}", error.hint)
    return found


def validated(model: Model, examples: Sequence[Example], stage: str, sampling: Sampling) -> Validation:
    """Scores and pictures of the model's answers for the objects."""
    answer = answer_of(stage)
    scores, rows = [], []
    for example in examples:
        color, depth = answer(model, example, sampling)
        scores.append(view_scores(color, depth, example))
        rows += _rows(example, color, depth)
    means = np.mean(scores, axis=0)
    return Validation(float(means[0]), float(means[1]), sheet_of_rows(rows))


def answer_of(stage: str) -> Answer:
    """What a stage's model is asked: the pictures through the autoencoder, or the views of the photo."""
    return _recoded if stage == "autoencoder" else _generated


def view_scores(color: np.ndarray, depth: np.ndarray, example: Example) -> tuple[float, float]:
    """PSNR of all views but the photo's (all, where there is but one), and the depth error of all."""
    start = 1 if len(color) > 1 else 0
    pairs = zip(color[start:], example.color[start:], strict=True)
    return float(np.mean([psnr(_opaque(ours), _opaque(true)) for ours, true in pairs])), depth_error(
        depth, example.depth
    )


@torch.no_grad()
def _recoded(model: Model, example: Example, sampling: Sampling) -> tuple[np.ndarray, np.ndarray]:
    device = next(model.parameters()).device
    again = model.autoencoder.decode(model.autoencoder.encode(pictures_of(example).to(device))).float().cpu()
    color, depth = again.chunk(2)
    return _bytes(color), depth_from_pictures(depth, farthest=2.0).numpy()


def _generated(model: Model, example: Example, sampling: Sampling) -> tuple[np.ndarray, np.ndarray]:
    device = next(model.parameters()).device
    photo = pictures_from_bytes(torch.from_numpy(example.photo))[None].to(device)
    poses = torch.from_numpy(example.world_from_camera)[None].to(device)
    drafts = None
    if example.draft_color is not None and example.draft_depth is not None:
        guesses = torch.from_numpy(example.draft_color), torch.from_numpy(example.draft_depth)
        drafts = stacked_pictures(*guesses)[None].to(device)
    with torch.autocast(device.type, torch.bfloat16, enabled=has_quick_bf16(device)):
        color, depth = generated(model, photo, poses, sampling, drafts)
    return _bytes(color[0].cpu()), depth[0].cpu().numpy()


def _bytes(color: torch.Tensor) -> np.ndarray:
    return ((color.clamp(-1, 1) + 1) * 127.5).round().to(torch.uint8).permute(0, 2, 3, 1).numpy()


def _opaque(color: np.ndarray) -> np.ndarray:
    return np.dstack([color, np.full(color.shape[:2], 255, np.uint8)])


def _rows(example: Example, color: np.ndarray, depth: np.ndarray) -> list[list[np.ndarray | None]]:
    """True colours, ours, true depth, ours; the photo before the first row."""
    ours = np.where(depth < FAR, depth, 0.0)
    return [
        [_opaque(example.photo), *map(_opaque, example.color)],
        [None, *map(_opaque, color)],
        [None, *example.depth],
        [None, *ours],
    ]


def pictures_of(example: Example) -> torch.Tensor:
    """Colours, then depths, as the autoencoder takes them."""
    return stacked_pictures(torch.from_numpy(example.color), torch.from_numpy(example.depth)).flatten(0, 1)
