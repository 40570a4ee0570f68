"""The statements of an OBJ file as arrays: a block of lines at a time, no loop over vertices or faces.

Within a block each kind of line is cut out by a mask over its bytes and parsed in one call.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from io import BufferedIOBase

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64, UInt8

from mv3d_cli.errors import BadMesh

_BLOCK = 8 * 2**20
_LONGEST_LINE = 64 * 2**20
_NEWLINE, _SPACE, _SLASH, _HASH = (ord(character) for character in "\n /#")
_KINDS = {"v": b"v ", "vt": b"vt ", "vn": b"vn ", "f": b"f "}


@dataclass(frozen=True)
class Statements:
    """What an OBJ file says. A corner is (vertex, texture vertex, normal), from 0; -1 where there is none.

    colors is sRGB in [0, 1]; face_material indexes material_names, -1 before the first `usemtl`.
    """

    vertices: Float32[np.ndarray, "vertices 3"]
    colors: Float32[np.ndarray, "vertices 3"] | None
    texcoords: Float32[np.ndarray, "texcoords 2"]
    normals: Float32[np.ndarray, "normals 3"]
    corners: Int32[np.ndarray, "faces 3 3"]
    face_material: Int32[np.ndarray, "faces"]
    material_names: tuple[str, ...]
    libraries: tuple[str, ...]


@dataclass
class _Reading:
    """What has been read so far."""

    rows: dict[str, list[np.ndarray]]
    counts: dict[str, int]
    names: dict[str, int]
    libraries: list[str]
    material: int = -1


def read_statements(stream: BufferedIOBase) -> Statements:
    """Parse an OBJ file; polygons become fans. Raises BadMesh, without saying which file."""
    reading = _Reading({kind: [] for kind in (*_KINDS, "rgb", "material")}, dict.fromkeys(_KINDS, 0), {}, [])
    for piece in _pieces(stream):
        _read_block(reading, _cleaned(piece))
    rows, width = reading.rows, {"v": 3, "rgb": 3, "vt": 2, "vn": 3}
    arrays = {k: np.concatenate([np.zeros((0, n), np.float32), *rows[k]]) for k, n in width.items()}
    return Statements(
        vertices=arrays["v"],
        colors=None if np.isnan(arrays["rgb"]).all() else np.nan_to_num(arrays["rgb"], nan=1.0),
        texcoords=arrays["vt"],
        normals=arrays["vn"],
        corners=np.concatenate([np.zeros((0, 3, 3), np.int32), *rows["f"]]),
        face_material=np.concatenate([np.zeros(0, np.int32), *rows["material"]]),
        material_names=tuple(reading.names),
        libraries=tuple(reading.libraries),
    )


def library_names(stream: BufferedIOBase) -> list[str]:
    """The arguments of the `mtllib` lines."""
    found = []
    for piece in _pieces(stream):
        at = piece.find(b"mtllib")  # a search of the whole text by pattern takes ten times as long
        while at >= 0:
            line = piece[piece.rfind(b"\n", 0, at) + 1 : piece.find(b"\n", at)].split(maxsplit=1)
            if len(line) == 2 and line[0] == b"mtllib":
                found.append(line[1].decode("utf-8", errors="replace").strip())
            at = piece.find(b"mtllib", at + 6)
    return found


def _pieces(stream: BufferedIOBase) -> Iterator[bytes]:
    """The file in pieces of whole lines that end in a newline, continued lines together."""
    rest = b""
    while chunk := stream.read(_BLOCK):
        rest += chunk
        cut = rest.rfind(b"\n") + 1
        if b"\\" in rest[max(cut - 3, 0) : cut]:  # a continued line: wait for its end
            cut = 0
        if not cut and len(rest) > _LONGEST_LINE:
            raise BadMesh("it has a line of more than 64 MiB: this is no OBJ file.", "Export the mesh again.")
        if cut:
            yield rest[:cut]
            rest = rest[cut:]
    if rest:
        yield rest + b"\n"


def _cleaned(block: bytes) -> bytes:
    """Lines end in a newline alone, words are parted by spaces alone, continued lines are joined."""
    if b"\r" in block:
        block = block.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if b"\\\n" in block:
        block = block.replace(b"\\\n", b" ")
    if b"\t" in block:
        block = block.replace(b"\t", b" ")
    if block.startswith(b" ") or b"\n " in block:
        block = re.sub(rb"(?m)^ +", b"", block)
    return block


def _read_block(reading: _Reading, block: bytes) -> None:
    data = np.frombuffer(block, np.uint8)
    ends = np.flatnonzero(data == _NEWLINE) + 1
    starts = np.concatenate([[0], ends[:-1]])
    lines = {kind: _begin_with(data, starts, word) for kind, word in _KINDS.items()}
    spans = ends - starts
    for kind, least in (("v", 3), ("vt", 1), ("vn", 3)):
        if lines[kind].any():
            values, counts = _numbers(_cut(data, spans, lines[kind], len(kind)), kind, least)
            _keep(reading, kind, values, counts)
    if lines["f"].any():
        before = {kind: reading.counts[kind] + np.cumsum(lines[kind]) for kind in ("v", "vt", "vn")}
        at = np.flatnonzero(lines["f"])
        corners, sizes = _corners(_cut(data, spans, lines["f"], 1))
        corners = _from_zero(corners, np.stack([before[kind][at] for kind in ("v", "vt", "vn")], axis=1), sizes)
        reading.rows["f"].append(_fans(corners, sizes))
        materials = _materials(reading, data, block, starts, at)
        reading.rows["material"].append(np.repeat(materials, np.maximum(sizes - 2, 0)))
    else:
        _materials(reading, data, block, starts, np.zeros(0, np.int64))
    for kind in ("v", "vt", "vn"):
        reading.counts[kind] += int(lines[kind].sum())


def _begin_with(
    data: UInt8[np.ndarray, "bytes"], starts: Int64[np.ndarray, "lines"], word: bytes
) -> Bool[np.ndarray, "lines"]:
    padded_end = len(data) - 1
    same = np.ones(len(starts), bool)
    for offset, letter in enumerate(word):
        same &= data[np.minimum(starts + offset, padded_end)] == letter
    return same


def _cut(
    data: UInt8[np.ndarray, "bytes"],
    spans: Int64[np.ndarray, "lines"],
    chosen: Bool[np.ndarray, "lines"],
    word: int,
) -> UInt8[np.ndarray, "some"]:
    """The bytes of the chosen lines, their first `word` letters and their comments blanked."""
    piece = data[np.repeat(chosen, spans)]
    starts = np.cumsum(spans[chosen]) - spans[chosen]
    for offset in range(word):
        piece[starts + offset] = _SPACE
    if (piece == _HASH).any():
        comments = re.sub(rb"#[^\n]*", lambda match: b" " * len(match.group()), piece.tobytes())
        piece = np.frombuffer(comments, np.uint8)
    return piece


def _per_line(piece: UInt8[np.ndarray, "bytes"], marks: Bool[np.ndarray, "bytes"]) -> Int64[np.ndarray, "lines"]:
    """How many marks each line has."""
    ends = np.cumsum(marks, dtype=np.int64)[piece == _NEWLINE]
    return np.diff(ends, prepend=0)


def _token_starts(separates: Bool[np.ndarray, "bytes"]) -> Bool[np.ndarray, "bytes"]:
    starts = ~separates
    starts[1:] &= separates[:-1]
    return starts


def _parsed(piece: UInt8[np.ndarray, "bytes"], dtype: type, count: int, kind: str) -> np.ndarray:
    """All numbers of the text; `count` of them are expected."""
    try:  # text of spaces alone would be parsed as one number
        values = np.fromstring(piece.tobytes(), dtype, sep=" ") if count else np.zeros(0, dtype)
    except ValueError:
        values = None
    if values is None or len(values) != count:
        raise BadMesh(f"a line '{kind} ...' does not hold numbers.", "Export the mesh again.")
    return values


def _numbers(
    piece: UInt8[np.ndarray, "bytes"], kind: str, least: int
) -> tuple[Float64[np.ndarray, "numbers"], Int64[np.ndarray, "lines"]]:
    """The numbers of the lines, and how many each line has."""
    counts = _per_line(piece, _token_starts(piece <= _SPACE))
    if counts.min() < least:
        raise BadMesh(f"a line '{kind} ...' has {counts.min()} numbers.", "Export the mesh again.")
    return _parsed(piece, np.float64, int(counts.sum()), kind), counts


def _keep(
    reading: _Reading, kind: str, values: Float64[np.ndarray, "numbers"], counts: Int64[np.ndarray, "lines"]
) -> None:
    firsts = np.cumsum(counts) - counts

    def columns(start: int, stop: int) -> Float32[np.ndarray, "lines _"]:
        """Numbers start to stop of each line; NaN where the line is shorter."""
        if (counts == counts[0]).all() and stop <= counts[0]:
            return values.reshape(len(counts), -1)[:, start:stop].astype(np.float32)
        wanted = np.arange(start, stop)
        found = values[np.minimum(firsts[:, None] + wanted, len(values) - 1)].astype(np.float32)
        return np.where(wanted < counts[:, None], found, np.float32(np.nan))

    if kind == "vt":
        reading.rows["vt"].append(np.where(counts[:, None] > np.arange(2), columns(0, 2), np.float32(0)))
        return
    reading.rows[kind].append(columns(0, 3))
    if kind == "v":
        colored = (counts >= 6)[:, None]
        rgb = columns(3, 6) if colored.any() else np.zeros((len(counts), 3), np.float32)
        reading.rows["rgb"].append(np.where(colored, rgb, np.float32(np.nan)))


def _corners(
    piece: UInt8[np.ndarray, "bytes"],
) -> tuple[Int64[np.ndarray, "corners 3"], Int64[np.ndarray, "lines"]]:
    """Corners as written (`1`, `1/2`, `1//3`, `1/2/3`), 0 for a part left out; how many each face has."""
    slash = piece == _SLASH
    space = piece <= _SPACE
    starts = _token_starts(space)
    sizes = _per_line(piece, starts)
    at = np.flatnonzero(_token_starts(space | slash))
    values = _parsed(np.where(slash, np.uint8(_SPACE), piece), np.int64, len(at), "f")
    token = np.cumsum(starts)[at] - 1
    slashes = np.cumsum(slash)
    part = slashes[at] - slashes[np.flatnonzero(starts)][token]
    if part.size and (part.max() > 2 or part.min() < 0):
        raise BadMesh("a corner of a face has more than three parts.", "Export the mesh again.")
    corners = np.zeros((int(starts.sum()), 3), np.int64)
    corners[token, part] = values
    return corners, sizes


def _from_zero(
    corners: Int64[np.ndarray, "corners 3"],
    before: Int64[np.ndarray, "lines 3"],
    sizes: Int64[np.ndarray, "lines"],
) -> Int64[np.ndarray, "corners 3"]:
    """Indices from 0, -1 for none; negative ones count back from the rows `before` their line."""
    if corners.size and corners.min() < 0:
        counted = np.repeat(before, sizes, axis=0) + corners + 1
        if (counted[corners < 0] < 1).any():
            raise BadMesh("a face refers to a vertex before the first.", "Export the mesh again.")
        corners = np.where(corners < 0, counted, corners)
    if corners.size and (corners[:, 0].min() < 1 or corners.max() > np.iinfo(np.int32).max):
        raise BadMesh("a face refers to a vertex that is not there.", "Export the mesh again.")
    return corners - 1


def _fans(corners: Int64[np.ndarray, "corners 3"], sizes: Int64[np.ndarray, "lines"]) -> Int32[np.ndarray, "faces 3 3"]:
    """Triangles (0, i, i + 1) of each polygon."""
    corners = corners.astype(np.int32)
    if (sizes == 3).all():
        return corners.reshape(-1, 3, 3)
    triangles = np.maximum(sizes - 2, 0)
    first = np.repeat(np.cumsum(sizes) - sizes, triangles)
    step = np.arange(len(first)) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    return corners[np.stack([first, first + step + 1, first + step + 2], axis=1)]


def _materials(
    reading: _Reading,
    data: UInt8[np.ndarray, "bytes"],
    block: bytes,
    starts: Int64[np.ndarray, "lines"],
    face_lines: Int64[np.ndarray, "faces"],
) -> Int32[np.ndarray, "faces"]:
    """The material of each face line; remembers names, libraries and the material in force at the end."""
    lines, numbers = [-1], [reading.material]
    for line in np.flatnonzero(_begin_with(data, starts, b"usemtl") | _begin_with(data, starts, b"mtllib")):
        start = int(starts[line])
        text = block[start : block.index(b"\n", start)].decode("utf-8", errors="replace")
        word, _, argument = text.partition(" ")
        if word == "mtllib":
            reading.libraries.append(argument.strip())
        elif word == "usemtl":
            lines.append(int(line))
            numbers.append(reading.names.setdefault(argument.strip(), len(reading.names)))
    reading.material = numbers[-1]
    return np.array(numbers, np.int32)[np.searchsorted(lines, face_lines, side="right") - 1]
