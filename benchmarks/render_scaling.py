"""How do time and memory of rendering grow with views and with faces?

A bumpy ball with normals under the studio light, in memory, kernels warm, best of three; every line is a process of
its own, so that its peak memory is its own too. The exponent p of time ~ n^p is fitted to the last three lines of
each run; 1 is linear growth, below 1 the fixed costs still show.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time

import numpy as np

from mv3d_cli.capture.lighting import studio
from mv3d_cli.capture.rendering import render
from mv3d_cli.scene.camera import Camera, Orthographic, direction_on_sphere, look_at_origin
from mv3d_cli.scene.mesh import Material, Mesh
from shared_data import table

VIEWS = (1, 2, 4, 8, 16, 24)
FACES = (1_000, 4_000, 16_000, 64_000, 250_000, 1_000_000)
SIZES = (256, 512)
USUAL_VIEWS, USUAL_FACES = 8, 64_000


def bumpy_ball(faces: int) -> Mesh:
    """A closed grid of latitudes and longitudes, about `faces` triangles, its radius in waves."""
    rows = max(round(np.sqrt(faces / 4)), 3)
    polar, turn = np.meshgrid(np.linspace(0, np.pi, rows + 1), np.linspace(0, 2 * np.pi, 2 * rows + 1), indexing="ij")
    radius = 0.85 + 0.08 * np.sin(8 * turn) * np.sin(polar) ** 2 * np.cos(7 * polar)
    grid = radius[..., None] * np.stack(
        [np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)], axis=-1
    )
    normals = np.cross(np.gradient(grid, axis=0), np.gradient(grid, axis=1))
    normals[[0, -1]] = [[[0, 0, 1]], [[0, 0, -1]]]
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    i = np.arange(grid[..., 0].size, dtype=np.int32).reshape(grid.shape[:2])
    a, b, c, d = i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]
    triangles = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    points, directions = (values.reshape(-1, 3).astype(np.float32) for values in (grid, normals))
    material = np.zeros(len(triangles), np.int32)
    return Mesh(points, triangles, material, (Material(base_color=(0.7, 0.6, 0.5, 1.0)),), normals=directions)


def ring(count: int) -> tuple[Camera, ...]:
    """Cameras evenly around the object."""
    turns = 2 * np.pi * np.arange(count) / count
    return tuple(look_at_origin(f"{i}", direction_on_sphere(t, 0.3), Orthographic()) for i, t in enumerate(turns))


def one(views: int, faces: int, size: int) -> None:
    """Measures in this process; prints JSON."""
    mesh, light, best = bumpy_ball(faces), studio(), np.inf
    for _ in range(4):
        started = time.perf_counter()
        render(mesh, ring(views), size, light)
        best = min(best, time.perf_counter() - started)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps({"faces": len(mesh.faces), "seconds": best, "peak": peak}))


def measured(views: int, faces: int, size: int) -> dict[str, float]:
    command = [sys.executable, __file__, "--one", str(views), str(faces), str(size)]
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def exponent(counts: list[float], seconds: list[float]) -> str:
    return f"{np.polyfit(np.log(counts[-3:]), np.log(seconds[-3:]), 1)[0]:.2f}"


def run_of(what: str, cases: list[tuple[int, int]], size: int) -> list[list[object]]:
    """The lines of one run, the exponent on the last."""
    found = [measured(views, faces, size) for views, faces in cases]
    counts = [case[0] if what == "views" else line["faces"] for case, line in zip(cases, found, strict=True)]
    rows: list[list[object]] = []
    for (views, _), line in zip(cases, found, strict=True):
        time_and_peak = [f"{1e3 * line['seconds']:.0f} ms", f"{line['peak']:.0f} MiB"]
        rows.append([f"{size}²", views, int(line["faces"]), *time_and_peak, ""])
    rows[-1][-1] = f"{what}^{exponent(counts, [line['seconds'] for line in found])}"
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description="Time and memory against views and faces.")
    parser.add_argument("--one", type=int, nargs=3, metavar=("VIEWS", "FACES", "SIZE"), help="one case, as JSON")
    parser.add_argument("--quick", action="store_true", help="smaller pictures only, fewer faces")
    options = parser.parse_args()
    if options.one:
        one(*options.one)
        return
    rows = []
    for size in SIZES[:1] if options.quick else SIZES:
        rows += run_of("views", [(views, USUAL_FACES) for views in VIEWS], size)
        rows += run_of("faces", [(USUAL_VIEWS, faces) for faces in FACES[: -1 if options.quick else None]], size)
    table(["size", "views", "faces", "time", "peak memory", "growth"], rows)


if __name__ == "__main__":
    main()
