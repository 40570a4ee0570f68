"""`mv3d depth2normal`: normals from depth.

A views folder becomes one whose normals come from its depth; a depth map (EXR) becomes a normal map (`normal.png`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from mv3d_cli.errors import BadImage, BadViews, UsageError
from mv3d_cli.steps.settings import Between, Doc, Tell, check, key_config, silent
from mv3d_cli.store import Artifact, Recipe, digest_of_file, produce

if TYPE_CHECKING:
    import numpy as np

    from mv3d_cli.scene.views import View, Views

VERSION = 1  # bumped when the same settings and inputs give other bytes
NORMAL = "normal.png"


@dataclass(frozen=True)
class Config:
    """Settings of `mv3d depth2normal`."""

    sigma: Annotated[float, Doc("Window of the fit in pixels; larger for noisy depth, 0 for none."), Between(0, 16)] = (
        1.0
    )
    edge: Annotated[
        float, Doc("Depth step, in pixels' widths, across which nothing is averaged."), Between(0.01, 1000)
    ] = 2.0
    paper: Annotated[bool, Doc("A common 8-bit recipe instead (Gaussian, numpy.gradient, dz = 2), to compare.")] = False
    half_extent: Annotated[float, Doc("Of a depth map alone: half of what its width spans."), Between(1e-6, 1e6)] = 1.0
    focal: Annotated[
        float | None, Doc("Of a depth map alone: focal length in pixels; it is a pinhole's."), Between(1e-3, 1e6)
    ] = None


def main_file(inputs: Sequence[Path]) -> str | None:
    """The file that stands for the whole result, if it is one file."""
    return NORMAL if len(inputs) == 1 and inputs[0].suffix.lower() == ".exr" else None


def run(config: Config, inputs: Sequence[Path], tell: Tell = silent) -> Artifact:
    """The normals of a views folder or of one depth map. Raises UsageError, MissingInput, BadViews, BadImage."""
    check(config)
    if len(inputs) != 1:
        raise UsageError(f"one views folder or depth map is wanted, not {len(inputs)}", "run the command once for each")
    from mv3d_cli.formats.images import read_depth
    from mv3d_cli.steps.views_input import views_and_digest

    path, main = inputs[0], main_file(inputs)
    if main is not None:
        view = _alone(config, read_depth(path))
        build, digest = partial(_write_map, config, view), digest_of_file(path)
    else:
        views, digest = views_and_digest(path, tell)
        if not any(view.depth is not None for view in views.frames):
            raise BadViews(f"{path} has no depth", "normals come from depth; give views that have depth/NAME.exr")
        build = partial(_write_views, config, views)
    recipe = Recipe("depth2normal", VERSION, key_config(config), {"depth": digest}, sources={"depth": str(path)})
    return produce(recipe, build, main=main)


def _alone(config: Config, depth: np.ndarray) -> View:
    """A view of a depth map that comes without a camera. Raises BadImage for one without a surface."""
    import numpy as np

    from mv3d_cli.scene.camera import Camera, Orthographic, Perspective
    from mv3d_cli.scene.views import View

    if not (np.isfinite(depth) & (depth > 0)).any():
        raise BadImage("the depth map shows no surface", "depth is planar z above 0 in scene units; 0 is nothing")
    height, width = depth.shape
    focal = config.focal
    pinhole = Perspective((focal / width, focal / height)) if focal else Orthographic(config.half_extent)
    return View(Camera("depth", np.eye(4), pinhole), depth=depth)


def _with_normals(config: Config, view: View) -> View:
    """The view with the normals of its depth; as it is without depth."""
    from dataclasses import replace

    from mv3d_cli.capture.normals import normals_from_depth, paper_normals
    from mv3d_cli.scene.conventions import bytes_from_normal

    if view.depth is None:
        return view
    if config.paper:
        return replace(view, normal=paper_normals(view.depth))
    normals = normals_from_depth(view.depth, view.camera, sigma=config.sigma, edge=config.edge)
    return replace(view, normal=bytes_from_normal(normals))


def _write_map(config: Config, view: View, folder: Path) -> None:
    from mv3d_cli.formats.images import write_png

    normal = _with_normals(config, view).normal
    assert normal is not None
    write_png(folder / NORMAL, normal)


def _write_views(config: Config, views: Views, folder: Path) -> None:
    from mv3d_cli.capture.sheet import sheet_of_views
    from mv3d_cli.formats.images import write_png
    from mv3d_cli.formats.views_folder import write_views
    from mv3d_cli.kernels.runtime import in_threads
    from mv3d_cli.scene.views import Views

    made = Views(tuple(in_threads([partial(_with_normals, config, view) for view in views.frames])))
    write_views(folder, made)
    write_png(folder / "sheet.png", sheet_of_views(made))
