"""How long `mv3d generate` takes with the bundled model, and where: the whole command, its start, the model alone.

One photo, 8 views of 256 x 256 in colour and depth. Cold: a fresh process and an empty cache, as a user's first call.
After loading: the same in one process, again and again. Targets on two cores: 12 s and 6 s.

    python benchmarks/generate_speed.py [--runs 5]
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from mv3d_cli.capture.draft import draft_views
from mv3d_cli.capture.photo import cut_out
from mv3d_cli.capture.photo.framing import framed
from mv3d_cli.diffusion.model.checkpoint import load_model
from mv3d_cli.formats.assets import asset
from mv3d_cli.formats.cameras import load_cameras, select
from mv3d_cli.formats.images import read_photo
from mv3d_cli.steps.generate import HORIZONTAL, Config
from mv3d_cli.steps.generate.making import answered, views_of
from mv3d_cli.steps.settings import silent
from shared_data import empty_cache, shared, table
from training_runs import MV3D, use_two_threads

PHOTO = "photos/owl.png"


def cold(photo: Path) -> tuple[float, float]:
    """(seconds, peak MiB) of the command, by itself."""
    with empty_cache(), TemporaryDirectory() as scratch:
        started = time.perf_counter()
        command = [str(MV3D), "generate", str(photo), "-o", f"{scratch}/views"]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, env={**os.environ})
        _, status, usage = os.wait4(process.pid, 0)
        if status:
            raise SystemExit("the command failed")
        return time.perf_counter() - started, usage.ru_maxrss / 1024


def warm(photo: Path, runs: int) -> dict[str, list[float]]:
    """Seconds of each part, `runs` times in this process."""
    found: dict[str, list[float]] = {}

    def timed(name: str, job: Callable[..., Any], *given: Any) -> Any:
        started = time.perf_counter()
        value = job(*given)
        found.setdefault(name, []).append(time.perf_counter() - started)
        return value

    model = timed("load the model", load_model, asset("weights/small"))
    cameras = select(load_cameras(), HORIZONTAL)
    for _ in range(runs):
        pixels = timed("read the photo", read_photo, photo)
        mask = timed("cut the object out", cut_out, pixels)
        cut = np.dstack([pixels[..., :3], mask])
        frame = timed("frame it", framed, cut, model.config.picture_size, 0.7)
        draft = timed("the draft of 8 views", draft_views, frame, cameras)
        for steps in (1, 4):
            answer = timed(f"the model, steps: {steps}", answered, model, frame, draft, Config(steps=steps))
        timed("views of its answer", views_of, frame, cameras, answer, silent)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=5)
    given = parser.parse_args()
    use_two_threads()
    photo = shared(PHOTO)
    whole = [cold(photo) for _ in range(given.runs)]
    rows = [["the whole command, cold", f"{median(s for s, _ in whole):.2f}", f"{min(s for s, _ in whole):.2f}"]]
    for name, seconds in warm(photo, given.runs).items():
        rows.append([name, f"{median(seconds):.3f}", f"{min(seconds):.3f}"])
    table(["seconds", "median", "best"], rows)
    here = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"\npeak memory: the command {max(m for _, m in whole):.0f} MiB, this process {here:.0f} MiB")


if __name__ == "__main__":
    main()
