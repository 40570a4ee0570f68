"""Textures of meshes: read at most 4096 pixels a side, and replaced by grey where they cannot be had."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from mv3d_cli.errors import BadImage, MissingInput
from mv3d_cli.formats.images import decode_reduced, read_bytes
from mv3d_cli.scene.conventions import linear_from_srgb, srgb_from_linear
from mv3d_cli.scene.mesh import Material

MAX_TEXTURE_SIDE = 4096
GREY = float(linear_from_srgb(np.array([0.5]))[0])
"""What a surface looks like whose colour is not known: sRGB 0.5, here in linear light."""

GREY_MATERIAL = Material(base_color=(GREY, GREY, GREY, 1.0))


class MeshWarning(UserWarning):
    """A mesh could be read, but not all of it as its author meant it."""


@dataclass(frozen=True)
class TextureFiles:
    """Decodes each picture of one mesh once; None stands for a picture that cannot be had."""

    mesh: Path
    decoded: dict[object, UInt8[np.ndarray, "height width 4"] | None] = field(default_factory=dict)
    ahead: dict[object, Future] = field(default_factory=dict)

    def decode_ahead(self, pictures: Iterable[Path], pool: Executor) -> None:
        """Begin to decode pictures that will be asked for; what is wrong with them is told then."""
        self.ahead.update({picture: pool.submit(_pixels_of, picture, picture.name) for picture in pictures})

    def pixels(self, key: object, source: Path | bytes | None, label: str) -> np.ndarray | None:
        """RGBA pixels [height, width, 4] of the file or bytes `source`, remembered under `key`.

        None, after a MeshWarning, where `source` is None (nothing was found), missing, or no picture.
        """
        if key not in self.decoded:
            self.decoded[key] = self._decode(source, label)
        return self.decoded[key]

    def _decode(self, source: Path | bytes | None, label: str) -> UInt8[np.ndarray, "height width 4"] | None:
        try:
            if source is None:
                raise MissingInput("it was not found.", "")
            begun = self.ahead.get(source)
            pixels, (width, height) = begun.result() if begun else _pixels_of(source, label)
        except (MissingInput, BadImage) as error:
            self.warn(f"texture {label} is replaced by grey: {error}")
            return None
        if max(width, height) > MAX_TEXTURE_SIDE:
            self.warn(f"texture {label} ({width}x{height}) is reduced to {pixels.shape[1]}x{pixels.shape[0]}.")
        return pixels

    def warn(self, message: str) -> None:
        """Say what of this mesh is not as its author meant it."""
        warnings.warn(f"{self.mesh}: {message}", MeshWarning, stacklevel=2)


def stored_pictures(
    materials: Iterable[Material],
) -> tuple[list[UInt8[np.ndarray, "height width channels"]], list[int | None]]:
    """The distinct pictures of some materials, RGB where alpha says nothing, and which of them each material has."""
    pictures: list[np.ndarray] = []
    numbers: dict[tuple[int, bool], int] = {}
    chosen: list[int | None] = []
    for material in materials:
        if material.texture is None:
            chosen.append(None)
            continue
        pixels, opaque = material.texture.pixels, material.alpha_mode == "opaque"
        number = numbers.setdefault((id(pixels), opaque), len(pictures))
        if number == len(pictures):
            pictures.append(pixels[..., :3] if opaque or (pixels[..., 3] == 255).all() else pixels)
        chosen.append(number)
    return pictures, chosen


def tinted(material: Material) -> Material:
    """The material with its base colour (not its alpha) inside its picture, for formats that show a picture alone."""
    *color, alpha = material.base_color
    if material.texture is None or color == [1, 1, 1]:
        return material
    levels = linear_from_srgb(np.arange(256) / 255)[:, None] * np.array(color)
    table = np.round(srgb_from_linear(levels.clip(0, 1)) * 255).astype(np.uint8)
    pixels = material.texture.pixels.copy()
    for channel in range(3):
        pixels[..., channel] = table[pixels[..., channel], channel]
    return replace(material, base_color=(1.0, 1.0, 1.0, alpha), texture=replace(material.texture, pixels=pixels))


def _pixels_of(source: Path | bytes, label: str) -> tuple[UInt8[np.ndarray, "height width 4"], tuple[int, int]]:
    """RGBA pixels, reduced if need be, and the size before. Raises MissingInput or BadImage."""
    data = source if isinstance(source, bytes) else read_bytes(source)
    return decode_reduced(data, label, MAX_TEXTURE_SIDE)
