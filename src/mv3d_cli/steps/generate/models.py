"""Where a model lies: bundled with the program, in a folder, or in the hub's cache."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from mv3d_cli.errors import MissingInput
from mv3d_cli.formats.assets import asset
from mv3d_cli.store import digest_of_path

BUNDLED = {"small": "weights/small"}
_HINT = "give small, a folder that `mv3d train` wrote, or a hub id in diffusers layout, such as someone/something"


@dataclass(frozen=True)
class Place:
    """A model's folder (or weights file) and the digest of what lies there; `foreign`: in diffusers layout."""

    path: Path
    digest: str
    foreign: bool = False


def found(model: str) -> Place:
    """The place of the model that is called so: a bundled one's name, a path, or a hub id. Raises MissingInput."""
    path = asset(BUNDLED[model]) if model in BUNDLED else Path(model)
    if path.is_dir() and (path / "unet").is_dir():
        return Place(path, digest_of_path(path), foreign=True)
    if path.is_dir() and not any((path / name).is_file() for name in ("config.json", "model.safetensors")):
        raise MissingInput(f"the folder {path} holds no model", _HINT)
    if path.exists():
        return Place(path, digest_of_path(path))
    if model.count("/") != 1 or model.startswith((".", "/", "~")):
        raise MissingInput(f"there is no model {model}", _HINT)
    from mv3d_cli.diffusion.model.stable_diffusion import folder_of

    folder = folder_of(model)
    return Place(folder, digest_of_path(folder), foreign=True)
