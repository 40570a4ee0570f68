"""Artifacts: folders whose artifact.json says what every byte is, in the cache or as a user's copy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mv3d_cli.errors import DamagedArtifact, MissingInput
from mv3d_cli.store.digest import (
    MANIFEST,
    digest_of_listing,
    files_in,
    in_threads,
    sha256_of,
)
from mv3d_cli.store.manifest import read_manifest


@dataclass(frozen=True)
class Artifact:
    """A folder and its manifest. Holding one says nothing about the bytes: see `is_intact`."""

    path: Path
    manifest: Mapping[str, Any]

    @property
    def key(self) -> str:
        """The key of the recipe that made it."""
        return self.manifest["key"]

    @property
    def digest(self) -> str:
        """The digest of its content, which the keys of later steps depend on."""
        return self.manifest["digest"]

    @property
    def step(self) -> str:
        """The step that made it."""
        return self.manifest["step"]

    @property
    def main(self) -> Path | None:
        """The file that stands for the whole, such as a mesh; None when the folder itself is the result."""
        return None if self.manifest["main"] is None else self.path / self.manifest["main"]

    @property
    def size(self) -> int:
        """Bytes of its files."""
        return sum(size for _, size in self.manifest["files"].values())


def open_artifact(path: Path, verify: bool = True) -> Artifact:
    """The artifact that a folder is; with `verify`, every byte is compared with the manifest.

    Raises MissingInput when there is no such folder, DamagedArtifact when the manifest cannot be read or,
    with `verify`, when files differ from it: a copy that was edited is a new input, not that artifact.
    """
    if not path.is_dir():
        raise MissingInput(f"{path} is not a folder", "Give the folder of an artifact.")
    manifest = read_manifest(path)
    if manifest is None:
        raise DamagedArtifact(f"{path / MANIFEST} is missing or damaged", "Run the command that made it again.")
    artifact = Artifact(path, manifest)
    if verify and (damage := damage_of(artifact)):
        raise DamagedArtifact(
            f"{path} is not what it was when it was made: {damage[0]}",
            "Run the command that made it again, or, if you edited it on purpose, remove its artifact.json.",
        )
    return artifact


def find_artifact(path: Path) -> Artifact | None:
    """The artifact that a path is, or is a listed part of, or None. Bytes are not compared."""
    try:
        path = path.resolve()
        folders = [path, *path.parents] if path.is_dir() else [*path.parents]
    except (OSError, RuntimeError, ValueError):  # too long, a loop of links, a null character
        return None
    for folder in folders:
        manifest = read_manifest(folder)
        if manifest is not None:
            artifact = Artifact(folder, manifest)
            return artifact if path == folder or part_digest(artifact, path) else None
    return None


def part_of(artifact: Artifact, path: Path) -> str:
    """Where a path lies inside an artifact; "." for the whole."""
    return path.resolve().relative_to(artifact.path.resolve()).as_posix()


def part_digest(artifact: Artifact, path: Path) -> str | None:
    """The digest that a file or folder inside an artifact had when it was made; None if it is not listed."""
    part = part_of(artifact, path)
    if part == ".":
        return artifact.digest
    files = artifact.manifest["files"]
    if part in files:
        return files[part][0]
    inside = {path.removeprefix(f"{part}/"): sha for path, (sha, _) in files.items() if path.startswith(f"{part}/")}
    return digest_of_listing(inside) if inside else None


def is_intact(artifact: Artifact) -> bool:
    """Whether the folder holds exactly the files of its manifest, byte for byte."""
    return not damage_of(artifact)


def damage_of(artifact: Artifact) -> tuple[str, ...]:
    """What differs between a folder and its manifest, one line each; nothing when it is intact."""
    expected: Mapping[str, tuple[str, int]] = artifact.manifest["files"]
    try:
        found = files_in(artifact.path)
    except OSError as error:
        return (f"cannot read {error.filename}: {error.strerror}",)
    names = (
        *(f"{path} is missing" for path in expected if path not in found),
        *(f"{path} was not part of it" for path in found if path not in expected),
    )
    return names or tuple(filter(None, in_threads(lambda path: _change(found[path], path, *expected[path]), expected)))


def _change(path: Path, name: str, sha256: str, size: int) -> str | None:
    try:
        same = path.stat().st_size == size and sha256_of(path) == sha256
    except OSError as error:
        return f"cannot read {name}: {error.strerror}"
    return None if same else f"{name} has other bytes"
