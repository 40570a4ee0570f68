"""Parts painted, placed, repeated and joined into one mesh. Angles in degrees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from mv3d_cli.capture.shapes.draws import Number
from mv3d_cli.capture.shapes.surfaces import Part, Vector
from mv3d_cli.capture.shapes.textures import Paint
from mv3d_cli.scene.mesh import Material, Mesh


def place(part: Part, at: Vector = (0, 0, 0), turn: Vector = (0, 0, 0), scale: Vector | Number = 1) -> Part:
    """The part scaled, then turned about x, y and z in that order, then moved."""
    vertices = part.vertices * np.asarray(scale, float)
    for axis, angle in enumerate(turn):
        if angle:
            cos, sin = np.cos(np.radians(angle)), np.sin(np.radians(angle))
            b, c = (axis + 1) % 3, (axis + 2) % 3
            turned = vertices.copy()
            turned[:, b] = cos * vertices[:, b] - sin * vertices[:, c]
            turned[:, c] = sin * vertices[:, b] + cos * vertices[:, c]
            vertices = turned
    return replace(part, vertices=vertices + np.asarray(at, float))


def mirrored(part: Part) -> Part:
    """The part seen in a mirror at x = 0, still facing outwards."""
    return replace(part, vertices=part.vertices * np.array([-1, 1, 1]), faces=part.faces[:, ::-1])


def pair(part: Part) -> list[Part]:
    """The part and its mirror image: bilateral symmetry."""
    return [part, mirrored(part)]


def around(part: Part, copies: int, start: Number = 0.0) -> list[Part]:
    """Copies of the part evenly round +Z."""
    return [place(part, turn=(0, 0, start + 360 * k / copies)) for k in range(copies)]


def extent(part: Part, slot: int = 0) -> tuple[float, float]:
    """The mean length on the surface of one unit of u and of one unit of v."""
    corners = part.faces[part.slots == slot]
    uv, xyz = part.uvs[corners], part.vertices[corners]
    (u1, v1), (u2, v2) = (uv[:, 1] - uv[:, 0]).T, (uv[:, 2] - uv[:, 0]).T
    first, second = xyz[:, 1] - xyz[:, 0], xyz[:, 2] - xyz[:, 0]
    flip = np.sign(u1 * v2 - u2 * v1)[:, None]
    along_u = np.linalg.norm((flip * (v2[:, None] * first - v1[:, None] * second)).reshape(-1, 3), axis=1)
    along_v = np.linalg.norm((flip * (u1[:, None] * second - u2[:, None] * first)).reshape(-1, 3), axis=1)
    area = max(float(np.abs(u1 * v2 - u2 * v1).sum()), 1e-9)
    return max(float(along_u.sum()) / area, 1e-6), max(float(along_v.sum()) / area, 1e-6)


def aspect(part: Part, slot: int = 0) -> float:
    """Width over height of the picture that a print on this slot should be, within reason."""
    u, v = extent(part, slot)
    return float(np.clip(u / v, 0.25, 6.0))


def painted(part: Part, *paints: Paint) -> Part:
    """The part with one paint per slot (the last one for the rest).

    A tiling paint repeats a whole number of times round the part, at its own scale; a print spreads once.
    """
    slots = int(part.slots.max()) + 1
    chosen = [paints[min(slot, len(paints) - 1)] for slot in range(slots)]
    uvs = part.uvs.copy()
    for slot, paint in enumerate(chosen):
        if paint.tile is not None:
            used = np.unique(part.faces[part.slots == slot])
            u, v = extent(part, slot)
            uvs[used] *= [max(1, round(u / paint.tile)), max(v / paint.tile, 0.15)]
    return replace(part, uvs=uvs, materials=tuple(paint.material for paint in chosen))


def normals(part: Part) -> Float[np.ndarray, "vertices 3"]:
    """Unit shading normals: the area-weighted mean over the faces round each smooth group."""
    a, b, c = (part.vertices[part.faces[:, k]] for k in range(3))
    weighted = np.cross(b - a, c - a)
    group = part.smooth[part.faces].T.ravel()
    size = int(part.smooth.max()) + 1
    total = [np.bincount(group, np.tile(weighted[:, axis], 3), size) for axis in range(3)]
    normal = np.stack(total, axis=1)[part.smooth]
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)


def join(parts: Sequence[Part]) -> Mesh:
    """One mesh of all (painted) parts; a material that several share appears once."""
    offsets = np.cumsum([0] + [len(part.vertices) for part in parts])[:-1]
    known: dict[int, int] = {}
    materials: list[Material] = []
    numbers: list[Int[np.ndarray, "faces"]] = []
    for part in parts:
        for material in part.materials:
            if id(material) not in known:
                known[id(material)] = len(materials)
                materials.append(material)
        numbers.append(np.array([known[id(material)] for material in part.materials])[part.slots])
    return Mesh(
        vertices=np.concatenate([part.vertices for part in parts]).astype(np.float32),
        faces=np.concatenate([p.faces + offset for p, offset in zip(parts, offsets, strict=True)]).astype(np.int32),
        face_material=np.concatenate(numbers).astype(np.int32),
        materials=tuple(materials),
        normals=np.concatenate([normals(part) for part in parts]).astype(np.float32),
        uvs=np.concatenate([part.uvs for part in parts]).astype(np.float32),
    )
