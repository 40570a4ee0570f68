"""What the training benchmarks have in common: the installed command run to its end, its curve, models' scores."""

from __future__ import annotations

import csv
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from mv3d_cli.capture.examples import EVALUATION, Drawing, Example, example_from_mesh
from mv3d_cli.diffusion.generation import Sampling
from mv3d_cli.diffusion.model import Model
from mv3d_cli.formats.cameras import load_cameras, select
from mv3d_cli.formats.meshes import find_meshes, read_mesh
from mv3d_cli.steps.train import HORIZONTAL
from mv3d_cli.steps.train.validation import answer_of, view_scores
from shared_data import shared

FARTHEST = 3.0  # scene units: where a model sees no surface
MV3D = Path(sys.executable).parent / "mv3d"


@dataclass(frozen=True)
class Run:
    """A finished training: its folder, wall seconds (start-up and validations included), and its curve's rows."""

    folder: Path
    seconds: float
    rows: list[dict[str, str]]

    @property
    def learning_seconds(self) -> float:
        """Seconds of all steps together, waiting for data included; without start-up, validation and checkpoints."""
        from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

        logs = EventAccumulator(str(self.folder / "logs"), size_guidance={"scalars": 0}).Reload()
        parts = ("seconds/waiting", "seconds/learning", "seconds/stepping")
        return sum(scalar.value for part in parts for scalar in logs.Scalars(part))

    def validations(self) -> list[tuple[int, float, float]]:
        """(objects seen, PSNR, depth error) of each validation."""
        found = [row for row in self.rows if row["psnr"]]
        return [(int(row["objects"]), float(row["psnr"]), float(row["depth_error"])) for row in found]


def trained(data: Sequence[object], folder: Path, *options: object, launcher: Sequence[object] = ()) -> Run:
    """Runs `mv3d train` in a process of its own; without `launcher`, the installed command."""
    command = [*map(str, launcher or [MV3D]), "train", *map(str, data), *map(str, options), "-o", str(folder)]
    started = time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, env={**os.environ})
    seconds = time.perf_counter() - started
    with (folder / "curve.csv").open() as file:
        return Run(folder, seconds, list(csv.DictReader(file)))


def scanned_examples(size: int, names: Sequence[str] = HORIZONTAL, drafts: bool = True) -> list[Example]:
    """The scans as they stand, on white, in studio light: what nothing is ever trained on."""
    rig, drawing = select(load_cameras(None), names), Drawing(size=size, drafts=drafts, **EVALUATION)
    rng = np.random.default_rng(0)
    return [example_from_mesh(read_mesh(file), rig, drawing, rng) for file in find_meshes(shared("gso"))]


def scores(model: Model, examples: Sequence[Example], sampling: Sampling, stage: str = "2") -> tuple[float, float]:
    """Mean PSNR (of the views beside the photo) and depth error over the objects."""
    answer = answer_of(stage)
    found = [view_scores(*answer(model.eval(), example, sampling), example) for example in examples]
    psnr, depth = np.mean(found, axis=0)
    return float(psnr), float(depth)


def copied_front(examples: Sequence[Example]) -> tuple[float, float]:
    """Scores of the answer that every view looks like the photo, its depth a plane through the middle."""
    found = []
    for example in examples:
        color = np.repeat(example.photo[None], len(example.color), axis=0)
        found.append(view_scores(color, np.full_like(example.depth, 2.0), example))
    psnr, depth = np.mean(found, axis=0)
    return float(psnr), float(depth)


def drafted(examples: Sequence[Example]) -> tuple[float, float]:
    """Scores of the drafts, as a model gets them."""
    found = []
    for example in examples:
        assert example.draft_color is not None
        assert example.draft_depth is not None
        depth = np.where(example.draft_depth > 0, example.draft_depth, FARTHEST)
        found.append(view_scores(example.draft_color, depth, example))
    psnr, depth = np.mean(found, axis=0)
    return float(psnr), float(depth)


def white(examples: Sequence[Example]) -> float:
    """PSNR of empty pictures."""
    blank = [view_scores(np.full_like(e.color, 255), np.full_like(e.depth, 2.0), e)[0] for e in examples]
    return float(np.mean(blank))


def use_two_threads() -> None:
    """As many threads as the figures in the README were made with."""
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS") or min(2, os.cpu_count() or 1)))
