"""How a model learns to see other sides: a training at 32 x 32 pixels for a fixed time, scored on scans it never sees.

Beside it, the curve of a first trial (a transformer of 9.6 M parameters, 7.5 objects a second on the same two cores)
at the same number of objects seen, and the trivial answers. The trial drew its scans otherwise (its empty picture had
13.3 dB and its copy of the front view 18.2), so both are also given less what copying has. One step from pure noise;
then PSNR by sampling steps.

    python benchmarks/train_learning.py [--minutes 30] [--keep FOLDER]
"""

from __future__ import annotations

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from mv3d_cli.diffusion.generation import Sampling
from mv3d_cli.diffusion.model.checkpoint import load_model
from shared_data import empty_cache, shared, table
from training_runs import Run, copied_front, drafted, scanned_examples, scores, trained, use_two_threads, white

TRIAL = {1800: 16.1, 3500: 17.1, 5300: 17.5, 7100: 17.8, 8900: 18.0, 11000: 18.1}
"""Objects seen, and PSNR then."""
TRIAL_RATE = 7.5  # objects a second
TRIAL_COPY = 18.2  # dB of copying the front view, in its pictures
BATCH, VALIDATE = 8, 222  # steps between validations: close to the trial's
SIZE = 32


def learnt(minutes: float, folder: Path) -> Run:
    """A training that takes about so long: its rate is measured first, so that the learning rate's fall fits in."""
    options = ["--preset", "tiny", "--stage", 2, "--batch", BATCH, "--lr", 1e-3, "--warmup", 50]
    options += ["--validation", shared("gso")]
    data = [shared("objects")]
    trial = trained(data, folder / "rate", *options, "--steps", 60, "--validate-every", 0)
    rate = 60 * BATCH / trial.learning_seconds
    steps = int(minutes * 60 * rate / BATCH)
    return trained(data, folder / "model", *options, "--steps", steps, "--validate-every", VALIDATE)


def curve(run: Run, copy: float) -> None:
    """The run's PSNR at the objects at which the trial's is known, and at its end; `copy`: that of copying."""
    seen, psnr, depth = (np.array(values) for values in zip(*run.validations(), strict=True))
    rows = []
    for objects, theirs in TRIAL.items():
        ours = f"{np.interp(objects, seen, psnr):.2f}" if objects <= seen[-1] else "-"
        error = f"{np.interp(objects, seen, depth):.3f}" if objects <= seen[-1] else "-"
        beside = f"{np.interp(objects, seen, psnr) - copy:+.2f}" if objects <= seen[-1] else "-"
        rows.append([objects, ours, theirs, beside, f"{theirs - TRIAL_COPY:+.2f}", error])
    rows.append([seen[-1], f"{psnr[-1]:.2f}", "-", f"{psnr[-1] - copy:+.2f}", "-", f"{depth[-1]:.3f}"])
    table(["objects seen", "PSNR dB", "trial's", "less copying", "trial's less copying", "depth error"], rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=30)
    parser.add_argument("--keep", type=Path, help="where to keep the model")
    given = parser.parse_args()
    use_two_threads()
    with empty_cache(), TemporaryDirectory() as scratch:
        run = learnt(given.minutes, given.keep or Path(scratch))
        objects, seconds = int(run.rows[-1]["objects"]), run.learning_seconds
        print(f"{objects} objects in {seconds / 60:.1f} min of learning: {objects / seconds:.1f} a second", end="")
        print(f" (trial: {TRIAL_RATE}; both without validation and start-up)\n")
        examples, model = scanned_examples(SIZE), load_model(run.folder)
        copy = copied_front(examples)[0]
        curve(run, copy)
        psnr, depth = drafted(examples)
        print(
            f"\nwhite {white(examples):.2f} dB, copy the front view {copy:.2f} dB, drafts {psnr:.2f} dB, {depth:.3f}\n"
        )
        rows = []
        for steps in (1, 2, 4, 8, 16):
            psnr, depth = scores(model, examples, Sampling(steps))
            rows.append([steps, f"{psnr:.2f}", f"{depth:.3f}"])
        table(["DDIM steps", "PSNR dB", "depth error"], rows)


if __name__ == "__main__":
    main()
