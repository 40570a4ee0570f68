"""How long `mv3d fit-sdf` takes, start to file, and how that grows with views, resolution, steps and picture size.

The installed command in a process of its own, kernels compiled before, an empty cache of results each time; views of a
scan under the standard perturbation, texture and GLB included. Peak memory is the process's own. The exponent p of
time ~ n^p is fitted to the last two lines of each run.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from mv3d_cli.capture.lighting import studio
from mv3d_cli.capture.rendering import render
from mv3d_cli.formats.views_folder import write_views
from mv3d_cli.scene.camera import Orthographic, direction_on_sphere, look_at_origin
from mv3d_cli.scene.views import Views
from perturbed_views import generated_like
from reconstruction_scores import rig
from shared_data import scanned_mesh, shared, table

SCAN = "Dino_4"
MV3D = Path(sys.executable).parent / "mv3d"


def views_of(count: int, size: int) -> Views:
    """Perturbed views of the scan: the rig's eight, or `count` of a ring."""
    cameras = list(rig())[:count]
    for turn in range(count - len(cameras)):
        place = direction_on_sphere(np.deg2rad(22.5 + 45 * turn), 0.0)
        cameras.append(look_at_origin(f"between_{turn}", place, Orthographic()))
    return generated_like(render(scanned_mesh(SCAN), cameras, size, studio()), seed=0)


def timed(folder: Path, *options: object) -> tuple[float, float]:
    """Seconds and peak MiB of the command on a views folder."""
    with tempfile.TemporaryDirectory() as cache:
        command = [str(MV3D), "fit-sdf", str(folder), *map(str, options), "-o", f"{cache}/out/mesh.glb"]
        started = time.perf_counter()
        process = subprocess.Popen(
            command, env={**os.environ, "MV3D_CACHE_DIR": f"{cache}/c"}, stdout=subprocess.DEVNULL
        )
        _, status, usage = os.wait4(process.pid, 0)
        seconds = time.perf_counter() - started
    if status:
        raise SystemExit(f"{' '.join(command)} failed")
    return seconds, usage.ru_maxrss / 1024


def growth(counts: Sequence[float], seconds: Sequence[float]) -> str:
    return f"{np.polyfit(np.log(counts[-2:]), np.log(seconds[-2:]), 1)[0]:.2f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--quick", action="store_true", help="the main figures alone")
    given = parser.parse_args()
    shared("gso")
    with tempfile.TemporaryDirectory() as scratch:

        def folder(count: int = 8, size: int = 256, clean: bool = False) -> Path:
            place = Path(scratch) / f"{count}-{size}-{clean}"
            if not place.exists():
                views = views_of(count, size)
                if clean:
                    views = render(scanned_mesh(SCAN), rig(), size, studio())
                    views = Views(tuple(replace(view, normal=None) for view in views.frames))
                write_views(place, views)
            return place

        timed(folder())
        rows = []
        for name, options in (("default", ()), ("--quick", ("--quick",)), ("--texture 0", ("--texture", 0))):
            for kind in (False, True):
                found = [timed(folder(clean=kind), *options) for _ in range(given.repeat)]
                seconds, peak = np.median([s for s, _ in found]), max(p for _, p in found)
                spread = f"{min(s for s, _ in found):.1f}-{max(s for s, _ in found):.1f}"
                rows.append(
                    [name, "clean" if kind else "generated-like", f"{seconds:.1f} s", spread, f"{peak:.0f} MiB"]
                )
        table(["8 views of 256²", "views", "median", "spread", "peak memory"], rows)
        if given.quick:
            return
        print()
        runs = (
            ("views", (2, 4, 8, 16), lambda n: (folder(n),)),
            ("resolution", (96, 192, 384), lambda n: (folder(), "--resolution", n)),
            ("steps", (100, 200, 400, 800), lambda n: (folder(), "--steps", n)),
            ("pixels a side", (128, 256, 512), lambda n: (folder(8, n),)),
        )
        rows = []
        for name, counts, arguments in runs:
            found = [timed(*arguments(n)) for n in counts]
            for n, (seconds, peak) in zip(counts, found, strict=True):
                rows.append([name, n, f"{seconds:.1f} s", f"{peak:.0f} MiB", ""])
            rows[-1][-1] = growth(counts, [seconds for seconds, _ in found])
        table(["grows", "to", "time", "peak memory", "exponent"], rows)


if __name__ == "__main__":
    main()
