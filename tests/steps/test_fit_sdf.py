"""Fits on disk, what is made of them, and what they say of themselves."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mv3d_cli.capture.rendering import render
from mv3d_cli.errors import BadViews, DamagedArtifact, MissingInput, UsageError
from mv3d_cli.fields.alignment import Alignment
from mv3d_cli.fields.alignment.warps import Warp, still
from mv3d_cli.formats.cameras import load_cameras, select
from mv3d_cli.meshes.repair import watertight
from mv3d_cli.meshes.surface import mesh_of as bare_mesh
from mv3d_cli.scene.mesh import Mesh, transform
from mv3d_cli.scene.rig import HORIZONTAL
from mv3d_cli.scene.views import Views
from mv3d_cli.steps.fit_sdf import Config
from mv3d_cli.steps.fit_sdf.building import fitted
from mv3d_cli.steps.fit_sdf.checking import self_check, turntable, warnings_of
from mv3d_cli.steps.sdf_fit import FIELD, Fit, MeshSettings, mesh_of, read_fit, write_fit
from mv3d_cli.steps.settings import Progress, silent
from mv3d_cli.steps.views_input import check_fittable

RIG = select(load_cameras(), HORIZONTAL)
SMALL = MeshSettings(faces=1500, texture=64)


@pytest.fixture(scope="module")
def box() -> Mesh:
    """A box of 1.2 x 0.8 x 0.6, each corner of another colour."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32)
    faces = np.array([
        [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
        [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
    ], np.int32)  # fmt: skip
    mesh = bare_mesh(corners * np.float32([0.6, 0.4, 0.3]), faces)
    return replace(mesh, colors=np.c_[(corners + 1) / 2, np.ones(8)].astype(np.float32))


@pytest.fixture(scope="module")
def views(box: Mesh) -> Views:
    return render(box, RIG, 96, None)


@pytest.fixture(scope="module")
def fit(views: Views, tmp_path_factory: pytest.TempPathFactory) -> Fit:
    return fitted(Config(steps=15, resolution=64), views, silent, tmp_path_factory.mktemp("work"))


def extents(mesh: Mesh) -> np.ndarray:
    return mesh.vertices.max(0) - mesh.vertices.min(0)


def test_a_box_is_its_size_and_has_its_colours(fit: Fit, views: Views) -> None:
    mesh = mesh_of(fit, SMALL)
    assert watertight(mesh)
    assert extents(mesh) == pytest.approx([1.2, 0.8, 0.6], abs=0.04)
    report = self_check(fit, mesh)
    assert report["mask_iou"] > 0.94
    assert report["psnr"] > 22
    assert report["components"] == 1
    assert warnings_of(report) == []
    colored = mesh_of(fit, replace(SMALL, vertex_colors=True))
    assert colored.colors is not None
    assert colored.materials[0].texture is None
    upper = colored.vertices[:, 2] > 0.2
    assert colored.colors[upper, 2].mean() > colored.colors[~upper, 2].mean() + 0.3


def test_a_fit_survives_the_disk(fit: Fit, tmp_path: Path) -> None:
    write_fit(tmp_path, fit)
    again = read_fit(tmp_path)
    one, other = mesh_of(fit, SMALL), mesh_of(again, SMALL)
    assert np.array_equal(one.vertices, other.vertices)
    assert np.array_equal(one.materials[0].texture.pixels, other.materials[0].texture.pixels)


def test_another_resolution_is_the_same_shape(fit: Fit) -> None:
    for each in (fit, replace(fit, residual=None)):
        fine = mesh_of(each, replace(SMALL, texture=0, resolution=96))
        assert extents(fine) == pytest.approx([1.2, 0.8, 0.6], abs=0.03)
        assert watertight(fine)


def test_damaged_and_missing_fits_are_told(fit: Fit, tmp_path: Path) -> None:
    with pytest.raises(MissingInput):
        read_fit(tmp_path)
    write_fit(tmp_path, fit)
    whole = (tmp_path / FIELD).read_bytes()
    (tmp_path / FIELD).write_bytes(whole[: len(whole) // 2])
    with pytest.raises(DamagedArtifact):
        read_fit(tmp_path)
    assert fit.residual is not None
    bent = {name: value[..., :1] if value.ndim else value for name, value in fit.residual.items()}
    with pytest.raises(DamagedArtifact):
        mesh_of(replace(fit, residual=bent), SMALL)


def test_a_scene_elsewhere_comes_back_to_its_place(box: Mesh, tmp_path: Path) -> None:
    """Cameras and object moved and scaled together: the mesh lies where the object lay."""
    from mv3d_cli.capture.framing import moved_camera

    move = np.diag([7.0, 7.0, 7.0, 1.0])
    move[:3, 3] = 20, -30, 5
    seen = render(box, RIG, 96, None)
    far = Views(
        tuple(
            replace(view, camera=moved_camera(view.camera, move), depth=view.depth * np.float32(7))
            for view in seen.frames
        )
    )
    made = mesh_of(fitted(Config(steps=0, resolution=64), far, silent, tmp_path), SMALL)
    true = transform(box, move)
    assert extents(made) == pytest.approx(extents(true), abs=0.3)
    middle = (made.vertices.max(0) + made.vertices.min(0)) / 2
    assert middle == pytest.approx([20, -30, 5], abs=0.2)


def test_views_without_depth_are_fitted(views: Views, tmp_path: Path) -> None:
    blind = Views(tuple(replace(view, depth=None, normal=None) for view in views.frames))
    fit = fitted(Config(steps=5, resolution=64), blind, silent, tmp_path)
    assert all(view.depth is not None for view in fit.views.frames)
    mesh = mesh_of(fit, SMALL)
    assert watertight(mesh)
    assert extents(mesh)[:2] == pytest.approx([1.2, 0.8], abs=0.08)


def test_progress_carries_losses_and_time_runs_out(views: Views, tmp_path: Path) -> None:
    told: list[Progress] = []
    fitted(Config(steps=400, resolution=64, max_time=0.5), views, told.append, tmp_path)
    assert 0 < len(told) < 400
    assert "depth" in told[-1].note
    assert told[-1].total == 400


def test_contradiction_and_poor_outlines_are_told(fit: Fit) -> None:
    mesh = mesh_of(fit, replace(SMALL, texture=0))
    report = self_check(fit, mesh)
    assert warnings_of(report | {"disagreement_after": 0.05})[0].startswith("the views contradict")
    thin = transform(mesh, np.diag([1.0, 0.2, 0.2, 1.0]))
    assert any("silhouette" in line for line in warnings_of(self_check(fit, thin)))
    opened = replace(mesh, faces=mesh.faces[:-1], face_material=mesh.face_material[:-1])
    assert "the mesh is not watertight" in warnings_of(self_check(fit, opened))


def test_the_turntable_shows_eight_sides(fit: Fit) -> None:
    sheet = turntable(mesh_of(fit, SMALL), fit)
    cells = np.array_split(sheet[:190], 8, axis=1)
    assert all((cell < 250).any(-1).mean() > 0.02 for cell in cells)
    assert not np.array_equal(cells[0], cells[1])


def test_warps_move_where_colours_are_looked_up(views: Views) -> None:
    """A view shifted by three pixels, and a warp that says so: colours are as without both."""
    offsets = np.zeros((9, 9, 3))
    offsets[..., 0] = -3.0
    shifted = replace(views.frames[0], color=np.roll(views.frames[0].color, 3, axis=1))
    moved = Views((shifted, *views.frames[1:]))
    warps = (Warp(offsets), *[still() for _ in views.frames[1:]])
    plain = Alignment(tuple(still() for _ in views.frames), 0.0, 0.0)
    straight = mesh_of(Fit(views, np.eye(4), plain, 64), replace(SMALL, vertex_colors=True))
    bent = Fit(moved, np.eye(4), Alignment(warps, 0.0, 0.0), 64)
    from mv3d_cli.meshes.bake import vertex_colors
    from mv3d_cli.steps.sdf_fit import shots_of

    corrected = vertex_colors(replace(straight, colors=None), shots_of(bent))
    ignored = vertex_colors(replace(straight, colors=None), shots_of(replace(bent, alignment=plain)))
    error = [np.abs(one.colors - straight.colors).mean() for one in (corrected, ignored)]
    assert error[0] < 0.5 * error[1]


@pytest.mark.parametrize("steps", [0, 10])
def test_the_residual_is_optional(views: Views, tmp_path: Path, steps: int) -> None:
    fit = fitted(Config(steps=steps, resolution=48), views, silent, tmp_path)
    assert (fit.residual is None) == (steps == 0)
    if fit.residual is not None:
        assert all(torch.isfinite(value).all() for value in fit.residual.values())


def test_views_that_cannot_be_fitted_are_told(views: Views) -> None:
    check_fittable(views)
    with pytest.raises(BadViews, match="only one view"):
        check_fittable(Views(views.frames[:1]))
    opaque = [replace(view, color=view.color | np.uint8([0, 0, 0, 255])) for view in views.frames]
    with pytest.raises(BadViews, match="neither depth nor a mask"):
        check_fittable(Views(tuple(replace(view, depth=None) for view in opaque)))
    full = np.full((96, 96), 2.0, np.float32)
    with pytest.raises(BadViews, match="every picture"):
        check_fittable(Views(tuple(replace(view, depth=full) for view in opaque)))
    with pytest.raises(BadViews, match="same everywhere"):
        check_fittable(Views(tuple(replace(view, depth=full) for view in views.frames)))
    empty = replace(views.frames[0], color=np.zeros_like(views.frames[0].color))
    with pytest.raises(BadViews, match="nowhere to be seen in front"):
        check_fittable(Views((empty, *views.frames[1:])))


def test_weights_name_views_and_are_numbers(views: Views) -> None:
    from mv3d_cli.steps.fit_sdf.building import _weighted

    weighted = _weighted(views, ("front=3", "back=0"))
    assert [view.weight for view in weighted.frames] == [3.0, *[1.0] * 6]
    for bad in ("front", "front=x", "front=-1", "front=inf", "nobody=1"):
        with pytest.raises(UsageError):
            _weighted(views, (bad,))
