"""How near surfaces from 16 true renders come to the truth by SyncDreamer's mesh protocol, beside published figures.

Ten objects of its test set; colour and outline from known places, no depth. Nothing was learnt from other objects. The
published rows were given one picture, except for the last, which was given true renders as we are; they are means over
all 30 objects, copied from the papers.

    python benchmarks/fit_published.py [--steps 200] [--objects NAME,...]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from shared_data import shared, table

EXTENT = 1.05  # half the box that is searched for the surface
PUBLISHED = (
    ("SyncDreamer", 0.0261, 0.5421),
    ("InstantMesh", 0.0224, 0.5353),
    ("Wonder3D", 0.0199, 0.6244),
    ("Wonder3D++", 0.0193, 0.6402),
    ("true renders, reconstructed (SV3D's setting)", 0.021, 0.689),
)


def methods(views, true, steps: int) -> Iterator[tuple[str, Callable]]:
    """Names, and what makes the mesh."""
    from mv3d_cli.fields.stereo import with_depth_from_color

    yield "visual hull", lambda: fitted(views, 0)
    yield "NeuS from the hull", lambda: fitted(views, steps)
    yield "depth from colour, fused", lambda: fitted(with_depth_from_color(views), 0)
    yield "depth from colour, fused and fitted", lambda: fitted(with_depth_from_color(views), steps)
    yield "true depth, fused (what can be had)", lambda: fitted(with_true_depth(views, true), 0)


def fitted(views, steps: int):
    """The surface of the views' fusion, after some steps of fitting."""
    import torch

    from mv3d_cli.fields.fitting import Config, fit
    from mv3d_cli.fields.fusion import fuse
    from mv3d_cli.fields.relief import reliefs_of
    from mv3d_cli.fields.sdf import field_of
    from mv3d_cli.meshes.surface import surface_of_field, surface_of_grid

    reliefs = reliefs_of(views)
    fusion = fuse(reliefs)
    if not steps:
        return surface_of_grid(fusion.distance, np.array(fusion.origin), fusion.voxel)
    field = field_of(fusion)
    for _ in fit(field, reliefs, Config(steps=steps)):
        pass

    def distance(points: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return field.distance(torch.from_numpy(points)).numpy()

    return surface_of_field(distance, EXTENT * np.array([[-1.0] * 3, [1.0] * 3]), 192)


def with_true_depth(views, mesh):
    """The views with the depth that their cameras see of the true mesh."""
    from mv3d_cli.kernels.rasterize import rasterize

    height, width = views.frames[0].shape
    depths = rasterize(mesh.vertices, mesh.faces, [view.camera for view in views.frames], width, height).depth
    frames = [replace(view, depth=depth) for view, depth in zip(views.frames, depths, strict=True)]
    return replace(views, frames=tuple(frames))


def main() -> None:
    from mv3d_cli.metrics.syncdreamer import syncdreamer_scores
    from reconstruction_scores import SYNCED, synced_object

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--objects", default=",".join(SYNCED))
    given = parser.parse_args()
    shared("gso30")
    found: dict[str, list[tuple[float, float, float]]] = {}
    for name in given.objects.split(","):
        views, true = synced_object(name)
        cameras = [view.camera for view in views.frames]
        for method, make in methods(views, true, given.steps):
            started = time.perf_counter()
            mesh = make()
            seconds = time.perf_counter() - started
            found.setdefault(method, []).append((*syncdreamer_scores(mesh, true, cameras), seconds))
        print(f"{name}: " + ", ".join(f"{method} {of[-1][0]:.4f} {of[-1][1]:.3f}" for method, of in found.items()))
    means = [(method, *np.mean(of, axis=0)) for method, of in found.items()]
    rows = [[method, f"{cd:.4f}", f"{iou:.3f}", f"{seconds:.1f}"] for method, cd, iou, seconds in means]
    rows += [[f"published: {method}", f"{cd:.4f}", f"{iou:.3f}", ""] for method, cd, iou in PUBLISHED]
    print()
    table(["method", "Chamfer", "volume IoU", "seconds"], rows)


if __name__ == "__main__":
    main()
