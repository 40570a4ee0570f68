"""Where finished artifacts are kept: `cache_dir() / v1 / step / ke / key…`.

Beside a key's folder lie `KEY.lock`; `KEY.work`, resumable work that is not finished; and `KEY.*.tmp`, what
is being written or removed. `v1 / .products` remembers the files that were delivered, by sha256.
"""

from __future__ import annotations

import json
import os
import re
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import filelock
import platformdirs

from mv3d_cli.store.artifact import find_artifact, part_digest, part_of
from mv3d_cli.store.digest import MANIFEST, digest_of_path
from mv3d_cli.store.disk import lock_now, remove, token, writing_to
from mv3d_cli.store.manifest import record_of

LAYOUT = "v1"
KEY = re.compile(r"[0-9a-f]{64}")
MOST_HELD = 64
CACHE_HINT = "Set MV3D_CACHE_DIR to a folder that you can write to."

_held: OrderedDict[Path, int] = OrderedDict()  # descriptors; a process has a limited number


def cache_dir() -> Path:
    """The root of the cache: `$MV3D_CACHE_DIR`, or the platform's place for caches."""
    chosen = os.environ.get("MV3D_CACHE_DIR") or platformdirs.user_cache_dir("mv3d", appauthor=False)
    return Path(chosen).expanduser().absolute()


def folder_of(step: str, key: str) -> Path:
    """Where the artifact of a key lies, or would."""
    return cache_dir() / LAYOUT / step / key[:2] / key


def work_of(folder: Path) -> Path:
    """Where the resumable work of a key lies until it is finished."""
    return folder.with_name(f"{folder.name}.work")


def temporary_of(folder: Path) -> Path:
    """A new name beside a key's folder for what is being written or removed."""
    return folder.with_name(f"{folder.name}.{token()}.tmp")


def cached_folders() -> Iterator[Path]:
    """The folders of all keys that have an artifact or unfinished work; they may vanish at any time."""
    folders = {path.with_suffix("") for path in _beside("")} | {path.with_suffix("") for path in _beside(".work")}
    return iter(sorted(folders))


def _beside(suffix: str) -> Iterator[Path]:
    """What lies in the cache under the name of a key and this suffix."""
    for path in cache_dir().glob(f"{LAYOUT}/[a-z0-9]*/[0-9a-f][0-9a-f]/*{suffix}"):
        if KEY.fullmatch(path.name.removesuffix(suffix)):
            yield path


@contextmanager
def locked(folder: Path, on_wait: Callable[[], object] | None = None) -> Iterator[bool]:
    """Hold the one lock of a key; without `on_wait`, only if no other process does. Gives whether it is held.

    Raises OutputRefused or OutOfSpace when the cache cannot be written to.
    """
    lock = filelock.FileLock(folder.with_name(f"{folder.name}.lock"))
    with writing_to(cache_dir(), CACHE_HINT):
        folder.parent.mkdir(parents=True, exist_ok=True)
        with suppress(filelock.Timeout):
            lock.acquire(blocking=False)
        if on_wait is not None and not lock.is_locked:
            on_wait()
            lock.acquire(poll_interval=0.05)
    try:
        yield lock.is_locked
    finally:
        lock.release()


def hold(folder: Path) -> bool:
    """Mark an artifact as used now, and keep other processes from removing it while this one lives.

    False when one is removing it at this moment.
    """
    with suppress(OSError):
        os.utime(folder / MANIFEST)
    if folder in _held:
        _held.move_to_end(folder)
        return True
    try:
        descriptor = lock_now(folder / MANIFEST, shared=True)
    except OSError:  # no manifest, or a file system without locks
        return True
    if descriptor is None:
        return False
    _held[folder] = descriptor
    while len(_held) > MOST_HELD:
        os.close(_held.popitem(last=False)[1])
    return True


def let_go(folder: Path) -> None:
    """Undo `hold`."""
    descriptor = _held.pop(folder, None)
    if descriptor is not None:
        os.close(descriptor)


