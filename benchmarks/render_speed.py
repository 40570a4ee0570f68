"""How fast is `mv3d render`, and what does it spend its time on?

The whole step in one process, kernels warm, another seed each time so that nothing comes from the cache: one scanned
object (Dino_4, 22 k faces), 12 views of 512², colour, depth and normal files written. Beside it the same run by
Blender's Cycles; then our parts one by one, and the rasteriser alone on a finer mesh.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

import numpy as np
import trimesh

from mv3d_cli.capture.lighting import studio
from mv3d_cli.capture.rendering import render, sun_camera
from mv3d_cli.capture.sheet import sheet_of_views
from mv3d_cli.formats.cameras import load_cameras
from mv3d_cli.formats.images import write_png
from mv3d_cli.formats.meshes import find_meshes, read_mesh
from mv3d_cli.formats.views_folder import write_views
from mv3d_cli.kernels.rasterize import rasterize
from mv3d_cli.kernels.shade import lights, model
from mv3d_cli.scene.mesh import Mesh
from mv3d_cli.scene.views import Views
from mv3d_cli.steps.render import Config, run
from shared_data import empty_cache, in_unit_sphere, shared, table

SIZE = 512
SAMPLES = 16


def seconds(work: Callable[[int], object], times: int, warm: bool = True) -> list[float]:
    """Wall-clock seconds of `work(i)`, i counting up; the first call is not counted if `warm`."""
    found = []
    for i in range(times + warm):
        started = time.perf_counter()
        work(i)
        found.append(time.perf_counter() - started)
    return found[warm:]


def whole_step(times: int) -> list[float]:
    folder = shared("gso/Dino_4")
    return seconds(lambda i: run(Config(size=SIZE, seed=i), [folder]), times)


def whole_step_by_blender() -> float:
    config = Config(size=SIZE, seed=0, engine="blender", samples=SAMPLES)
    return seconds(lambda _: run(config, [shared("gso/Dino_4")]), 1, warm=False)[0]


def write_files(views: Views) -> None:
    with tempfile.TemporaryDirectory() as folder:
        write_views(Path(folder), views)
        write_png(Path(folder) / "sheet.png", sheet_of_views(views))


def parts(times: int) -> dict[str, float]:
    """Median seconds of what the step does, in its order."""
    file, light, rig = find_meshes(shared("gso/Dino_4"))[0], studio(), load_cameras()
    mesh = in_unit_sphere(read_mesh(file))
    looks = model(mesh)
    sun = sun_camera(light.sun_direction)
    views = render(mesh, rig, SIZE, light)
    found = {
        "read the mesh": seconds(lambda _: in_unit_sphere(read_mesh(file)), times),
        "bring it to the device, mip levels": seconds(lambda _: model(mesh), times),
        "shadow map": seconds(lambda _: lights(light, looks, sun), times),
        "all of rendering": seconds(lambda _: render(mesh, rig, SIZE, light), times),
        "write 36 pictures and a contact sheet": seconds(lambda _: write_files(views), times),
    }
    result = {name: median(values) for name, values in found.items()}
    before = result["bring it to the device, mip levels"] + result["shadow map"]
    drawing = {"draw 12 views": result.pop("all of rendering") - before}
    *first, (last, value) = result.items()
    return {**dict(first), **drawing, last: value}


def finer(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Every face cut into four."""
    vertices, faces, *_ = trimesh.remesh.subdivide(mesh.vertices, mesh.faces)
    return vertices.astype(np.float32), faces.astype(np.int32)


def rasteriser(times: int) -> tuple[int, float]:
    """Faces of a finer mesh, and the median seconds of 12 views of it."""
    vertices, faces = finer(in_unit_sphere(read_mesh(find_meshes(shared("gso/Dino_4"))[0])))
    rig = load_cameras()
    return len(faces), median(seconds(lambda _: rasterize(vertices, faces, rig, SIZE, SIZE), times))


def main() -> None:
    parser = argparse.ArgumentParser(description="Time of mv3d render, beside Blender.")
    parser.add_argument("--times", type=int, default=7, help="runs to take the median of")
    parser.add_argument("--no-blender", action="store_true", help="leave out the run by Blender (half a minute)")
    options = parser.parse_args()
    with empty_cache():
        ours = whole_step(options.times)
        split = parts(options.times)
        faces, alone = rasteriser(options.times)
        theirs = None if options.no_blender else whole_step_by_blender()
    rows = [
        ["mv3d render, median", f"{median(ours):.3f} s", "<= 0.4 s"],
        ["mv3d render, best", f"{min(ours):.3f} s", ""],
    ]
    if theirs is not None:
        rows.append([f"Blender Cycles, {SAMPLES} samples", f"{theirs:.1f} s", ""])
        rows.append(["Blender / ours", f"{theirs / median(ours):.0f}x", ">= 50x"])
    rows += [[f"- {name}", f"{value:.3f} s", ""] for name, value in split.items()]
    rows.append(["- the rest: digests, fsync, manifest", f"{median(ours) - sum(split.values()):.3f} s", ""])
    rows.append([f"rasteriser alone, {faces} faces, 12 views", f"{alone * 1e3:.0f} ms", "<= 60 ms"])
    table(["Dino_4, 12 views 512², files written", "measured", "target"], rows)


if __name__ == "__main__":
    main()
