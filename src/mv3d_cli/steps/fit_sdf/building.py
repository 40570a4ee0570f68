"""How a fit is made: views checked and weighted, aligned, fused, refined, meshed, checked, written."""

from __future__ import annotations

import json
import os
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mv3d_cli.errors import MissingInput, UsageError, WorkFailed
from mv3d_cli.steps.fit_sdf import resolution_of, texture_of
from mv3d_cli.steps.fit_sdf.checking import self_check, turntable, warnings_of
from mv3d_cli.steps.sdf_fit import FIELD, VIEWS, Fit, MeshSettings, framed, fusion_of, mesh_of, residual_of, write_fit
from mv3d_cli.steps.settings import Progress, Tell, Warned
from mv3d_cli.steps.views_input import check_fittable, views_and_digest
from mv3d_cli.store import digest_of_folder

if TYPE_CHECKING:
    from mv3d_cli.scene.views import Views
    from mv3d_cli.steps.fit_sdf import Config

CHECKPOINT = "checkpoint.pt"
EVERY = 2.0  # seconds between checkpoints


def inputs_of(config: Config, folder: Path, tell: Tell) -> tuple[Views, dict[str, str]]:
    """The views to be fitted, and the digests of what they come from."""
    from mv3d_cli.scene.views import Views

    views, digest = views_and_digest(folder, tell)
    digests = {"views": digest}
    if config.from_ is not None:
        earlier = config.from_ if config.from_.is_dir() else config.from_.parent
        if not (earlier / FIELD).is_file():
            raise MissingInput(f"{config.from_} is not an earlier fit", "give the folder that `mv3d fit-sdf` printed")
        known, _ = views_and_digest(earlier / VIEWS, tell)
        names = {view.camera.name for view in views.frames}
        views = Views((*(view for view in known.frames if view.camera.name not in names), *views.frames))
        digests["from"] = digest_of_folder(earlier)
    views = _weighted(views, config.weight)
    check_fittable(views)
    return views, digests


def _weighted(views: Views, weights: tuple[str, ...]) -> Views:
    """The views with the weights the user gave; those of weight 0 are left out. Raises UsageError."""
    from mv3d_cli.scene.views import Views

    given = dict(_weight_of(text) for text in weights)
    names = [view.camera.name for view in views.frames]
    for name in given:
        if name not in names:
            raise UsageError(f"--weight names a view that is not there: {name}", f"there are: {', '.join(names)}")
    weighted = [replace(view, weight=view.weight * given.get(view.camera.name, 1.0)) for view in views.frames]
    kept = tuple(view for view in weighted if view.weight > 0)
    if not kept:
        raise UsageError("every view has weight 0", "leave at least two views with a weight")
    return Views(kept)


def _weight_of(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        weight = float(value)
        if not 0 <= weight < float("inf"):
            raise ValueError
    except ValueError:
        raise UsageError(f"--weight {text} is not NAME=NUMBER", "such as --weight front=3,back=0.5") from None
    return name.strip(), weight


def build(config: Config, views: Views, tell: Tell, work: Path) -> None:
    """Writes the fit of the views into a work folder; what an earlier, interrupted call left there is gone on from."""
    from mv3d_cli.formats.images import write_png
    from mv3d_cli.formats.meshes import write_mesh

    fit = fitted(config, views, tell, work)
    write_fit(work, fit)
    mesh = mesh_of(fit, MeshSettings(config.faces, texture_of(config)))
    write_mesh(work / "mesh.glb", mesh)
    report = self_check(fit, mesh)
    (work / "check.json").write_text(json.dumps(report, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    write_png(work / "sheet.png", turntable(mesh, fit))
    for text in warnings_of(report):
        tell(Warned(text))
    for leftover in work.glob("checkpoint.*"):
        leftover.unlink()


def fitted(config: Config, views: Views, tell: Tell, work: Path) -> Fit:
    """The fit in memory; checkpoints go to `work`."""
    from mv3d_cli.capture.framing import unit_sphere_from_views
    from mv3d_cli.fields.alignment import align
    from mv3d_cli.fields.relief import mask_of, reliefs_of

    frame = unit_sphere_from_views([view.camera for view in views.frames], [mask_of(view) for view in views.frames])
    alignment = align(reliefs_of(framed(views, frame)), [view.source == "photo" for view in views.frames])
    if any(view.depth is None for view in views.frames):  # they stay where their cameras say
        views = _with_depth(views, frame)
    fit = Fit(views, frame, alignment, resolution_of(config))
    if config.quick or not config.steps:
        return fit
    return refined(config, fit, tell, work)


def _with_depth(views: Views, frame: np.ndarray) -> Views:
    """The views, those without depth given what their colours tell of it."""
    from mv3d_cli.fields.stereo import with_depth_from_color
    from mv3d_cli.scene.views import Views

    seen = with_depth_from_color(framed(views, frame))
    scale = np.float32(np.cbrt(np.linalg.det(frame[:3, :3])))
    depths = [view.depth if view.depth is None else view.depth / scale for view in seen.frames]
    return Views(tuple(replace(view, depth=depth) for view, depth in zip(views.frames, depths, strict=True)))


def refined(config: Config, fit: Fit, tell: Tell, work: Path) -> Fit:
    """The fit with a trained residual; goes on from a checkpoint, and leaves them as it goes."""
    from mv3d_cli.fields import fitting, sdf

    aligned, fusion = fusion_of(fit)
    field = sdf.field_of(fusion, seed=config.seed).to(config.device)
    training = fitting.Fit(field, aligned, fitting.Config(steps=config.steps, seed=config.seed))
    spent = _resumed(training, work / CHECKPOINT)
    started = saved = time.monotonic()
    for done in training.run():
        tell(Progress(done.step, done.steps, "steps", _said(done.losses)))
        now = time.monotonic()
        if not all(np.isfinite(loss) for loss in done.losses.values()):
            raise WorkFailed(f"the fit diverged at step {done.step}", "try --steps 0, or another --seed")
        if config.max_time is not None and spent + now - started > config.max_time:
            break
        if now - saved > EVERY:
            _save(training, spent + now - started, work / CHECKPOINT)
            saved = now
    return replace(fit, residual=residual_of(field))


def _said(losses: dict[str, float]) -> str:
    """The losses in a few words."""
    return " ".join(f"{name} {loss:.4f}" for name, loss in losses.items())


def _save(training: Any, spent: float, path: Path) -> None:
    """Writes a checkpoint whole, or leaves the one before."""
    import torch

    new = path.with_suffix(".new")
    torch.save(training.state_dict() | {"spent": spent}, new)
    os.replace(new, path)


def _resumed(training: Any, path: Path) -> float:
    """Goes on from a checkpoint of ours, if there is one; the seconds that were spent before."""
    import torch

    if not path.is_file():
        return 0.0
    state = torch.load(path, weights_only=True)
    training.load_state_dict(state)
    return float(state["spent"])
