"""Materials: base colour, its texture, and how uv find their texel.

A metallic-roughness texture makes both vary over the surface; we have one number each: a rough dielectric's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from mv3d_cli.formats.gltf.container import Document, uri_bytes, uri_path, view_bytes
from mv3d_cli.formats.textures import GREY, TextureFiles
from mv3d_cli.scene.mesh import AlphaMode, Material, Texture, Wrap

_WRAPS: dict[int, Wrap] = {33071: "clamp", 33648: "mirror", 10497: "repeat"}
_ALPHA_MODES: dict[str, AlphaMode] = {"OPAQUE": "opaque", "MASK": "mask", "BLEND": "blend"}


@dataclass(frozen=True)
class Surface:
    """A material, which set of texture coordinates it uses, and the map from those to its texture's uv."""

    material: Material
    texcoord: int = 0
    uv_from_texcoord: Float[np.ndarray, "2 3"] | None = None


def transformed(
    texcoords: Float32[np.ndarray, "vertices 2"], uv_from_texcoord: Float[np.ndarray, "2 3"] | None
) -> Float32[np.ndarray, "vertices 2"]:
    """The texture's uv (KHR_texture_transform; None: unchanged)."""
    if uv_from_texcoord is None:
        return texcoords
    return (texcoords @ uv_from_texcoord[:, :2].T + uv_from_texcoord[:, 2]).astype(np.float32)


def surface(document: Document, index: Any, files: TextureFiles) -> Surface:
    """The surface of material `index` (None: glTF's default material). Raises BadMesh."""
    if index is None:
        return Surface(Material())
    item = document.item("materials", index)
    extensions = item.get("extensions", {})
    factors = _metallic_roughness(item.get("pbrMetallicRoughness"))
    if (glossy := extensions.get("KHR_materials_pbrSpecularGlossiness")) is not None:
        factors = {
            "base_color": tuple(map(float, glossy.get("diffuseFactor", (1, 1, 1, 1)))),
            "roughness": 1 - float(glossy.get("glossinessFactor", 1)),
        }
        info = glossy.get("diffuseTexture")
    else:
        info = item.get("pbrMetallicRoughness", {}).get("baseColorTexture")
    if len(factors["base_color"]) != 4:
        raise document.bad(f"materials[{index}] has a base colour of {len(factors['base_color'])} numbers")
    texture = _texture(document, info["index"], files) if info else None
    if info and texture is None:
        factors["base_color"] = (GREY, GREY, GREY, factors["base_color"][3])
    material = Material(
        texture=texture,
        alpha_mode=_ALPHA_MODES.get(item.get("alphaMode", "OPAQUE"), "opaque"),
        alpha_cutoff=float(item.get("alphaCutoff", 0.5)),
        name=str(item.get("name", "")),
        **factors,
    )
    return Surface(material, *_texcoord(info or {}))


def image_paths(document: Document) -> list[Path]:
    """The files that the document's pictures are in. Raises BadMesh for one outside its folder."""
    uris = [image["uri"] for image in document.json.get("images", []) if "uri" in image]
    return [uri_path(document, uri) for uri in uris if not uri.startswith("data:")]


def _metallic_roughness(item: dict[str, Any] | None) -> dict[str, Any]:
    if item is None:
        return {"base_color": (1.0, 1.0, 1.0, 1.0)}
    varies = "metallicRoughnessTexture" in item
    return {
        "base_color": tuple(map(float, item.get("baseColorFactor", (1, 1, 1, 1)))),
        "roughness": 1.0 if varies else float(item.get("roughnessFactor", 1)),
        "metallic": 0.0 if varies else float(item.get("metallicFactor", 1)),
    }


def _texcoord(info: dict[str, Any]) -> tuple[int, Float[np.ndarray, "2 3"] | None]:
    """The set of texture coordinates, and KHR_texture_transform's translation * rotation * scale."""
    transform = info.get("extensions", {}).get("KHR_texture_transform")
    texcoord = info.get("texCoord", 0)
    if not transform:
        return texcoord, None
    (du, dv), (su, sv) = transform.get("offset", (0, 0)), transform.get("scale", (1, 1))
    cos, sin = math.cos(transform.get("rotation", 0)), math.sin(transform.get("rotation", 0))
    # uv run downwards: a turn counter-clockwise to the eye has its sine below the diagonal negative
    matrix = np.array([[su * cos, sv * sin, du], [-su * sin, sv * cos, dv]])
    return transform.get("texCoord", texcoord), matrix


def _texture(document: Document, index: Any, files: TextureFiles) -> Texture | None:
    item = document.item("textures", index)
    webp = item.get("extensions", {}).get("EXT_texture_webp", {})
    source = item.get("source", webp.get("source"))
    if source is None:
        files.warn(f"textures[{index}] has no picture that can be read; it is replaced by grey.")
        return None
    pixels = files.pixels(source, *_image(document, source))
    if pixels is None:
        return None
    sampler = document.item("samplers", item["sampler"]) if "sampler" in item else {}
    return Texture(
        pixels,
        _WRAPS.get(sampler.get("wrapS", 10497), "repeat"),
        _WRAPS.get(sampler.get("wrapT", 10497), "repeat"),
    )


def _image(document: Document, index: Any) -> tuple[Path | bytes, str]:
    """The file or bytes of a picture, and what to call it."""
    item = document.item("images", index)
    label = str(item.get("name") or f"images[{index}]")
    if "uri" not in item:
        return bytes(view_bytes(document, item["bufferView"])), label
    if item["uri"].startswith("data:"):
        return uri_bytes(document, item["uri"]), label
    return uri_path(document, item["uri"]), item["uri"][:200]
