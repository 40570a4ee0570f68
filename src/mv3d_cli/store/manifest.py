"""artifact.json: what an artifact holds, what made it, and from what.

schema, key, step, step_version, config, weights         the recipe
inputs       [{label, digest, source, made_by}]          made_by: the chain of the input, if we made it
digest, main, files {path: [sha256, size]}               the content
created (UTC), seconds, resumed, versions, device, command
checksum                                                 of all of the above, as canonical JSON
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import platform
import sys
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from typing import Any

from mv3d_cli.store.digest import MANIFEST, digest_of_listing, files_in, in_threads, sha256_of
from mv3d_cli.store.recipe import Recipe, canonical_json, plain

SCHEMA = 1
RECORD = ("step", "step_version", "key", "digest", "config", "inputs", "weights")
LONGEST_CHAIN = 8  # makers of makers that a manifest repeats
PACKAGES = {"mv3d": "mv3d-cli", "numpy": "numpy", "warp": "warp-lang", "torch": "torch"}
FIELDS = {
    "key": str,
    "step": str,
    "step_version": int,
    "config": dict,
    "inputs": list,
    "digest": str,
    "files": dict,
}


def describe(folder: Path, recipe: Recipe, makers: Mapping[str, Any], main: str | None) -> dict[str, Any]:
    """The manifest of the files in a folder. Raises OSError, and ValueError when `main` is not there."""
    paths = files_in(folder)
    sha256s = in_threads(sha256_of, paths.values())
    files = {name: [sha, path.stat().st_size] for (name, path), sha in zip(paths.items(), sha256s, strict=True)}
    if main is not None and main not in files:
        raise ValueError(f"step {recipe.step} promised {main} and did not write it")
    return {
        "schema": SCHEMA,
        "key": recipe.key,
        "step": recipe.step,
        "step_version": recipe.version,
        "config": plain(recipe.config),
        "inputs": [
            {
                "label": label,
                "digest": digest,
                "source": recipe.sources.get(label),
                "made_by": shortened(makers.get(label), LONGEST_CHAIN),
            }
            for label, digest in sorted(recipe.inputs.items())
        ],
        "weights": recipe.weights,
        "digest": digest_of_listing({path: sha256 for path, (sha256, _) in files.items()}),
        "main": main,
        "files": files,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": versions(),
        "command": [*sys.argv],
    }


def versions() -> dict[str, str]:
    """The versions that a result may depend on, without importing anything."""
    found = {"python": platform.python_version(), "platform": platform.platform()}
    for name, package in PACKAGES.items():
        try:
            found[name] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def write_manifest(folder: Path, manifest: Mapping[str, Any]) -> None:
    """Write artifact.json with its checksum. Raises OSError."""
    text = json.dumps({**manifest, "checksum": _checksum(manifest)}, indent=1)
    (folder / MANIFEST).write_text(text + "\n", encoding="ascii")


def read_manifest(folder: Path) -> dict[str, Any] | None:
    """The manifest of a folder, or None when there is none of ours that can be believed."""
    try:
        manifest = json.loads((folder / MANIFEST).read_text(encoding="ascii"))
        checksum = manifest.pop("checksum")
        good = _well_formed(manifest) and checksum == _checksum(manifest)
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return None
    return manifest if good else None


def _checksum(manifest: Mapping[str, Any]) -> str:
    return hashlib.sha256(canonical_json(manifest).encode("ascii")).hexdigest()


def _well_formed(manifest: Mapping[str, Any]) -> bool:
    """Whether the parts that the store relies on are there; an artifact.json may come from anywhere."""
    files = manifest["files"]
    return (
        manifest["schema"] == SCHEMA
        and all(isinstance(manifest[name], kind) for name, kind in FIELDS.items())
        and all(isinstance(sha256, str) and isinstance(size, int) for sha256, size in files.values())
        and not any(PurePosixPath(path).is_absolute() or ".." in PurePosixPath(path).parts for path in files)
        and (manifest["main"] is None or manifest["main"] in files)
        and all(isinstance(item["label"], str) and isinstance(item["digest"], str) for item in manifest["inputs"])
    )


def record_of(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """The part of a manifest that says how to make it again."""
    return {name: manifest[name] for name in RECORD}


def shortened(record: Mapping[str, Any] | None, links: int) -> dict[str, Any] | None:
    """A record without its makers beyond a number of links, so that manifests stay small."""
    if record is None or links == 0:
        return None
    inputs = [{**item, "made_by": shortened(item.get("made_by"), links - 1)} for item in record["inputs"]]
    return {**record, "inputs": inputs}
