"""A mesh as an OBJ file, its material library and its pictures. Kd is linear light, vertex colours are sRGB.

A mesh of vertex colours alone has no library: many readers show either them or a material.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Shaped

from mv3d_cli.formats.images import png_bytes
from mv3d_cli.formats.textures import stored_pictures
from mv3d_cli.scene.conventions import srgb_from_linear
from mv3d_cli.scene.mesh import Material, Mesh


def obj_files(mesh: Mesh, path: Path, note: str) -> dict[str, bytes]:
    """By file name: `path`, its library STEM.mtl, its pictures STEM.png, STEM.2.png, ...

    The mesh is in the file's axes, its faces sorted by material.
    """
    stem = path.stem
    if mesh.colors is not None and all(replace(material, name="") == Material() for material in mesh.materials):
        return {path.name: f"# {note}\no object\n{_vertex_lines(mesh)}{_face_lines(mesh, [])}".encode()}
    pictures, chosen = stored_pictures(mesh.materials)
    picture_names = [f"{stem}.png", *(f"{stem}.{number + 1}.png" for number in range(1, len(pictures)))]
    names = _names(mesh.materials)
    library = [
        _entry(name, material, None if picture is None else picture_names[picture])
        for name, material, picture in zip(names, mesh.materials, chosen, strict=True)
    ]
    head = [f"# {note}", f"mtllib {stem}.mtl", "o object"]
    return {
        path.name: "\n".join([*head, _vertex_lines(mesh) + _face_lines(mesh, names)]).encode(),
        f"{stem}.mtl": "\n".join(library).encode(),
        **{name: png_bytes(pixels) for name, pixels in zip(picture_names, pictures, strict=False)},
    }


def _names(materials: tuple[Material, ...]) -> list[str]:
    """Distinct names without spaces, which not all readers take."""
    names: list[str] = []
    for number, material in enumerate(materials):
        name = re.sub(r"[^A-Za-z0-9_.-]", "_", material.name) or "material"
        names.append(name if name not in names else f"{name}_{number}")
    return names


def _entry(name: str, material: Material, picture: str | None) -> str:
    """A `newmtl` as our reader and Blender's take it: a picture takes the place of Kd."""
    *color, alpha = material.base_color
    lines = [f"newmtl {name}", "Kd " + " ".join(f"{value:.6g}" for value in color), "illum 1"]
    lines += [f"Pr {material.roughness:.6g}", f"Pm {material.metallic:.6g}"]
    if material.alpha_mode != "opaque":
        lines.append(f"d {alpha:.6g}")
    if picture is not None and material.texture is not None:
        placed = f"-clamp on {picture}" if material.texture.wrap_u == "clamp" else picture
        lines += [f"map_Kd {placed}"] + [f"map_d {placed}"] * (material.alpha_mode != "opaque")
    return "\n".join([*lines, ""])


def _vertex_lines(mesh: Mesh) -> str:
    """All of `v` (with its colour), `vt` and `vn`: nearly float32's seven digits, fewer where an angle needs none."""
    rows, form = mesh.vertices, "v %.7g %.7g %.7g"
    if mesh.colors is not None:
        rows = np.concatenate([rows, srgb_from_linear(mesh.colors[:, :3].clip(0, 1))], axis=1)
        form += " %.4f %.4f %.4f"
    text = _lines(form, rows)
    if mesh.uvs is not None:
        text += _lines("vt %.6f %.6f", np.stack([mesh.uvs[:, 0], 1 - mesh.uvs[:, 1]], axis=1))
    return text if mesh.normals is None else text + _lines("vn %.5f %.5f %.5f", mesh.normals)


def _face_lines(mesh: Mesh, names: list[str]) -> str:
    """The faces of each material, or all if none is named; a corner's vertex, uv and normal have one number."""
    match mesh.uvs is not None, mesh.normals is not None:
        case True, True:
            corner, repeats = "%d/%d/%d", 3
        case True, False:
            corner, repeats = "%d/%d", 2
        case False, True:
            corner, repeats = "%d//%d", 2
        case _:
            corner, repeats = "%d", 1
    lines, numbers = f"f {corner} {corner} {corner}", np.repeat(mesh.faces + 1, repeats, axis=1)
    if not names:
        return _lines(lines, numbers)
    parts = np.split(numbers, np.searchsorted(mesh.face_material, np.arange(1, len(names))))
    return "".join(f"usemtl {name}\n{_lines(lines, part)}" for name, part in zip(names, parts, strict=True))


def _lines(form: str, rows: Shaped[np.ndarray, "rows columns"]) -> str:
    """One line per row; a single format for all is several times as fast as one for each."""
    return f"{form}\n" * len(rows) % tuple(rows.reshape(-1).tolist())
