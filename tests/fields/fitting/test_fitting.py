from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
import pytest
import torch

from mv3d_cli.fields.fitting import Config, Fit, fit
from mv3d_cli.fields.fusion import fuse
from mv3d_cli.fields.relief import Relief, reliefs_of
from mv3d_cli.fields.sdf import Field
from mv3d_cli.formats.cameras import load_cameras, select
from mv3d_cli.kernels.hash_grid import Layout
from mv3d_cli.scene.camera import pixel_from_camera
from mv3d_cli.scene.rig import HORIZONTAL
from mv3d_cli.scene.views import View, Views

RADIUS, SIZE = 0.6, 64
QUICK = Config(steps=60, rate=5e-3, surface=1024, space=1024, silhouette=512, normals=256, rays=256)
LAYOUT = Layout(levels=4, features=2, coarsest=8, finest=32, table_size=1 << 12)


def reliefs(*, depth: bool = True) -> tuple[Relief, ...]:
    """Eight parallel views of a red sphere."""
    views = []
    for camera in select(load_cameras(), HORIZONTAL):
        (sx, ox), (sy, oy) = pixel_from_camera(camera, SIZE, SIZE)
        x, y = np.meshgrid((np.arange(SIZE) + 0.5 - ox) / sx, (np.arange(SIZE) + 0.5 - oy) / sy)
        inside = np.hypot(x, y) < RADIUS
        z = np.where(inside, 2 - np.sqrt(np.maximum(RADIUS**2 - x**2 - y**2, 0)), 0).astype(np.float32)
        color = np.where(inside[..., None], np.array([255, 0, 0, 255]), 0).astype(np.uint8)
        views.append(View(camera, color, z if depth else None))
    return reliefs_of(Views(tuple(views)))


def field(*, radius: float = RADIUS, seed: int = 0) -> Field:
    axis = torch.linspace(-1.05, 1.05, 65)
    grid = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1)
    return Field(grid.norm(dim=-1) - radius, torch.full((3,), -1.05), 2.1 / 64, layout=LAYOUT, seed=seed)


def error(fitted: Field) -> float:
    """Mean |distance| of the field on the true sphere, where the views see it."""
    directions = torch.nn.functional.normalize(torch.randn(2000, 3, generator=torch.Generator().manual_seed(9)), dim=1)
    with torch.no_grad():
        return float(fitted.distance(RADIUS * directions[directions[:, 2].abs() < 0.7]).abs().mean())


def run(fitted: Field, views: Sequence[Relief], config: Config = QUICK) -> list[dict[str, float]]:
    return [progress.losses for progress in fit(fitted, views, config)]


def test_a_wrong_start_is_pulled_to_what_the_views_saw() -> None:
    fitted = field(radius=RADIUS - 0.02)
    assert error(fitted) == pytest.approx(0.02, abs=1e-3)
    found = run(fitted, reliefs())
    assert error(fitted) < 0.005
    assert found[-1]["depth"] < 0.3 * found[0]["depth"]


def test_a_right_start_stays_right() -> None:
    fitted = field()
    before = error(fitted)
    run(fitted, reliefs())
    assert error(fitted) < before + 1e-3


def test_views_without_depth_pull_by_their_silhouettes_and_colors() -> None:
    fitted = field(radius=RADIUS - 0.03)
    config = Config(steps=120, rate=5e-3, rays=512)
    found = run(fitted, reliefs(depth=False), config)
    assert set(found[0]) == {"color", "mask"}
    assert error(fitted) < 0.02
    with torch.no_grad():
        color = fitted.color(torch.tensor([[0.0, -RADIUS, 0.0]]))[0]
    assert color[0] > 0.8
    assert color[1:].max() < 0.2


def test_progress_counts_the_steps_and_names_the_losses() -> None:
    seen = list(fit(field(), reliefs(), Config(steps=3, surface=64, space=64, silhouette=64, normals=16)))
    assert [(progress.step, progress.steps) for progress in seen] == [(1, 3), (2, 3), (3, 3)]
    assert set(seen[0].losses) == {"depth", "projective", "hull", "eikonal", "normal"}


@pytest.mark.parametrize("depth", [True, False])
def test_a_fit_that_was_killed_and_resumed_has_the_bits_of_one_that_ran_through(depth: bool) -> None:
    views, config = reliefs(depth=depth), Config(steps=12, surface=256, space=256, silhouette=128, normals=64, rays=64)
    through = field()
    assert len(run(through, views, config)) == 12

    first = Fit(field(), views, config)
    steps = first.run()
    for _ in range(5):
        next(steps)
    written = io.BytesIO()
    torch.save(first.state_dict(), written)
    written.seek(0)
    resumed = Fit(field(seed=7), views, config)
    resumed.load_state_dict(torch.load(written, weights_only=True))
    rest = list(resumed.run())
    assert rest[0].step == 6
    assert rest[-1].step == 12
    for name, value in through.state_dict().items():
        assert torch.equal(value, resumed.field.state_dict()[name]), name


def test_levels_of_the_hash_grid_wait_their_turn() -> None:
    fitted = field()
    config = Config(steps=8, levels=1, surface=64, space=64, silhouette=64, normals=16)
    active = [int(fitted.active) for _ in fit(fitted, reliefs(), config)]
    assert active == sorted(active)
    assert active[0] == 1
    assert active[4:] == [LAYOUT.levels] * 4


def test_a_fused_sphere_is_fitted_from_its_fusion() -> None:
    from mv3d_cli.fields.sdf import field_of

    views = reliefs()
    fitted = field_of(fuse(views, 64))
    before = error(fitted)
    run(fitted, views)
    assert error(fitted) < max(1.05 * before, 2e-3)
