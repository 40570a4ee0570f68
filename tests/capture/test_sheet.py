"""Contact sheets hold every picture in its place."""

from __future__ import annotations

import numpy as np

from mv3d_cli.capture.sheet import CELL, GAP, color_cell, depth_cell, sheet_of_objects, sheet_of_rows, sheet_of_views
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


def test_rows_of_colours_and_depths_keep_their_places_and_gaps() -> None:
    """Every cell is at its row and column; None is blank; depth is coloured by the range that was told."""
    far, near = np.full((10, 10), 3.0, np.float32), np.full((30, 30), 1.0, np.float32)
    page = sheet_of_rows([[flat((255, 0, 0, 255)), None, flat((0, 0, 255, 255), (20, 80))], [None, near, far]])
    assert page.shape == (2 * (CELL + GAP), 3 * (CELL + GAP), 3)
    cells = [
        [page[y : y + CELL, x : x + CELL] for x in range(0, page.shape[1], CELL + GAP)]
        for y in range(0, page.shape[0], CELL + GAP)
    ]
    assert (cells[0][0] == (255, 0, 0)).all()
    assert (cells[0][1] == 255).all()
    wide = (cells[0][2] == (0, 0, 255)).all(axis=-1)
    assert wide.sum() == CELL * CELL // 4
    assert wide[3 * CELL // 8 : 5 * CELL // 8].all()
    assert (cells[1][0] == 255).all()
    assert np.array_equal(cells[1][1], depth_cell(near, 1.0, 3.0))
    assert np.array_equal(cells[1][2], depth_cell(far, 1.0, 3.0))
    assert (page[CELL : CELL + GAP] == 255).all()
    assert (page[:, CELL : CELL + GAP] == 255).all()


def test_the_depths_of_a_page_share_one_range() -> None:
    """The same depth is the same colour beside any other; another range gives another colour; 0 is blank."""
    middle = np.full((10, 10), 2.0, np.float32)
    one = sheet_of_rows([[middle]])
    beside = sheet_of_rows([[middle, middle * 1.4]])
    assert np.array_equal(one[:CELL, :CELL], beside[:CELL, :CELL])
    assert not np.array_equal(beside[:CELL, :CELL], beside[:CELL, CELL + GAP : -GAP])
    assert not np.array_equal(sheet_of_rows([[middle]], near=1.9, far=2.0), one)
    assert (sheet_of_rows([[middle * 0]]) == 255).all()
