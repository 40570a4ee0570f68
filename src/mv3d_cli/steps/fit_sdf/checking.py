"""What a fit can say of itself without the truth: how well it agrees with the views it was made of."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from mv3d_cli.scene.mesh import Mesh
    from mv3d_cli.scene.views import View
    from mv3d_cli.steps.sdf_fit import Fit

CONTRADICTION = 0.02  # scene units left between views after alignment: they show different objects
POOR_OUTLINE = 0.8  # intersection over union with a view's silhouette


def self_check(fit: Fit, mesh: Mesh) -> dict[str, Any]:
    """Per view: mask IoU and PSNR (decibels, on white) of the mesh drawn from its camera. Of all: what is left of
    the views' disagreement (scene units), whether the mesh is watertight, its components and faces."""
    from mv3d_cli.meshes.repair import components, watertight

    per_view = {
        view.camera.name: _agreement(view, drawn)
        for view, drawn in zip(fit.views.frames, _drawn(fit, mesh), strict=True)
    }
    return {
        "views": per_view,
        "mask_iou": _mean([v["mask_iou"] for v in per_view.values()]),
        "psnr": _mean([v["psnr"] for v in per_view.values()]),
        "disagreement_before": _number(fit.alignment.before),
        "disagreement_after": _number(fit.alignment.after),
        "watertight": watertight(mesh),
        "components": components(mesh),
        "faces": len(mesh.faces),
    }


def warnings_of(report: dict[str, Any]) -> list[str]:
    """What the user should know of a fit, one line each."""
    found = []
    left = report["disagreement_after"]
    if left is not None and left > CONTRADICTION:
        found.append(f"the views contradict each other: {left:.3f} scene units are left between them after alignment")
    poor = [name for name, view in report["views"].items() if (view["mask_iou"] or 1) < POOR_OUTLINE]
    if poor:
        found.append(f"the mesh does not fill the silhouette of {', '.join(poor)}; other views contradict it")
    if not report["watertight"]:
        found.append("the mesh is not watertight")
    return found


def turntable(mesh: Mesh, fit: Fit) -> np.ndarray:
    """A sheet of the mesh from eight sides and two heights, its colours and its shape."""
    from mv3d_cli.capture.rendering import render
    from mv3d_cli.capture.sheet import sheet_of_views
    from mv3d_cli.scene.camera import Orthographic, direction_on_sphere, look_at_origin
    from mv3d_cli.scene.mesh import transform

    turns = [(f"{round(np.rad2deg(a))}", direction_on_sphere(a, e)) for a, e in _round_trip()]
    cameras = [look_at_origin(name, place, Orthographic()) for name, place in turns]
    return sheet_of_views(render(transform(mesh, fit.fit_from_world), cameras, 192, None))


def _round_trip() -> list[tuple[float, float]]:
    """Azimuth and elevation, radians: once around, from eye height and from above by turns."""
    return [(np.deg2rad(45.0 * i), np.deg2rad(15.0 if i % 2 else 35.0)) for i in range(8)]


def _drawn(fit: Fit, mesh: Mesh) -> list[np.ndarray]:
    """The mesh as each view's camera sees it, RGBA."""
    from mv3d_cli.kernels.shade import draw, lights, model

    looks = model(mesh, "cpu")
    dark = lights(None, looks, None)
    return [draw(looks, dark, view.camera, view.shape[1], view.shape[0]).color for view in fit.views.frames]


def _agreement(view: View, drawn: np.ndarray) -> dict[str, float | None]:
    from mv3d_cli.fields.relief import mask_of
    from mv3d_cli.metrics.image import psnr
    from mv3d_cli.metrics.overlap import iou

    mask = mask_of(view)
    overlap = None if mask is None else round(iou(drawn[..., 3] > 127, mask), 4)
    likeness = None if view.color is None or mask is None else _number(psnr(drawn, view.color))
    return {"mask_iou": overlap, "psnr": likeness}


def _number(value: float) -> float | None:
    """A number as JSON has it."""
    return round(float(value), 5) if np.isfinite(value) else None


def _mean(values: list[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return round(float(np.mean(known)), 4) if known else None
