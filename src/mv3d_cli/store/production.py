"""Making artifacts: once per recipe, whole or not at all, whoever else is at it or is killed."""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mv3d_cli.errors import DamagedArtifact, MissingInput
from mv3d_cli.store.artifact import Artifact, open_artifact
from mv3d_cli.store.cache import (
    CACHE_HINT,
    cache_dir,
    discard,
    folder_of,
    hold,
    locked,
    maker_of,
    sweep,
    temporary_of,
    work_of,
)
from mv3d_cli.store.digest import MANIFEST
from mv3d_cli.store.disk import remove, space_watched, sync, sync_tree, writing_to
from mv3d_cli.store.manifest import describe, write_manifest
from mv3d_cli.store.recipe import Recipe

Build = Callable[[Path], object]
Notice = Callable[[str], object]


@dataclass(frozen=True)
class _Job:
    """One thing to make: what `produce` was asked for, and where it goes."""

    recipe: Recipe
    folder: Path
    main: str | None
    resumable: bool
    device: str | None


def produce(
    recipe: Recipe,
    build: Build,
    *,
    main: str | None = None,
    resumable: bool = False,
    device: str | None = None,
    on_hit: Callable[[Artifact], object] | None = None,
    on_notice: Notice = warnings.warn,
) -> Artifact:
    """The artifact of a recipe, from the cache when it is there whole, else made by `build(work)`.

    `build` fills the empty folder that it is given; `main` names the file in it that stands for the whole.
    With `resumable`, a build that fails or is killed leaves its folder, and the next build of the recipe is
    handed it again: all that lies in it at the end becomes the artifact. `on_notice` hears, in one line,
    of a damaged artifact that is made again and of waiting for another process; `on_hit`, of a result that
    was there.

    Raises what `build` raises, OutOfSpace, and OutputRefused when the cache cannot be written to.
    """
    job = _Job(recipe, folder_of(recipe.step, recipe.key), main, resumable, device)
    artifact = None
    with suppress(DamagedArtifact):
        artifact = _cached(job)
    if artifact is None:
        with locked(job.folder, lambda: on_notice(f"another process is making this ({recipe.step}); waiting for it")):
            artifact = _cached_or_cleared(job, on_notice)
            if artifact is None:
                return _make(job, build)
    if on_hit is not None:
        on_hit(artifact)
    return artifact


def _cached(job: _Job) -> Artifact | None:
    """What the cache has, compared byte for byte. Raises DamagedArtifact."""
    if not os.path.lexists(job.folder):
        return None
    if not hold(job.folder):
        raise DamagedArtifact(f"{job.folder} is being removed", "Run the command again.")
    try:
        artifact = open_artifact(job.folder)
    except MissingInput as error:
        raise DamagedArtifact(str(error), error.hint) from error
    if artifact.key != job.recipe.key:
        raise DamagedArtifact(f"{job.folder} holds another artifact", "Run the command again.")
    return artifact


def _cached_or_cleared(job: _Job, on_notice: Notice) -> Artifact | None:
    """What the cache has; when that is damaged it is removed, said, and None is returned."""
    try:
        return _cached(job)
    except DamagedArtifact as damage:
        on_notice(f"a cached result is damaged and is made again: {damage}")
        with writing_to(cache_dir(), CACHE_HINT):
            discard(job.folder)
        return None


def _make(job: _Job, build: Build) -> Artifact:
    """Build beside the key's folder and rename into place; the key's lock is held."""
    work = work_of(job.folder) if job.resumable else temporary_of(job.folder)
    with writing_to(cache_dir(), CACHE_HINT):
        sweep(job.folder)
        resumed = work.is_dir()
        work.mkdir(exist_ok=True)
        (work / MANIFEST).unlink(missing_ok=True)
    try:
        with space_watched(cache_dir()):
            started = time.monotonic()
            build(work)
            manifest = describe(work, job.recipe, _makers(job.recipe), job.main)
            manifest |= {
                "seconds": round(time.monotonic() - started, 3),
                "resumed": resumed,
                "device": job.device,
            }
            write_manifest(work, manifest)
            sync_tree(work)
        with writing_to(cache_dir(), CACHE_HINT):
            work.rename(job.folder)
            sync(job.folder.parent)
    except BaseException:
        if not job.resumable:
            with suppress(OSError):
                remove(work)
        raise
    hold(job.folder)
    return Artifact(job.folder, manifest)


def _makers(recipe: Recipe) -> dict[str, Any]:
    """What made the inputs, where we did."""
    makers: dict[str, Any] = {}
    for label, source in recipe.sources.items():
        with suppress(MissingInput, OSError, ValueError):
            makers[label] = maker_of(Path(source), recipe.inputs.get(label))
    return makers
