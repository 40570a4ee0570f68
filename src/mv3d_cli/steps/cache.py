"""Looking after the cache: what is in it, where a result came from, whether it is whole, and making room."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from mv3d_cli.errors import InputError, MissingInput, UsageError, WorkFailed
from mv3d_cli.store import cache_dir, damage_of, maker_of, open_artifact
from mv3d_cli.store.cache import cached_folders, evict, forget_products, sweep_dead, work_of
from mv3d_cli.store.digest import MANIFEST, files_in
from mv3d_cli.store.manifest import read_manifest

KEY_PREFIX = re.compile(r"[0-9a-f]{4,64}")
SECONDS = {"s": 1, "m": 60, "h": 3600, "d": 86400, "w": 604800}
BYTES = {"": 1, "K": 10**3, "M": 10**6, "G": 10**9, "T": 10**12}
LS_HINT = "`mv3d cache ls` shows the keys."


@dataclass(frozen=True)
class Entry:
    """A key in the cache. Bytes, seconds since 1970; `state` is whole, unfinished or damaged."""

    key: str
    step: str
    path: Path
    state: str
    size: int
    made: float
    used: float
    inputs: tuple[str, ...]


@dataclass(frozen=True)
class Origin:
    """One link of the chain that made an artifact: a step of ours, or, without `step`, something given.

    `depth` counts the steps between it and what was asked about; `label` says what it was to the step above.
    """

    depth: int
    label: str
    digest: str
    source: str | None
    step: str | None
    step_version: int | None
    key: str | None
    config: Mapping[str, Any]
    weights: str | None
    part: str | None
    edited: bool


@dataclass(frozen=True)
class Inspection:
    """What re-hashing one artifact found: nothing in `damage` when it is whole."""

    key: str
    step: str
    path: Path
    damage: tuple[str, ...]


@dataclass(frozen=True)
class Pruned:
    """What was removed, what had to stay because a process uses it, and the leftovers of dead processes."""

    removed: tuple[Entry, ...]
    in_use: tuple[Entry, ...]
    leftovers: int

    @property
    def freed(self) -> int:
        """Bytes of the removed entries."""
        return sum(entry.size for entry in self.removed)


def listed() -> Iterator[Entry]:
    """Every key in the cache, least recently used first."""
    found = [entry for folder in cached_folders() if (entry := _entry(folder)) is not None]
    return iter(sorted(found, key=lambda entry: (entry.used, entry.key)))


def _entry(folder: Path) -> Entry | None:
    """What is known of a key; None when it vanished while it was looked at."""
    work = work_of(folder)
    place = folder if folder.exists() else work
    manifest = read_manifest(folder)
    try:
        if manifest is not None:
            used = (folder / MANIFEST).stat().st_mtime
            size = sum(size for _, size in manifest["files"].values())
            inputs = tuple(_shown(item) for item in manifest["inputs"])
            made = _when(manifest.get("created"), used)
            return Entry(folder.name, manifest["step"], folder, "whole", size, made, used, inputs)
        paths = files_in(place) if place.is_dir() else {}
        states = [path.stat() for path in (*paths.values(), place)]
    except OSError:
        return None
    state = "damaged" if place == folder else "unfinished"
    size, used = sum(status.st_size for status in states[:-1]), max(status.st_mtime for status in states)
    return Entry(folder.name, folder.parent.parent.name, place, state, size, used, used, ())


def _shown(item: Mapping[str, Any]) -> str:
    """An input as people know it: the path they gave, or the start of its digest."""
    return f"{item['label']}={item.get('source') or item['digest'][:12]}"


def _when(created: object, otherwise: float) -> float:
    try:
        return datetime.fromisoformat(str(created)).timestamp()
    except ValueError:
        return otherwise


def why(reference: str) -> tuple[Origin, ...]:
    """The chain of steps, inputs and settings behind a path or a key (or its first digits), nearest first.

    Raises MissingInput when there is no such thing or we did not make it, UsageError when digits fit several.
    """
    path = Path(reference)
    maker = maker_of(path) if _exists(path) else None
    if maker is None:
        folders = _matching(reference)
        if not folders and _exists(path):
            raise MissingInput(
                f"{path} was not made by mv3d, or nothing says so any more",
                "Give a folder that has an artifact.json of ours, a file in it, or a key; " + LS_HINT,
            )
        maker = maker_of(open_artifact(_one(reference, folders), verify=False).path)
    return tuple(_links({"label": "", "source": reference, "digest": "", "made_by": maker}, 0))


def _links(item: Mapping[str, Any], depth: int) -> Iterator[Origin]:
    maker: Mapping[str, Any] = item.get("made_by") or {}
    yield Origin(
        depth=depth,
        label=item["label"],
        digest=item["digest"] or maker["digest"],
        source=item.get("source"),
        step=maker.get("step"),
        step_version=maker.get("step_version"),
        key=maker.get("key"),
        config=maker.get("config", {}),
        weights=maker.get("weights"),
        part=None if maker.get("part") == "." else maker.get("part"),
        edited=maker.get("edited", False),
    )
    for made_from in maker.get("inputs", ()):
        yield from _links(made_from, depth + 1)


def verified() -> Iterator[Inspection]:
    """Hash every artifact again and compare it with its manifest."""
    for folder in cached_folders():
        if not folder.exists():
            continue  # unfinished work has nothing to compare with
        step = folder.parent.parent.name
        try:
            artifact = open_artifact(folder, verify=False)
            damage = damage_of(artifact)
            if artifact.key != folder.name:
                damage = (f"it is the artifact of another key, {artifact.key}", *damage)
        except (WorkFailed, InputError) as error:
            damage = (str(error),)
        if folder.exists():
            yield Inspection(folder.name, step, folder, damage)


def pruned(older_than: timedelta | None = None, max_size: int | None = None) -> Pruned:
    """Remove what dead processes left; what was not used for `older_than`; then, least recently used first,
    as much as is needed to come down to `max_size` bytes. What a process is using stays.

    Unfinished resumable work counts as used when it was last written. Raises OutputRefused when the cache
    cannot be written to.
    """
    leftovers = sweep_dead() if cache_dir().is_dir() else 0
    entries = [*listed()]
    total, now = sum(entry.size for entry in entries), time.time()
    removed: list[Entry] = []
    in_use: list[Entry] = []
    for entry in entries:
        old = older_than is not None and now - entry.used > older_than.total_seconds()
        if not old and (max_size is None or total <= max_size):
            continue
        if evict(entry.path.with_name(entry.key)):
            removed.append(entry)
            total -= entry.size
        else:
            in_use.append(entry)
    if older_than is not None:
        forget_products(older_than.total_seconds())
    return Pruned(tuple(removed), tuple(in_use), leftovers)


def removed(references: tuple[str, ...]) -> tuple[Entry, ...]:
    """Remove the keys, or paths in the cache, from it. Nothing is removed unless all are known.

    Raises MissingInput for one that is not in the cache, UsageError for digits that fit several keys,
    WorkFailed for one that another process is using.
    """
    folders = [_one(reference, _matching(reference)) for reference in references]
    entries = [entry for folder in dict.fromkeys(folders) if (entry := _entry(folder)) is not None]
    for entry in entries:
        if not evict(entry.path.with_name(entry.key)):
            raise WorkFailed(f"{entry.key[:12]} is in use by another process", "Try again when that has ended.")
    return tuple(entries)


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except (OSError, ValueError):  # too long, a null character
        return False


def _matching(reference: str) -> list[Path]:
    """The keys' folders that a path in the cache lies in, or that the first digits of a key fit."""
    if _exists(Path(reference)):
        path = Path(reference).resolve()
        around = {path, *path.parents}
        inside = [
            folder for folder in cached_folders() if folder.resolve() in around or work_of(folder).resolve() in around
        ]
        if inside:
            return inside
    if not KEY_PREFIX.fullmatch(reference.lower()):
        return []
    return [folder for folder in cached_folders() if folder.name.startswith(reference.lower())]


