"""Content digests: a file's is the sha256 of its bytes, a folder's the sha256 over its sorted (path, sha256).

Paths inside a folder are relative, with forward slashes. Links are followed: only content counts.
"""

from __future__ import annotations

import hashlib
import os
import stat
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path, PurePosixPath
from typing import TypeVar

from mv3d_cli.errors import MissingInput
from mv3d_cli.store.recipe import canonical_json

MANIFEST = "artifact.json"
MANY = 64  # files from which threads pay

T = TypeVar("T")
U = TypeVar("U")


def digest_of_path(path: Path) -> str:
    """The digest of a file or of a folder. Raises MissingInput when it cannot be read."""
    return digest_of_folder(path) if path.is_dir() else digest_of_file(path)


def digest_of_file(path: Path) -> str:
    """sha256 of the bytes of a file. Raises MissingInput when it cannot be read."""
    try:
        return sha256_of(path)
    except OSError as error:
        raise MissingInput(f"cannot read {path}: {error.strerror}", "Check the path and its permissions.") from error


def digest_of_folder(path: Path) -> str:
    """sha256 over the sorted (path, sha256) of all files but manifests. Raises MissingInput."""
    try:
        files = files_in(path)
        return digest_of_listing(dict(zip(files, in_threads(sha256_of, files.values()), strict=True)))
    except OSError as error:
        place = error.filename or path
        raise MissingInput(f"cannot read {place}: {error.strerror}", "Check the path and its permissions.") from error


def digest_of_listing(listing: Mapping[str, str]) -> str:
    """The digest of a folder by its files' sha256s. Manifests hold times, so they are not content."""
    content = [[path, sha256] for path, sha256 in sorted(listing.items()) if PurePosixPath(path).name != MANIFEST]
    return hashlib.sha256(canonical_json(content).encode("ascii")).hexdigest()


def files_in(folder: Path) -> dict[str, Path]:
    """Every file below a folder except its own manifest, by relative path, sorted. Raises OSError."""
    found: dict[str, Path] = {}
    _collect(folder, "", frozenset(), found)
    found.pop(MANIFEST, None)
    return dict(sorted(found.items()))


def _collect(folder: Path, prefix: str, above: frozenset[tuple[int, int]], found: dict[str, Path]) -> None:
    status = os.stat(folder)
    here = (status.st_dev, status.st_ino)
    if here in above:  # a link to a folder above itself
        return
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.is_dir():
                _collect(Path(entry.path), f"{prefix}{entry.name}/", above | {here}, found)
            else:
                found[prefix + entry.name] = Path(entry.path)


def sha256_of(path: Path) -> str:
    """sha256 of the bytes of a regular file. Raises OSError."""
    with open(path, "rb", buffering=0, opener=_open_regular) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _open_regular(path: str, flags: int) -> int:
    """Open without waiting for the other end of a pipe, and refuse what is not a file."""
    descriptor = os.open(path, flags | getattr(os, "O_NONBLOCK", 0))
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(None, "not a regular file", path)
    return descriptor


def in_threads(function: Callable[[T], U], items: Iterable[T]) -> list[U]:
    """`map` in order, on threads when there are many items: for work that waits for the disk or hashes."""
    items = list(items)
    if len(items) < MANY:
        return [function(item) for item in items]
    with ThreadPoolExecutor(min(8, os.cpu_count() or 1)) as pool:
        return list(pool.map(function, items))
