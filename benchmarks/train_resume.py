"""A training that is killed twice with kill -9 equals an unbroken one; two processes equal one with twice the batch.

python benchmarks/train_resume.py [--steps 24]
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from safetensors.torch import load_file

from shared_data import empty_cache, shared, table
from training_runs import MV3D, Run, trained

TORCHRUN = (sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node", 2, "-m", "mv3d_cli")
OPTIONS = ("--preset", "tiny", "--stage", 2, "--precision", "fp32", "--validate-every", 0, "--jobs", 0)


def killed(data: Path, folder: Path, options: list[object], cache: Path, kills: int) -> Run:
    """The same training, killed `kills` times once it has gone on from where it was, then let through."""
    command = [str(MV3D), "train", str(data), *map(str, options), "--save-every", "0", "-o", str(folder)]
    seen = -1
    for _ in range(kills):
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        seen = _wait_for_checkpoint(cache, seen)
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        print(f"killed after a checkpoint at {time.strftime('%X')}", flush=True)
    return trained([data], folder, *options, "--save-every", 0)


def _wait_for_checkpoint(cache: Path, seen: float, patience: float = 300) -> float:
    """Waits until a checkpoint is newer than `seen` by some steps; returns its time."""
    until = time.monotonic() + patience
    while time.monotonic() < until:
        for path in cache.glob("v1/train/*/*.work/state.safetensors"):
            written = path.stat().st_mtime
            if written > seen + 2:
                return written
        time.sleep(0.05)
    raise SystemExit("no checkpoint came")


def losses(run: Run) -> list[float]:
    return [float(row["loss"]) for row in run.rows]


def farthest(one: Run, other: Run) -> float:
    """The greatest relative difference of the losses."""
    pairs = zip(losses(one), losses(other), strict=True)
    return max(abs(a - b) / abs(a) for a, b in pairs)


def weights_apart(one: Run, other: Run) -> float:
    first, second = (load_file(run.folder / "model.safetensors") for run in (one, other))
    return max((first[name] - second[name]).abs().max().item() for name in first)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=24)
    given = parser.parse_args()
    data = shared("objects")
    rows = []
    with TemporaryDirectory() as scratch:
        place, options = Path(scratch), [*OPTIONS, "--steps", given.steps, "--batch", 4]
        with empty_cache():
            unbroken = trained([data], place / "unbroken", *options)
        with empty_cache() as cache:
            broken = killed(data, place / "broken", options, cache, kills=2)
        rows.append(["killed twice with kill -9", farthest(unbroken, broken), weights_apart(unbroken, broken)])
        halves = [*OPTIONS, "--steps", given.steps, "--batch", 2]
        with empty_cache():
            together = trained([data], place / "together", *halves, launcher=TORCHRUN)
        rows.append(
            ["two processes of half the batch", farthest(unbroken, together), weights_apart(unbroken, together)]
        )
    table([f"{given.steps} steps, beside an unbroken run", "losses apart (relative)", "weights apart"], rows)


if __name__ == "__main__":
    main()
