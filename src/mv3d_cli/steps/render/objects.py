"""The work of `mv3d render`, object by object: what there is to draw, drawing one, and the batch that resumes."""

from __future__ import annotations

import hashlib
import json
import shutil
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import warp

from mv3d_cli.capture.framing import placed, random_turn
from mv3d_cli.capture.lighting import light_for
from mv3d_cli.capture.rendering import render
from mv3d_cli.capture.shapes import procedural_mesh
from mv3d_cli.capture.sheet import sheet_of_objects, sheet_of_views
from mv3d_cli.errors import InputError, MissingDependency, MissingInput, Mv3dError, UsageError, WorkFailed
from mv3d_cli.formats.cameras import load_cameras, select
from mv3d_cli.formats.images import read_image, write_png
from mv3d_cli.formats.meshes import MeshFile, find_meshes, mesh_sources, read_mesh
from mv3d_cli.formats.views_folder import write_views
from mv3d_cli.kernels.runtime import cpu_count, in_threads, use_threads
from mv3d_cli.mapping import Outcome, map_items, map_on_ray
from mv3d_cli.scene.camera import Camera
from mv3d_cli.scene.views import Views
from mv3d_cli.steps.settings import Progress, Tell, Warned
from mv3d_cli.store import digest_of_file, ran_out_of_space

if TYPE_CHECKING:
    from mv3d_cli.steps.render import Config

SHEET_OBJECTS = 64
OUR_FILES = ("index.json", "failures.json", "sheet.png", "artifact.json")  # in a data-set folder, beside the objects


@dataclass(frozen=True)
class Object:
    """One thing to draw: a mesh file, or a procedural seed."""

    name: str
    digest: str
    file: MeshFile | None = None
    seed: int = 0

    @property
    def label(self) -> str:
        return f"mesh {self.name}"

    @property
    def source(self) -> Path | None:
        return self.file.path if self.file is not None else None


def rig_of(config: Config) -> tuple[Camera, ...]:
    """The cameras that the settings ask for."""
    rig = load_cameras(config.cameras)
    return select(rig, config.views) if config.views else rig


def check_device(config: Config) -> None:
    """Raises UsageError for a device that is not here."""
    if config.device == "cuda" and not warp.is_cuda_available():
        raise UsageError("--device cuda: there is no CUDA device here", "leave it out to render on the processor")


def work_of(config: Config, inputs: Sequence[Path]) -> list[Object]:
    """Every object to draw, names unique, in order. Raises UsageError, MissingInput."""
    if not inputs and not config.procedural:
        raise UsageError("there is nothing to render", "give a mesh, a folder of meshes, or --procedural N")
    files = [file for path in inputs for file in find_meshes(path)]
    seeds = [config.seed * 1_000_003 + i for i in range(config.procedural)]
    names = _unique([*(file.name for file in files), *(f"procedural_{i:06d}" for i in range(config.procedural))])
    found = [Object(name, _digest(file), file) for name, file in zip(names, files, strict=False)]
    return found + [
        Object(name, f"procedural:{seed}", seed=seed) for name, seed in zip(names[len(files) :], seeds, strict=True)
    ]


def is_batch(config: Config, inputs: Sequence[Path], work: Sequence[Object]) -> bool:
    """Whether a data set is wanted, if only of one object. A scanned object's folder counts as one mesh."""
    found = {item.source for item in work}
    folders = [path for path in inputs if path.is_dir() and path / "meshes" / "model.obj" not in found]
    several = len(inputs) > 1 or len(work) > 1 or config.rotations > 0 or config.procedural > 0
    return several or bool(folders)


def _unique(names: Iterable[str]) -> list[str]:
    """The names, those met before numbered, also where a file system takes small and capital letters for the same."""
    taken: set[str] = {*OUR_FILES}
    result = []
    for name in names:
        candidate, n = name, 1
        while candidate.casefold() in taken:
            n += 1
            candidate = f"{name}_{n}"
        taken.add(candidate.casefold())
        result.append(candidate)
    return result


def _digest(file: MeshFile) -> str:
    """sha256 over all files that a mesh is read from; one that cannot be read is told of when it is drawn."""
    try:
        sources = mesh_sources(file)
    except InputError:
        sources = [file.path]
    total = hashlib.sha256()
    for path in sources:
        total.update(path.name.encode() + b"\0")
        total.update(digest_of_file(path).encode() if path.is_file() else b"missing")
    return total.hexdigest()


def render_one(config: Config, rig: Sequence[Camera], item: Object, folder: Path, tell: Tell) -> None:
    """One object's views folder, with its contact sheet."""
    for note in _draw(config, rig, item, None, folder, sheet=True):
        tell(Warned(note))


def render_all(config: Config, rig: Sequence[Camera], work: Sequence[Object], folder: Path, tell: Tell) -> None:
    """A data-set folder: goes on from what lies in `folder`, and does not stop for an object that fails.

    Raises MissingInput or WorkFailed where not one could be drawn, and what concerns all at once.
    """
    turns = list(range(config.rotations)) if config.rotations else [None]
    places = {_place(item, turn): (item, turn) for item in work for turn in turns}
    waiting = [place for place in places if not (folder / place).is_dir()]
    _sweep(folder)
    todo = [(place, *places[place]) for place in waiting]
    failed: list[Outcome] = []
    done = len(places) - len(waiting)
    draw = partial(_draw_into, config, tuple(rig), folder)
    for outcome in _outcomes(config, draw, todo):
        done += 1
        if outcome.error is not None:
            if _concerns_all(outcome.error):
                raise outcome.error
            failed.append(outcome)
        tell(Progress(done, len(places), "objects"))
    _sweep(folder)
    failed.sort(key=lambda outcome: outcome.item[0])
    _check_drawn(failed, len(places))
    _finish(folder, places, [_failure(outcome) for outcome in failed], tell)


