"""What was tried for the small model: short trainings of equal time that differ in one thing, scored on scans.

32 x 32 pixels, the tiny model's setting; PSNR of one step from pure noise and the depth error, at the end of the time,
at the learning rate and with the moving average that the time ends with.

    python benchmarks/train_choices.py [--minutes 4] [--only NAME,...]
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from mv3d_cli.diffusion.generation import Sampling
from mv3d_cli.diffusion.model import Model
from mv3d_cli.diffusion.model.checkpoint import load_model, save_model
from mv3d_cli.diffusion.model.config import tiny
from mv3d_cli.diffusion.noise import NoiseSettings
from shared_data import empty_cache, shared, table
from training_runs import scanned_examples, scores, trained, use_two_threads


@dataclass(frozen=True)
class Choice:
    """One thing done otherwise: parts of the network's or the model's configuration, options, or stage 1 for half of
    the time."""

    network: dict[str, Any] = field(default_factory=dict)
    model: dict[str, Any] = field(default_factory=dict)
    options: tuple[object, ...] = ()
    stage_1_first: bool = False


CHOICES = {
    "as decided": Choice(),
    "the photo's latent, no drafts": Choice(model={"drafts": False}),
    "no drafts, and predicts v": Choice(model={"drafts": False, "noise": NoiseSettings(prediction="v_prediction")}),
    "no floor under the weight at pure noise": Choice(options=("--floor", 0)),
    "stage 1 for half of the time, then 2": Choice(stage_1_first=True),
    "attention at 8 x 8 as well as at 4 x 4": Choice(
        {
            "down_block_types": ("CrossAttnDownBlock2D", "CrossAttnDownBlock2D"),
            "up_block_types": ("CrossAttnUpBlock2D", "CrossAttnUpBlock2D"),
        }
    ),
    "wider: 128, 256": Choice({"block_out_channels": (128, 256), "attention_head_dim": (2, 4)}),
    "two transformer blocks a level": Choice({"transformer_layers_per_block": 2}),
    "learning rate 5e-4": Choice(options=("--lr", 5e-4)),
    "half of the objects get pure noise": Choice(options=("--noisiest", 0.5)),
    "each example once": Choice(options=("--reuse", 1)),
}


def run_of(choice: Choice, minutes: float, scratch: Path) -> tuple[Path, int, float]:
    """The trained model's folder, the objects it saw, and its parameters in millions."""
    torch.manual_seed(0)
    config = tiny()
    model = Model(replace(config, network=config.network | choice.network, **choice.model))
    save_model(model, scratch / "start")
    parameters = sum(p.numel() for p in model.parameters()) / 1e6
    common = ["--steps", 10**6, "--decay", 0, "--validate-every", 0, "--validation", shared("gso")]
    common += ["--batch", 8, "--lr", 1e-3, "--warmup", 30, *choice.options]
    stages = [("1", minutes / 2), ("2", minutes / 2)] if choice.stage_1_first else [("2", minutes)]
    objects, start = 0, scratch / "start"
    for stage, time in stages:
        folder = scratch / f"stage{stage}"
        options = ["--stage", stage, "--from", start, "--max-time", f"{time}m", *common]
        objects += int(trained([shared("objects")], folder, *options).rows[-1]["objects"])
        start = folder
    return start, objects, parameters


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=4)
    parser.add_argument("--only", default="", help="parts of the choices' names, with commas between")
    given = parser.parse_args()
    use_two_threads()
    examples, rows = scanned_examples(tiny().picture_size), []
    for name, choice in CHOICES.items():
        if given.only and not any(part in name for part in given.only.split(",")):
            continue
        with empty_cache(), TemporaryDirectory() as scratch:
            folder, objects, parameters = run_of(choice, given.minutes, Path(scratch))
            model = load_model(folder)
            found = [scores(model, examples, Sampling(steps)) for steps in (1, 4)]
        rows.append([name, f"{parameters:.1f} M", objects, *(f"{v:.2f}" for v, _ in found), f"{found[0][1]:.3f}"])
        print(*rows[-1], sep="; ", flush=True)
    print()
    table([f"{given.minutes:g} min", "parameters", "objects", "PSNR, 1 step", "4 steps", "depth error"], rows)


if __name__ == "__main__":
    main()
