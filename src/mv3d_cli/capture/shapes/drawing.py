"""Drawing on a sheet with soft edges: ellipses, panels, pen lines, block letters.

Places are in units of the sheet's height: x right, y down from its middle, |y| <= 0.5, |x| <= aspect / 2, so
that circles stay circles on an object of that aspect. Colours are sRGB in [0, 1].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from mv3d_cli.capture.shapes.draws import SIZE, Number
from mv3d_cli.capture.shapes.textures import Colour, Paint, Picture
from mv3d_cli.scene.mesh import Material, Texture

# a letter, then its five rows of three bits as octal digits
FONT = """
A25755 B65656 C34443 D65556 E74647 F74644 G34553 H55755 I72227 J11152 K55655 L44447
M57755 N65555 O25552 P65644 Q25563 R65655 S34216 T72222 U55557 V55552 W55775 X55255
Y55222 Z71247 075557 126227 271747 371317 455711 574717 674757 771222 875757 975717
"""
GLYPHS = {glyph[0]: glyph[1:] for glyph in FONT.split()}


@dataclass(frozen=True)
class Sheet:
    """A picture being drawn, and the place of its texels."""

    pixels: Float[np.ndarray, "height width 3"]
    x: Float[np.ndarray, "1 width"]
    y: Float[np.ndarray, "height 1"]

    @property
    def texel(self) -> float:
        return 1.5 / self.pixels.shape[0]


def sheet(background: Colour | Picture, aspect: Number) -> Sheet:
    """A fresh sheet, of one colour or covered with a picture (twice, where the sheet is long)."""
    width = 2 * SIZE if aspect > 1.8 else SIZE
    if background.ndim == 1:
        pixels = np.broadcast_to(background, (SIZE, width, 3)).copy()
    else:
        size = len(background)
        rows, columns = np.arange(SIZE) * size // SIZE, np.arange(width) * size // SIZE % size
        pixels = background[rows][:, columns, :3] / 255.0
    x = ((np.arange(width) + 0.5) / width - 0.5) * aspect
    return Sheet(pixels, x[None, :], ((np.arange(SIZE) + 0.5) / SIZE - 0.5)[:, None])


def printed(page: Sheet) -> Paint:
    """The finished sheet as a paint."""
    height, width = page.pixels.shape[:2]
    pixels = np.full((height, width, 4), 255, np.uint8)
    pixels[..., :3] = np.round(255 * np.clip(page.pixels, 0, 1))
    return Paint(Material(texture=Texture(pixels)))


def _ink(page: Sheet, inside: np.ndarray, ink: Colour) -> None:
    """Covers the texels where `inside` (a distance in sheet units, negative outside) is positive."""
    cover = np.clip(0.5 + inside / page.texel, 0, 1)[..., None]
    rows, columns = np.flatnonzero(cover.any(axis=(1, 2))), np.flatnonzero(cover.any(axis=(0, 2)))
    if len(rows) and len(columns):
        window = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        page.pixels[window] += cover[window] * (ink - page.pixels[window])


def disc(page: Sheet, x: Number, y: Number, radius: tuple[Number, Number], ink: Colour) -> None:
    """An ellipse of that half width and half height."""
    scaled = np.hypot((page.x - x) / radius[0], (page.y - y) / radius[1])
    _ink(page, (1 - scaled) * min(radius), ink)


def panel(page: Sheet, x: Number, y: Number, half: tuple[Number, Number], ink: Colour, radius: Number = 0.01) -> None:
    """A rectangle of that half width and half height, with round corners."""
    dx, dy = np.abs(page.x - x) - half[0] + radius, np.abs(page.y - y) - half[1] + radius
    _ink(page, radius - np.hypot(np.maximum(dx, 0), np.maximum(dy, 0)) - np.minimum(np.maximum(dx, dy), 0), ink)


def stroke(page: Sheet, points: Sequence[tuple[Number, Number]], width: Number, ink: Colour) -> None:
    """A pen line through the points."""
    nearest = np.full(np.broadcast_shapes(page.x.shape, page.y.shape), np.inf)
    for (ax, ay), (bx, by) in pairwise(points):
        run, rise = bx - ax, by - ay
        along = np.clip(((page.x - ax) * run + (page.y - ay) * rise) / max(run**2 + rise**2, 1e-12), 0, 1)
        nearest = np.minimum(nearest, np.hypot(page.x - ax - along * run, page.y - ay - along * rise))
    _ink(page, width / 2 - nearest, ink)


def write(page: Sheet, text: str, x: Number, y: Number, box: tuple[Number, Number], ink: Colour) -> None:
    """Block letters centred on a point, as large as fit the box's width and height."""
    rows = [[int(GLYPHS[letter][row]) for letter in text] for row in range(5)]
    bits = np.array([[bit >> k & 1 for bit in row for k in (2, 1, 0, 3)] for row in rows])[:, :-1]
    cell = min(box[1] / 5, box[0] / bits.shape[1])
    column = np.floor((page.x[0] - x) / cell + bits.shape[1] / 2).astype(int)
    row = np.floor((page.y[:, 0] - y) / cell + 2.5).astype(int)
    columns = np.flatnonzero((column >= 0) & (column < bits.shape[1]))
    lines = np.flatnonzero((row >= 0) & (row < 5))
    if len(columns) and len(lines):
        window = np.s_[lines[0] : lines[-1] + 1, columns[0] : columns[-1] + 1]
        mask = bits[row[lines]][:, column[columns]].astype(bool)
        page.pixels[window][mask] = ink
