"""Material libraries (.mtl), read as Blender's importer reads them.

Kd is linear light. `map_Kd` takes the place of Kd (many exporters write Kd 0 or 0.8 beside it); its alpha counts
only where `map_d` names the same picture. A picture may lie anywhere below the parent of the OBJ's folder; one that
is not there is looked for by its name in the folders where pictures usually are, in any case of letters.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mv3d_cli.formats.images import read_bytes
from mv3d_cli.formats.textures import GREY_MATERIAL, TextureFiles
from mv3d_cli.scene.mesh import Material, Texture

_USUAL_FOLDERS = (
    "materials/textures",
    "../materials/textures",
    "textures",
    "materials",
    "../textures",
    "../materials",
)
_OPTION_WORDS = {
    "-blendu": 1,
    "-blendv": 1,
    "-bm": 1,
    "-boost": 1,
    "-cc": 1,
    "-clamp": 1,
    "-imfchan": 1,
    "-mm": 2,
}
_OPTION_WORDS |= {"-texres": 1, "-type": 1}
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")


@dataclass(frozen=True)
class Map:
    """A picture's path as written, and how it lies: uv (v upwards) = uv * scale + offset."""

    name: str
    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)
    clamp: bool = False


@dataclass
class Entry:
    """One `newmtl` of a library, as far as we use it, and the library's folder."""

    folder: Path
    color: tuple[float, float, float] = (0.8, 0.8, 0.8)
    alpha: float = 1.0
    roughness: float = 1.0
    metallic: float = 0.0
    map_color: Map | None = None
    map_alpha: Map | None = None
    unread: list[str] = field(default_factory=list)


def library_paths(obj: Path, arguments: list[str] | tuple[str, ...]) -> list[tuple[str, Path | None]]:
    """The files that `mtllib` arguments name (a name may hold spaces, or be several); None: not there."""
    found: list[tuple[str, Path | None]] = []
    for argument in dict.fromkeys(arguments):
        whole = find_file(obj, obj.parent, argument)
        names = [argument] if whole or " " not in argument else argument.split()
        found += [(name, find_file(obj, obj.parent, name)) for name in names]
    return found


def read_library(path: Path) -> dict[str, Entry]:
    """The materials of a library by name; lines that make no sense are remembered, not followed."""
    entries: dict[str, Entry] = {}
    entry = Entry(path.parent)
    text = read_bytes(path).decode("utf-8", errors="replace").replace("\\\n", " ")
    for line in text.splitlines():
        word, _, argument = line.strip().replace("\t", " ").partition(" ")
        if word == "newmtl":
            entry = entries.setdefault(argument.strip(), Entry(path.parent))
        else:
            try:
                _set(entry, word.lower(), argument.strip())
            except (ValueError, IndexError):
                entry.unread.append(line.strip()[:80])
    return entries


def material(obj: Path, name: str, entry: Entry, files: TextureFiles) -> Material:
    """The entry as a material; grey, after a warning, where its picture cannot be had."""
    for line in entry.unread:
        files.warn(f"material {name}: the line {line!r} makes no sense and is left out.")
    texture, cut_out, placed = None, False, entry.map_color
    if placed is not None:
        path = find_file(obj, entry.folder, placed.name)
        pixels = files.pixels(path or placed.name, path, placed.name)
        if pixels is None:
            return GREY_MATERIAL
        wrap = "clamp" if placed.clamp else "repeat"
        texture = Texture(pixels, wrap, wrap)
        cut_out = entry.map_alpha is not None and entry.map_alpha.name == placed.name
    return Material(
        base_color=(*(entry.color if texture is None else (1.0, 1.0, 1.0)), entry.alpha),
        texture=texture,
        alpha_mode="blend" if cut_out or entry.alpha < 1 else "opaque",
        roughness=entry.roughness,
        metallic=entry.metallic,
        name=name,
    )


def texture_path(obj: Path, entry: Entry) -> Path | None:
    """The entry's colour picture, if it has one that is there."""
    return find_file(obj, entry.folder, entry.map_color.name) if entry.map_color else None


def laid(texcoords: Float32[np.ndarray, "rows 2"], placed: Map | None) -> Float32[np.ndarray, "rows 2"]:
    """Texture coordinates (v upwards) after the options -s and -o."""
    if placed is None:
        return texcoords
    return texcoords * np.array(placed.scale, np.float32) + np.array(placed.offset, np.float32)


def find_file(obj: Path, folder: Path, name: str) -> Path | None:
    """The file that `name` means: beside `folder`, else by its last part in the usual folders."""
    name = name.strip().strip('"').replace("\\", "/")
    if not name or "\0" in name:
        return None
    last = name.rsplit("/", 1)[-1]
    root = obj.resolve().parent.parent
    asked = [] if name.startswith("/") or re.match("[A-Za-z]:", name) else [folder / name, obj.parent / name]
    usual = [parent / last for parent in (folder, *(obj.parent / usual for usual in _USUAL_FOLDERS))]
    for path in (*asked, *usual):
        found = path if path.is_file() else _in_any_case(path)
        if found is not None and found.resolve().is_relative_to(root):
            return found
    return None


def _in_any_case(path: Path) -> Path | None:
    if not path.parent.is_dir():
        return None
    wanted = path.name.casefold()
    return next((p for p in sorted(path.parent.iterdir()) if p.name.casefold() == wanted and p.is_file()), None)


def _set(entry: Entry, word: str, argument: str) -> None:
    if word == "kd" and not argument.startswith(("spectral", "xyz")):
        red, *others = (float(number) for number in argument.split()[:3])
        green, blue = others if len(others) == 2 else (red, red)
        entry.color = (red, green, blue)
    elif word == "d":
        entry.alpha = min(max(float(argument.split()[-1]), 0.0), 1.0)
    elif word == "tr":
        entry.alpha = 1 - min(max(float(argument.split()[-1]), 0.0), 1.0)
    elif word == "pr":
        entry.roughness = min(max(float(argument), 0.0), 1.0)
    elif word == "pm":
        entry.metallic = min(max(float(argument), 0.0), 1.0)
    elif word == "map_kd":
        entry.map_color = _map(argument)
    elif word == "map_d":
        entry.map_alpha = _map(argument)


def _map(argument: str) -> Map:
    """Options, then a path that may hold spaces."""
    scale, offset, clamp = (1.0, 1.0), (0.0, 0.0), False
    rest = argument
    while rest.startswith("-"):
        option, _, rest = rest.partition(" ")
        if option in ("-s", "-o", "-t"):
            numbers: list[float] = []
            while len(numbers) < 3 and (match := _NUMBER.match(rest)) and rest[match.end() :][:1] == " ":
                numbers.append(float(match.group()))
                rest = rest[match.end() :].lstrip()
            pair = (numbers[0], numbers[1] if len(numbers) > 1 else (1.0 if option == "-s" else 0.0))
            scale, offset = (pair if option == "-s" else scale), (pair if option == "-o" else offset)
        elif option in _OPTION_WORDS:
            words = rest.split(None, _OPTION_WORDS[option])
            clamp = clamp or (option == "-clamp" and words[0] == "on")
            rest = words[-1]
        else:
            raise ValueError(option)
    return Map(rest, scale, offset, clamp)
