"""Does the whole chain learn? One object, five minutes from nothing on a CPU, its other views asked for.

PSNR of the 7 views beside the photo and depth error (scene units, inside the true outline); with colour-depth
attention (stage 2) and without (stage 1), in equal time. Agreement: how much the outline that the colours show and the
one that the depth shows overlap (IoU), sampled in 4 steps, mean over the views.

    python benchmarks/train_overfit.py [--minutes 5] [--object NAME]
"""

from __future__ import annotations

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from mv3d_cli.capture.examples import EVALUATION, Drawing, Example, example_from_mesh
from mv3d_cli.diffusion.generation import Sampling
from mv3d_cli.diffusion.model import Model
from mv3d_cli.diffusion.model.checkpoint import load_model
from mv3d_cli.formats.cameras import load_cameras, select
from mv3d_cli.formats.meshes import find_meshes, read_mesh
from mv3d_cli.metrics.overlap import iou
from mv3d_cli.steps.train import HORIZONTAL
from mv3d_cli.steps.train.validation import FAR, answer_of
from shared_data import empty_cache, shared, table
from training_runs import scores, trained, use_two_threads

OBJECT = "pmndrs_market__delivery-truck"
SIZE, BATCH, RATE = 32, 1, 1e-3
SEEDS = 8
NOT_WHITE = 12  # 8-bit steps from white, at least, where colours show the object


def agreement(model: Model, example: Example, steps: int) -> float:
    """IoU of the outlines by colour and by depth, mean over views and seeds."""
    found = []
    for seed in range(SEEDS):
        color, depth = answer_of("2")(model.eval(), example, Sampling(steps, seed=seed))
        by_color, by_depth = (color < 255 - NOT_WHITE).any(axis=-1), depth < FAR
        found += [iou(one, other) for one, other in zip(by_color, by_depth, strict=True)]
    return float(np.mean(found))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=5)
    parser.add_argument("--object", default=OBJECT)
    given = parser.parse_args()
    use_two_threads()
    mesh = shared(f"objects/{given.object}.glb")
    rig = select(load_cameras(None), HORIZONTAL)
    drawing = Drawing(size=SIZE, drafts=True, **EVALUATION)
    example = example_from_mesh(read_mesh(find_meshes(mesh)[0]), rig, drawing, np.random.default_rng(0))
    rows = []
    with empty_cache(), TemporaryDirectory() as scratch:
        for name, stage in (("with colour-depth attention", 2), ("without", 1)):
            options = ["--preset", "tiny", "--stage", stage, "--batch", BATCH, "--clean", "--reuse", 1000]
            options += ["--steps", 100_000, "--decay", 0, "--jobs", 0, "--validate-every", 0, "--lr", RATE]
            run = trained([mesh], Path(scratch) / name, *options, "--max-time", f"{given.minutes}m")
            model = load_model(run.folder)
            for steps in (1, 4):
                psnr, depth = scores(model, [example], Sampling(steps))
                shown = f"{agreement(model, example, steps):.4f}"
                rows.append([name, len(run.rows), steps, f"{psnr:.2f}", f"{depth:.4f}", shown])
    table([f"{given.minutes:g} min from nothing", "steps", "DDIM steps", "PSNR dB", "depth error", "agreement"], rows)
    print("\ntargets: above 25 dB, under .02")


if __name__ == "__main__":
    main()