def _one(reference: str, folders: list[Path]) -> Path:
    if len(folders) > 1:
        raise UsageError(f"{reference} fits {len(folders)} keys", f"Give more digits; {LS_HINT}")
    if not folders:
        raise MissingInput(
            f"{reference} is not in the cache",
            f"Give a path in `mv3d cache dir`, or at least 4 digits of a key; {LS_HINT}",
        )
    return folders[0]


def duration(text: str) -> timedelta:
    """A time span such as 30d, 12h, 90m or 2w. Raises UsageError."""
    match = re.fullmatch(r"(\d{1,9}(?:\.\d{1,9})?)([smhdw])", text.strip().lower())
    if not match:
        raise UsageError(f"{text!r} is not a time span", "Write a number and s, m, h, d or w, such as 30d.")
    try:
        return timedelta(seconds=float(match[1]) * SECONDS[match[2]])
    except OverflowError as error:
        raise UsageError(f"{text!r} is longer than can be counted", "Write a shorter one, such as 30d.") from error


def byte_count(text: str) -> int:
    """A size such as 10G, 500M or 1.5GB in bytes; powers of 1000. Raises UsageError."""
    match = re.fullmatch(r"(\d{1,15}(?:\.\d{1,9})?)([KMGT]?)B?", text.strip().upper())
    if not match:
        raise UsageError(f"{text!r} is not a size", "Write a number and K, M, G or T, such as 10G.")
    return int(float(match[1]) * BYTES[match[2]])
