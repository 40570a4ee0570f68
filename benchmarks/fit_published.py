"""How near surfaces from 16 true renders come to the truth by SyncDreamer's mesh protocol, beside published figures.

Ten objects of its test set; colour and outline from known places, no depth. Nothing was learnt from other objects. The
published rows were given one picture, except for the last, which was given true renders as we are; they are means over
all 30 objects, copied from the papers.

    python benchmarks/fit_published.py [--steps 200] [--neus] [--objects NAME,...]

The seconds of fit-sdf are those of its refinement alone; `--steps 0` has depth from colour, fusion and meshing. The
constants of depth from colour were chosen on four of these objects (chicken, sofa, alarm, teapot).
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from mv3d_cli.scene.mesh import Mesh
from shared_data import shared, table

EXTENT = 1.05  # half the box that is searched for the surface
PUBLISHED = (
    ("SyncDreamer", 0.0261, 0.5421),
    ("InstantMesh", 0.0224, 0.5353),
    ("Wonder3D", 0.0199, 0.6244),
    ("Wonder3D++", 0.0193, 0.6402),
    ("true renders, reconstructed (SV3D's setting)", 0.021, 0.689),
)


def meshes_of(views, true, steps: int, neus: bool) -> Iterator[tuple[str, Mesh]]:
    """Names, and the mesh that each makes."""
    from mv3d_cli.steps.fit_sdf import Config
    from mv3d_cli.steps.fit_sdf.building import fitted, refined
    from mv3d_cli.steps.sdf_fit import MeshSettings, mesh_of
    from mv3d_cli.steps.settings import silent

    bare = MeshSettings(texture=0)
    yield "visual hull", surface(views, 0)
    if neus:
        yield "NeuS from the hull", surface(views, steps)
    with TemporaryDirectory() as work:
        fusion = fitted(Config(steps=0), views, silent, Path(work))
        yield "fit-sdf --steps 0", mesh_of(fusion, bare)
        yield "fit-sdf", mesh_of(refined(Config(steps=steps), fusion, silent, Path(work)), bare)
    yield "true depth, fused (what can be had)", surface(with_true_depth(views, true), 0)


def surface(views, steps: int) -> Mesh:
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
    parser.add_argument("--neus", action="store_true", help="volume rendering instead of depth from colour, too")
    parser.add_argument("--objects", default=",".join(SYNCED))
    given = parser.parse_args()
    shared("gso30")
    found: dict[str, list[tuple[float, float, float]]] = {}
    for name in given.objects.split(","):
        views, true = synced_object(name)
        cameras = [view.camera for view in views.frames]
        started = time.perf_counter()
        for method, mesh in meshes_of(views, true, given.steps, given.neus):
            seconds = time.perf_counter() - started
            found.setdefault(method, []).append((*syncdreamer_scores(mesh, true, cameras), seconds))
            started = time.perf_counter()
        print(f"{name}: " + ", ".join(f"{method} {of[-1][0]:.4f} {of[-1][1]:.3f}" for method, of in found.items()))
    means = [(method, *np.mean(of, axis=0)) for method, of in found.items()]
    rows = [[method, f"{cd:.4f}", f"{iou:.3f}", f"{seconds:.1f}"] for method, cd, iou, seconds in means]
    rows += [[f"published: {method}", f"{cd:.4f}", f"{iou:.3f}", ""] for method, cd, iou in PUBLISHED]
    print()
    table(["method", "Chamfer", "volume IoU", "seconds"], rows)


if __name__ == "__main__":
    main()
