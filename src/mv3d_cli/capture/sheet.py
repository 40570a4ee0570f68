"""Contact sheets: many small pictures on one page, because people would rather look than read. RGB, 8 bits."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from mv3d_cli.scene.views import View, Views

Picture = UInt8[np.ndarray, "_rows _columns 3"]

CELL = 192  # pixels
GAP = 4
INK = (60, 60, 60)


def _fit(picture: np.ndarray, interpolation: int = cv2.INTER_LINEAR) -> np.ndarray:
    """The picture brought to the cell's size, its shape kept: halved while it is twice as large, then interpolated."""
    while interpolation == cv2.INTER_LINEAR and max(picture.shape[:2]) >= 2 * CELL and min(picture.shape[:2]) > 1:
        half = (picture.shape[1] // 2, picture.shape[0] // 2)
        picture = cv2.resize(picture, half, interpolation=cv2.INTER_AREA)
    height, width = picture.shape[:2]
    scale = CELL / max(height, width)
    shape = (max(round(width * scale), 1), max(round(height * scale), 1))
    return cv2.resize(picture, shape, interpolation=interpolation)


def color_cell(color: UInt8[np.ndarray, "height width 4"]) -> Picture:
    """Colour on a white page; shrunk first, so that partly covered pixels count as premultiplied."""
    small = _fit(color).astype(np.int32)
    return np.minimum(small[..., :3] + 255 - small[..., 3:], 255).astype(np.uint8)


def depth_cell(depth: Float[np.ndarray, "height width"], near: float, far: float) -> Picture:
    """Depth as colours, near bright, white where there is no surface."""
    small = _fit(depth, cv2.INTER_NEAREST)
    nearness = np.clip((far - small) / max(far - near, 1e-6), 0, 1)
    colored = cv2.applyColorMap(np.round(nearness * 255).astype(np.uint8), cv2.COLORMAP_VIRIDIS)[..., ::-1]
    return np.where(small[..., None] > 0, colored, 255).astype(np.uint8)


def normal_cell(view: View) -> Picture:
    """The normal map, white where it is known that there is no surface."""
    assert view.normal is not None
    small = _fit(view.normal)
    if view.depth is None:
        return small
    return np.where(_fit(view.depth, cv2.INTER_NEAREST)[..., None] > 0, small, 255).astype(np.uint8)


def _framed(small: Picture, label: str = "") -> Picture:
    """A shrunk picture in the middle of its cell, with a label below."""
    foot = 18 if label else 0
    cell = np.full((CELL + foot, CELL, 3), 255, np.uint8)
    top, left = (CELL - small.shape[0]) // 2, (CELL - small.shape[1]) // 2
    cell[top : top + small.shape[0], left : left + small.shape[1]] = small
    if label:
        cv2.putText(cell, label, (4, CELL + 13), cv2.FONT_HERSHEY_SIMPLEX, 0.4, INK, 1, cv2.LINE_AA)
    return cell


def _page(rows: Sequence[Sequence[Picture]]) -> Picture:
    """Rows of cells on one white page."""
    width = max(sum(cell.shape[1] + GAP for cell in row) for row in rows)
    height = sum(max(cell.shape[0] for cell in row) + GAP for row in rows)
    page = np.full((height, width, 3), 255, np.uint8)
    top = 0
    for row in rows:
        left = 0
        for cell in row:
            page[top : top + cell.shape[0], left : left + cell.shape[1]] = cell
            left += cell.shape[1] + GAP
        top += max(cell.shape[0] for cell in row) + GAP
    return page


def sheet_of_views(views: Views) -> Picture:
    """One column a view: colour, normals and depth, as far as the views hold them."""
    depths = [view.depth for view in views.frames if view.depth is not None]
    near = float(min((depth.min(where=depth > 0, initial=np.inf) for depth in depths), default=0.0))
    far = float(max((depth.max() for depth in depths), default=1.0))
    rows = [
        [color_cell(view.color) for view in views.frames if view.color is not None],
        [normal_cell(view) for view in views.frames if view.normal is not None],
        [depth_cell(view.depth, near, far) for view in views.frames if view.depth is not None],
    ]
    labels = [view.camera.name for view in views.frames]
    page = []
    for row in filter(None, rows):
        shown = labels if not page and len(row) == len(labels) else [""] * len(row)
        page.append([_framed(cell, label) for cell, label in zip(row, shown, strict=True)])
    return _page(page)


def sheet_of_objects(pictures: Sequence[UInt8[np.ndarray, "_h _w 4"]]) -> Picture:
    """A square page of objects, one picture each."""
    side = max(int(np.ceil(np.sqrt(len(pictures)))), 1)
    cells = [_framed(color_cell(picture)) for picture in pictures]
    return _page([cells[i : i + side] for i in range(0, len(cells), side)])


def sheet_of_rows(rows: Sequence[Sequence[np.ndarray | None]], near: float = 1.0, far: float = 3.0) -> Picture:
    """Rows of colours (RGBA) and depths (one channel) of any sizes; None leaves a cell empty."""

    def cell(picture: np.ndarray | None) -> Picture:
        if picture is None:
            return np.full((CELL, CELL, 3), 255, np.uint8)
        return _framed(color_cell(picture) if picture.ndim == 3 else depth_cell(picture, near, far))

    return _page([[cell(picture) for picture in row] for row in rows])
