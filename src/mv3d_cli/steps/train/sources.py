"""What there is to learn from: mesh files, objects of our own, and views that were rendered before."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mv3d_cli.capture.examples import Drawing, Example, example_from_mesh, example_from_views
from mv3d_cli.capture.shapes import procedural_mesh
from mv3d_cli.errors import BadViews, UsageError
from mv3d_cli.formats.cameras import load_cameras, select
from mv3d_cli.formats.meshes import MeshFile, read_mesh
from mv3d_cli.formats.views_folder import TRANSFORMS, read_views
from mv3d_cli.scene.views import View, Views
from mv3d_cli.steps import render
from mv3d_cli.steps.render.objects import work_of
from mv3d_cli.store import digest_of_folder

if TYPE_CHECKING:
    from mv3d_cli.steps.train import Config


@dataclass(frozen=True)
class Source:
    """One object: a mesh file, a views folder, or a procedural seed."""

    name: str
    digest: str
    mesh: MeshFile | None = None
    views: Path | None = None
    seed: int = 0


def sources_of(config: Config, inputs: Sequence[Path]) -> list[Source]:
    """Every object of the inputs, in order. Raises UsageError, MissingInput, BadCameras."""
    if not inputs and not config.procedural:
        raise UsageError(
            "there is nothing to learn from", "give meshes, a rendered data set, or --procedural N for objects of ours"
        )
    if not config.views:
        raise UsageError("--views names no view", "such as front,back,right,left")
    found: list[Source] = []
    meshes = []
    for path in inputs:
        folders = _views_folders(path)
        found += [Source(folder.name, digest_of_folder(folder), views=folder) for folder in folders]
        meshes += [] if folders else [path]
    if meshes or config.procedural:
        drawn = work_of(render.Config(procedural=config.procedural, seed=config.seed, up=config.up), meshes)
        found += [Source(item.name, item.digest, mesh=item.file, seed=item.seed) for item in drawn]
        select(load_cameras(None), config.views)
    return found


def digest_of_sources(sources: Sequence[Source]) -> str:
    """One digest over all objects, in their order, which the order of learning depends on."""
    return hashlib.sha256(json.dumps([[s.name, s.digest] for s in sources]).encode()).hexdigest()


def split(sources: Sequence[Source], held_out: int) -> tuple[list[Source], list[Source]]:
    """(for training, for validation): some are held out, by their names, unless there are too few to spare any."""
    ordered = sorted(sources, key=lambda source: hashlib.sha256(source.name.encode()).hexdigest())
    spared = {source.name for source in ordered[:held_out]}
    if len(sources) < 8 * held_out:
        return list(sources), [source for source in sources if source.name in spared]
    return [s for s in sources if s.name not in spared], [s for s in sources if s.name in spared]


def example_of(source: Source, config: Config, drawing: Drawing, rng: np.random.Generator) -> Example:
    """One example of an object. Raises InputError for an object that cannot be used."""
    if source.views is not None:
        return example_from_views(_chosen(read_views(source.views), config.views, drawing.size), drawing, rng)
    mesh = procedural_mesh(source.seed) if source.mesh is None else read_mesh(source.mesh, config.up)
    return example_from_mesh(mesh, select(load_cameras(None), config.views), drawing, rng)


def _chosen(views: Views, names: Sequence[str], size: int) -> Views:
    """The views of those names. Raises BadViews for one that is missing or incomplete, or of another size."""
    by_name = {view.camera.name: view for view in views.frames}

    def checked(name: str) -> View:
        view = by_name.get(name)
        if view is None or view.color is None or view.depth is None:
            raise BadViews(f"there is no view {name} with colour and depth", "render the data set again")
        if view.shape != (size, size):
            raise BadViews(
                f"view {name} has {view.shape[1]} x {view.shape[0]} pixels, the model {size} x {size}",
                f"render the data set with --size {size}",
            )
        return view

    return Views(tuple(checked(name) for name in names))


def _views_folders(path: Path) -> list[Path]:
    """The views folders that a path is or holds; none where it holds meshes."""
    if (path / TRANSFORMS).is_file():
        return [path]
    return sorted(place.parent for place in path.glob(f"*/{TRANSFORMS}")) if path.is_dir() else []