def discard(folder: Path) -> None:
    """Remove what lies under a key, whole or not at all; its lock is held by the caller. Raises OSError."""
    let_go(folder)
    if not os.path.lexists(folder):
        return
    doomed = folder.rename(temporary_of(folder))
    remove(doomed)


def sweep(folder: Path) -> None:
    """Remove what dead processes left beside a key; its lock is held by the caller. Raises OSError."""
    for leftover in folder.parent.glob(f"{folder.name}.*.tmp"):
        remove(leftover)


def evict(folder: Path) -> bool:
    """Remove a key's artifact, unfinished work and leftovers; False, and all stays, when a process uses them.

    Raises OutputRefused when the cache cannot be written to.
    """
    let_go(folder)
    with locked(folder) as ours, writing_to(cache_dir(), CACHE_HINT):
        if not ours:
            return False
        descriptor = lock_now(folder / MANIFEST) if (folder / MANIFEST).is_file() else -1
        if descriptor is None:
            return False
        try:
            discard(folder)
            discard(work_of(folder))
            sweep(folder)
            folder.with_name(f"{folder.name}.lock").unlink(missing_ok=True)
        finally:
            if descriptor >= 0:
                os.close(descriptor)
    return True


def sweep_dead() -> int:
    """Remove what dead processes left in the cache, and locks that guard nothing. Counts the former."""
    beside = cache_dir().glob(f"{LAYOUT}/[a-z0-9]*/[0-9a-f][0-9a-f]/*.*")
    folders = {path.with_name(path.name.split(".")[0]) for path in beside}
    removed = 0
    for folder in sorted(folder for folder in folders if KEY.fullmatch(folder.name)):
        with locked(folder) as ours, writing_to(cache_dir(), CACHE_HINT):
            if not ours:
                continue
            removed += len([*folder.parent.glob(f"{folder.name}.*.tmp")])
            sweep(folder)
            if not folder.exists() and not work_of(folder).exists():
                folder.with_name(f"{folder.name}.lock").unlink(missing_ok=True)
    return removed


def remember_product(sha256: str, record: Mapping[str, Any]) -> None:
    """Note, before a file is delivered, that its content is ours and not the user's."""
    note = _note_of(sha256)
    temporary = note.with_name(f"{note.name}.{token()}.tmp")
    with suppress(OSError):  # a cache that cannot be written to: the file will be taken for the user's
        note.parent.mkdir(parents=True, exist_ok=True)
        try:
            temporary.write_text(json.dumps(record), encoding="ascii")
            temporary.replace(note)
        finally:
            temporary.unlink(missing_ok=True)


def recall_product(sha256: str) -> dict[str, Any] | None:
    """The record of what made a delivered file of this content, or None when it is not ours."""
    try:
        record = json.loads(_note_of(sha256).read_text(encoding="ascii"))
    except (OSError, ValueError, RecursionError):
        return None
    return record if isinstance(record, dict) and "step" in record else None


def forget_products(seconds: float) -> None:
    """Forget delivered files that were noted longer ago than this."""
    for note in (cache_dir() / LAYOUT / ".products").glob("*/*"):
        with suppress(OSError):
            if time.time() - note.stat().st_mtime > seconds:
                note.unlink()


def _note_of(sha256: str) -> Path:
    return cache_dir() / LAYOUT / ".products" / sha256[:2] / sha256


def maker_of(path: Path, digest: str | None = None) -> dict[str, Any] | None:
    """What made the artifact that a path is, is a part of, or was delivered from; None if we did not.

    A record (see `manifest`) with `part`, where in that artifact, and `edited`, whether it changed since.
    `digest` is the path's own, if it is known already. Raises MissingInput when the path cannot be read.
    """
    artifact = find_artifact(path)
    if artifact is not None:
        edited = part_digest(artifact, path) != (digest or digest_of_path(path))
        return {**record_of(artifact.manifest), "part": part_of(artifact, path), "edited": edited}
    if not path.is_file():
        return None
    return recall_product(digest or digest_of_path(path))
