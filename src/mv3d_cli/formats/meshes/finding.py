"""Where meshes are, what they are called, and which way up each lies.

glTF and OBJ are +Y up, PLY and STL +Z up, as Blender's importers take them; the OBJ files of the Google Scanned
Objects (NAME/meshes/model.obj, NAME/materials/textures/texture.png) are +Z up.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from mv3d_cli.errors import MissingInput

SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl")
SUFFIXES_HINT = f"Meshes are {', '.join(suffix[1:] for suffix in SUFFIXES)} files, or folders of them."
Up = Literal["auto", "y", "z"]


@dataclass(frozen=True)
class MeshFile:
    """A mesh on disk; `name` is distinct among those found together and can be a file name."""

    name: str
    path: Path


def find_meshes(path: Path) -> list[MeshFile]:
    """The mesh at `path`, or all below it, sorted by name; hidden folders are passed over.

    A mesh is called after its path below `path` (`a/b.glb`: a__b), with its suffix where two would be called the
    same; a Google Scanned Object after its folder. Raises MissingInput where there is none.
    """
    if path.is_file():
        if path.suffix.lower() not in SUFFIXES:
            raise MissingInput(f"{path} is not a mesh file that we read.", SUFFIXES_HINT)
        return [MeshFile(_plain(_object_folder(path).name if _is_scanned(path) else path.stem), path)]
    if not path.is_dir():
        raise MissingInput(f"there is no file or folder {path}.", "Check the path.")
    files = list(_files_below(path))
    if not files:
        raise MissingInput(f"there is no mesh in {path}.", SUFFIXES_HINT)
    stems = {file: _name_below(path, file) for file in files}
    shared = Counter(name.casefold() for name in stems.values())
    named = [(f"{n}_{f.suffix[1:]}" if shared[n.casefold()] > 1 else n, f) for f, n in stems.items()]
    taken: set[str] = set()
    found = []
    for name, file in sorted(named):
        while name.casefold() in taken:
            name += "_"
        taken.add(name.casefold())
        found.append(MeshFile(name, file))
    return found


def is_y_up(file: Path, up: Up = "auto") -> bool:
    """Whether the file's +Y axis points upwards, as `up` says or else as files of its kind have it."""
    return up == "y" or (up == "auto" and file.suffix.lower() in (".glb", ".gltf", ".obj") and not _is_scanned(file))


def _files_below(folder: Path) -> Iterator[Path]:
    for parent, folders, names in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith((".", "__MACOSX")))
        for name in sorted(names):
            if not name.startswith(".") and name.lower().endswith(SUFFIXES):
                yield Path(parent, name)


def _name_below(root: Path, file: Path) -> str:
    if _is_scanned(file):
        place = _object_folder(file)
        below = Path(os.path.relpath(place, root)).parts
        named = list(below) if below and below[0] != ".." else [place.name]
    else:
        named = [*file.relative_to(root).parts[:-1], file.stem]
    return _plain("__".join(named))


def _plain(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_.-]", "_", name).lstrip(".-") or "mesh"


def _object_folder(file: Path) -> Path:
    return Path(os.path.abspath(file)).parent.parent


def _is_scanned(file: Path) -> bool:
    """Whether the file lies as in the archives of the Google Scanned Objects."""
    place = Path(os.path.abspath(file))
    return (
        place.name.lower() == "model.obj"
        and place.parent.name == "meshes"
        and (place.parent.parent / "materials" / "textures").is_dir()
    )