def _outcomes(config: Config, draw: Callable[[Any], None], todo: Sequence[Any]) -> Iterator[Outcome]:
    """What became of each object, drawn by the workers that the settings ask for."""
    one_thread = partial(use_threads, 1)
    if config.workers == "ray":
        return map_on_ray(draw, todo, one_thread)
    return map_items(draw, todo, max(min(config.jobs or cpu_count(), len(todo)), 1), one_thread)


def _sweep(folder: Path) -> None:
    """Removes what workers that were killed left half drawn."""
    for leftover in folder.glob(".partial-*"):
        shutil.rmtree(leftover)


def _concerns_all(error: Exception) -> bool:
    """Whether an object failed for a reason that is not its own: a full disk, a package that is missing."""
    return isinstance(error, MissingDependency) or ran_out_of_space(error)


def _place(item: Object, turn: int | None) -> str:
    return item.name if turn is None else f"{item.name}_r{turn:03d}"


def _draw_into(config: Config, rig: tuple[Camera, ...], folder: Path, todo: tuple[str, Object, int | None]) -> None:
    """One object of a batch, written beside its place and renamed into it; nothing to do where it is done."""
    place, item, turn = todo
    if (folder / place).is_dir():
        return
    partial_folder = folder / f".partial-{place}"
    try:
        _draw(config, rig, item, turn, partial_folder)
        partial_folder.rename(folder / place)
    except BaseException:
        shutil.rmtree(partial_folder, ignore_errors=True)
        raise


def _draw(
    config: Config, rig: Sequence[Camera], item: Object, turn: int | None, folder: Path, sheet: bool = False
) -> list[str]:
    """Draws one object into a views folder, with a contact sheet if wanted; returns the warnings."""
    rng = np.random.default_rng([config.seed, int(hashlib.sha256(item.name.encode()).hexdigest()[:8], 16), turn or 0])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        mesh = procedural_mesh(item.seed) if item.file is None else read_mesh(item.file, config.up)
    notes = [f"{item.name}: {warning.message}" for warning in caught]
    turned = np.eye(4) if turn is None else random_turn(rng, config.tilt)
    mesh, world_from_mesh = placed(mesh, turned)
    light = light_for(config.lighting, rng)
    views = _engine(config)(mesh, rig, config.size, light)
    folder.mkdir(parents=True, exist_ok=True)
    writers: list[Callable[[], None]] = [partial(write_views, folder, views)]
    if sheet:
        writers.append(lambda: write_png(folder / "sheet.png", sheet_of_views(views)))
    in_threads(writers)
    record = {
        "name": item.name,
        "source": item.source.name if item.source is not None else item.digest,
        "faces": len(mesh.faces),
        "world_from_mesh": world_from_mesh.tolist(),
        "scale": float(np.cbrt(np.linalg.det(world_from_mesh[:3, :3]))),
        "turn": turn,
        "warnings": notes,
    }
    (folder / "object.json").write_text(json.dumps(record, indent=1) + "\n")
    return notes


def _engine(config: Config) -> Callable[..., Views]:
    if config.engine == "blender":
        from mv3d_cli.capture.blender import render as render_with_blender

        return partial(render_with_blender, samples=config.samples)
    return partial(render, device="cuda:0" if config.device == "cuda" else config.device)


def _failure(outcome: Outcome) -> dict[str, Any]:
    """The entry of failures.json for an object that did not work."""
    place, item, _ = outcome.item
    error = outcome.error
    reason = str(error) if isinstance(error, Mv3dError) else f"{type(error).__name__}: {error}"
    hint = error.hint if isinstance(error, Mv3dError) else "this is a fault of mv3d; please report it with the mesh"
    source = str(item.source) if item.source is not None else item.digest
    return {"name": place, "source": source, "reason": reason, "hint": hint}


def _check_drawn(outcomes: Sequence[Outcome], count: int) -> None:
    """Raises MissingInput or WorkFailed where not one of `count` objects could be drawn."""
    if len(outcomes) < count:
        return
    reasons = [_failure(outcome) for outcome in outcomes]
    kind = MissingInput if all(isinstance(outcome.error, InputError) for outcome in outcomes) else WorkFailed
    first = f"{reasons[0]['name']}: {reasons[0]['reason']}"
    raise kind(f"none of {count} objects could be rendered; {first}", reasons[0]["hint"])


def _finish(folder: Path, places: dict[str, Any], failures: list[dict[str, Any]], tell: Tell) -> None:
    """Index, failures and contact sheet of a batch."""
    drawn = [place for place in places if (folder / place).is_dir()]
    if failures:
        tell(Warned(f"{len(failures)} of {len(places)} objects failed; failures.json says why"))
    records = [json.loads((folder / place / "object.json").read_text()) | {"folder": place} for place in drawn]
    (folder / "index.json").write_text(json.dumps({"objects": records}, indent=1) + "\n")
    (folder / "failures.json").write_text(json.dumps(failures, indent=1) + "\n")
    chosen = drawn[:: max(1, -(-len(drawn) // SHEET_OBJECTS))]
    first_view = [sorted((folder / place / "color").iterdir()) for place in chosen]
    names = [next((p for p in pictures if p.stem == "front"), pictures[0]) for pictures in first_view]
    write_png(folder / "sheet.png", sheet_of_objects([read_image(path) for path in names]))
