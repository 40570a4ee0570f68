"""How many objects a minute does `mv3d render` draw, what fails and why, and how much memory does it take?

The real command on the folder of training objects: 8 horizontal views of 256², two worker processes. Memory is
resident memory read from /proc, summed over the command and its workers, so pages that they share count twice.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from mv3d_cli.formats.meshes import SUFFIXES
from mv3d_cli.scene.rig import HORIZONTAL
from shared_data import empty_cache, shared, table

JOBS = 2
SIZE = 256


@dataclass
class Peak:
    """The most resident memory seen, MiB."""

    tree: float = 0.0
    process: float = 0.0


def resident(pid: int) -> list[float]:
    """MiB of a process and of all below it; those that end meanwhile are left out."""
    try:
        own = int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * 4096 / 2**20
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except OSError:
        return []
    return [own] + [size for child in children for size in resident(int(child))]


def watch(pid: int, ended: threading.Event, peak: Peak) -> None:
    while not ended.wait(0.2):
        sizes = resident(pid)
        peak.tree, peak.process = max(peak.tree, sum(sizes)), max([peak.process, *sizes])


def some_of(objects: Path, limit: int, folder: Path) -> Path:
    """A folder of links to `limit` of the meshes, evenly taken; all of them if `limit` is 0."""
    meshes = sorted(path for path in objects.iterdir() if path.suffix in SUFFIXES)
    if not 0 < limit < len(meshes):
        return objects
    for i in range(limit):
        mesh = meshes[i * len(meshes) // limit]
        (folder / mesh.name).symlink_to(mesh.resolve())
    return folder


def measure(objects: Path) -> tuple[Path, float, Peak]:
    """The data set's folder, the seconds it took, and the memory."""
    command = [sys.executable, "-m", "mv3d_cli", "render", str(objects), "--size", str(SIZE)]
    command += ["--views", ",".join(HORIZONTAL), "--jobs", str(JOBS)]
    started = time.perf_counter()
    peak, ended = Peak(), threading.Event()
    with tempfile.TemporaryFile() as log:
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True)
        watcher = threading.Thread(target=watch, args=(process.pid, ended, peak))
        watcher.start()
        line = process.communicate()[0]
        ended.set()
        watcher.join()
        if process.returncode:
            log.seek(0)
            sys.exit(f"mv3d render ended with {process.returncode}: {log.read()[-600:].decode(errors='replace')}")
    return Path(line.strip()), time.perf_counter() - started, peak


def main() -> None:
    parser = argparse.ArgumentParser(description="Objects a minute, failures and memory of a batch.")
    parser.add_argument("--limit", type=int, default=0, help="draw this many objects only, evenly taken; 0 = all")
    options = parser.parse_args()
    with empty_cache(), tempfile.TemporaryDirectory() as links:
        result, elapsed, peak = measure(some_of(shared("objects"), options.limit, Path(links)))
        drawn = len(json.loads((result / "index.json").read_text())["objects"])
        failures = json.loads((result / "failures.json").read_text())
    rows = [
        ["objects drawn", drawn],
        ["wall clock", f"{elapsed:.0f} s"],
        ["objects a minute", f"{drawn / elapsed * 60:.0f}"],
        ["peak memory, all processes", f"{peak.tree:.0f} MiB"],
        ["peak memory, one process", f"{peak.process:.0f} MiB"],
        ["objects failed", len(failures)],
    ]
    for reason, count in Counter(failure["reason"] for failure in failures).most_common(10):
        rows.append([f"- {reason[:90]}", count])
    table([f"8 views of {SIZE}², --jobs {JOBS}", "measured"], rows)


if __name__ == "__main__":
    main()
