"""What each part of `fit-sdf` is worth: the whole without it, on clean and on generated-like views.

Objects that constants were chosen on; one draw of the perturbation. CD and CDp as in fit_quality.py, mean over the
objects; seconds are of the fit without meshing, on one thread.
"""

from __future__ import annotations

import argparse
import os
import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any
from unittest.mock import patch

import numpy as np

from shared_data import shared, table

OBJECTS = ("Dino_4", "Nintendo_Yoshi_Action_Figure", "Schleich_Bald_Eagle", "BUNNY_RACER")
STEPS = 200


@dataclass(frozen=True)
class Variant:
    """Changes to the whole: constants by (module, name), losses left out, settings, other inputs or another start."""

    constants: dict[tuple[str, str], Any] = field(default_factory=dict)
    without: tuple[str, ...] = ()
    settings: dict[str, Any] = field(default_factory=dict)
    aligned: bool = True
    outlines: bool = True
    sphere: bool = False
    depthless: bool = False


CORRESPONDENCE = "mv3d_cli.fields.alignment.correspondence"
VARIANTS = {
    "the whole": Variant(),
    "fusion alone": Variant(settings={"steps": 0}),
    "60 steps": Variant(settings={"steps": 60}),
    "500 steps": Variant(settings={"steps": 500}),
    "no alignment": Variant(aligned=False),
    "alignment without colours": Variant(constants={(CORRESPONDENCE, "PHOTOMETRIC"): 0.0}),
    "alignment without outlines": Variant(outlines=False),
    "from a sphere, not the fusion": Variant(sphere=True),
    "gradients at .03": Variant(settings={"tap": (0.03, 0.03)}),
    "gradients at .003": Variant(settings={"tap": (0.003, 0.003)}),
    "all levels at once": Variant(settings={"levels": 8}),
    "worst tenth dropped": Variant(settings={"dropped": 0.1}),
    "no depth loss": Variant(without=("depth",)),
    "no projective loss": Variant(without=("projective",)),
    "no hull loss": Variant(without=("hull",)),
    "no eikonal loss": Variant(without=("eikonal",)),
    "no normal loss": Variant(without=("normal",)),
    "volume rendering, not depth": Variant(depthless=True),
}


def outcome(variant: Variant, views: Any, truth: Any) -> tuple[float, float, float, float, float]:
    """CD, CDp, F@.01, normal consistency, seconds."""
    from mv3d_cli.fields import fitting
    from mv3d_cli.steps.sdf_fit import MeshSettings, mesh_of, residual_of
    from reconstruction_scores import score

    with ExitStack() as changes:
        for (module, name), value in variant.constants.items():
            changes.enter_context(patch(f"{module}.{name}", value))
        kept = {name: 0.0 if name in variant.without else share for name, share in fitting.SHARES.items()}
        changes.enter_context(patch.object(fitting, "SHARES", kept))
        started = time.perf_counter()
        fit, aligned, start = _start(variant, views)
        config = fitting.Config(**{"steps": STEPS} | variant.settings)
        if variant.depthless:
            aligned = [replace(relief, depth=None, slope=None) for relief in aligned]
        for _ in fitting.fit(start, aligned, config):
            pass
        seconds = time.perf_counter() - started
        made = replace(fit, residual=residual_of(start)) if config.steps else fit
        if variant.sphere:
            changes.enter_context(patch("mv3d_cli.fields.sdf.field_of", lambda fusion: start))
        found = score(mesh_of(made, MeshSettings(texture=0)), truth)
    return found.chamfer, found.chamfer_plane, found.f_01, found.normals, seconds


def _start(variant: Variant, views: Any) -> tuple[Any, Any, Any]:
    """The fit before its refinement, its aligned reliefs, and the field that is refined."""
    from mv3d_cli.fields import sdf
    from mv3d_cli.fields.alignment import Alignment, align
    from mv3d_cli.fields.alignment.warps import still
    from mv3d_cli.fields.relief import reliefs_of
    from mv3d_cli.steps.sdf_fit import Fit, fusion_of

    reliefs = reliefs_of(views)
    held = [view.source == "photo" for view in views.frames]
    shown = reliefs if variant.outlines else [replace(relief, outline=None) for relief in reliefs]
    nothing = Alignment(tuple(still() for _ in reliefs), float("nan"), float("nan"))
    alignment = align(shown, held) if variant.aligned else nothing
    fit = Fit(views, np.eye(4), alignment, 192)
    aligned, fusion = fusion_of(fit)
    if variant.sphere:
        axis = fusion.origin[0] + fusion.voxel * np.arange(len(fusion.distance), dtype=np.float32)
        x, y, z = np.meshgrid(axis, axis, axis, indexing="ij", sparse=True)
        fusion = replace(fusion, distance=np.sqrt(x**2 + y**2 + z**2).astype(np.float32) - 0.5, reach=10.0)
    return fit, aligned, sdf.field_of(fusion)


def of_object(name: str, variants: list[str]) -> dict[tuple[str, bool], tuple[float, ...]]:
    """Outcomes of one object by variant and condition."""
    import torch

    from mv3d_cli.kernels.runtime import use_threads
    from perturbed_views import generated_like
    from reconstruction_scores import clean_views, ground_truth

    torch.set_num_threads(1)
    use_threads(1)
    mesh, views = clean_views(name)
    truth, spoilt = ground_truth(mesh), generated_like(views, 0)
    return {
        (variant, clean): outcome(VARIANTS[variant], views if clean else spoilt, truth)
        for variant in variants
        for clean in (True, False)
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--objects", default=",".join(OBJECTS))
    parser.add_argument("--variants", default=";".join(VARIANTS), help="separated by semicolons")
    parser.add_argument("--jobs", type=int, default=2)
    given = parser.parse_args()
    shared("gso")
    os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    variants = given.variants.split(";")
    with ProcessPoolExecutor(given.jobs) as pool:
        found = list(pool.map(partial(of_object, variants=variants), given.objects.split(",")))
    rows = []
    for variant in variants:
        row: list[object] = [variant]
        for clean in (True, False):
            cd, cdp, f, normals, seconds = np.mean([part[variant, clean] for part in found], axis=0)
            row += [f"{cd:.5f}", f"{cdp:.5f}", f"{f:.3f}", f"{normals:.3f}"]
        rows.append([*row, f"{seconds:.1f}"])
    names = ["CD", "CDp", "F@.01", "normals"]
    table(["", *(f"clean {n}" for n in names), *(f"generated {n}" for n in names), "s"], rows)


if __name__ == "__main__":
    main()
