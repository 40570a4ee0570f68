"""Contact sheets hold every picture in its place."""

from __future__ import annotations

import numpy as np

from mv3d_cli.capture.sheet import CELL, GAP, color_cell, sheet_of_objects, sheet_of_views
from mv3d_cli.scene.camera import Orthographic, look_at_origin
from mv3d_cli.scene.views import View, Views


def flat(color: tuple[int, int, int, int], size: tuple[int, int] = (40, 40)) -> np.ndarray:
    return np.tile(np.array(color, np.uint8), (*size, 1))


def test_a_column_a_view_and_a_row_a_kind() -> None:
    cameras = [look_at_origin(name, (0.0, -2.0, 0.0), Orthographic()) for name in ("front", "left")]
    depth = np.full((40, 40), 2.0, np.float32)
    normal = np.full((40, 40, 3), 200, np.uint8)
    views = Views(
        (
            View(cameras[0], flat((255, 0, 0, 255)), depth, normal),
            View(cameras[1], flat((0, 0, 255, 255)), depth, normal),
        )
    )
    sheet = sheet_of_views(views)
    middle = CELL // 2
    assert tuple(sheet[middle, middle]) == (255, 0, 0)
    assert tuple(sheet[middle, CELL + GAP + middle]) == (0, 0, 255)
    assert (sheet[CELL + 18 + GAP + middle, middle] == 200).all()
    assert sheet.shape[1] == 2 * (CELL + GAP)


def test_transparent_is_white_and_shapes_are_kept() -> None:
    assert (color_cell(flat((0, 0, 0, 0))) == 255).all()
    assert color_cell(flat((1, 2, 3, 255), (20, 80))).shape == (CELL // 4, CELL, 3)


def test_objects_make_a_square_page() -> None:
    page = sheet_of_objects([flat((i, i, i, 255)) for i in range(5)])
    assert page.shape[1] == 3 * (CELL + GAP)
    assert page[CELL + GAP + CELL // 2, CELL // 2, 0] == 3
