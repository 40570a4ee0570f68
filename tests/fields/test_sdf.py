from __future__ import annotations

import numpy as np
import pytest
import torch

from mv3d_cli.fields.fusion import Fusion
from mv3d_cli.fields.sdf import Field, continued, field_from, field_of
from mv3d_cli.kernels.hash_grid import Layout

SMALL = Layout(levels=4, features=2, coarsest=8, finest=32, table_size=1 << 10)
RADIUS = 0.6


def grid_of(resolution: int = 64) -> tuple[np.ndarray, tuple[float, float, float], float]:
    """Distances to a sphere at nodes of [-1, 1]^3."""
    axis = np.linspace(-1, 1, resolution, dtype=np.float32)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    return np.sqrt(x**2 + y**2 + z**2) - np.float32(RADIUS), (-1.0, -1.0, -1.0), 2 / (resolution - 1)


def sphere(seed: int = 0, layout: Layout = SMALL) -> Field:
    distance, origin, voxel = grid_of()
    return Field(torch.from_numpy(distance), torch.tensor(origin), voxel, layout=layout, seed=seed)


def points(count: int = 500, extent: float = 0.9) -> torch.Tensor:
    return (2 * torch.rand(count, 3, generator=torch.Generator().manual_seed(1)) - 1) * extent


def shaken(field: Field) -> Field:
    """A field as training leaves it: none of its parts is silent."""
    generator = torch.Generator().manual_seed(2)
    with torch.no_grad():
        for parameter in field.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape, generator=generator))
    return field


def test_field_starts_as_its_base() -> None:
    at = points()
    field = sphere()
    assert torch.equal(field.distance(at), field.base_distance(at))
    off = at.norm(dim=1) > 0.1  # where a sphere is round, trilinear lookup is near
    torch.testing.assert_close(field.distance(at)[off], at[off].norm(dim=1) - RADIUS, atol=3e-3, rtol=0)
    torch.testing.assert_close(field.color(at), torch.full((500, 3), 0.5))


def test_base_is_exact_at_its_nodes_whatever_the_shape_of_the_grid() -> None:
    base = torch.rand(5, 7, 9, generator=torch.Generator().manual_seed(3))
    field = Field(base, torch.tensor([0.1, -0.2, 0.3]), 0.25, layout=SMALL)
    nodes = torch.cartesian_prod(*(torch.arange(n) for n in base.shape))
    torch.testing.assert_close(field.base_distance(field.origin + 0.25 * nodes), base.flatten(), atol=1e-5, rtol=0)


def test_gradient_is_that_of_a_sphere() -> None:
    at = points()
    at = at[at.norm(dim=1) > 0.2]
    gradient = sphere().gradient(at, 0.01)
    torch.testing.assert_close(gradient, at / at.norm(dim=1, keepdim=True), atol=0.05, rtol=0)


def test_gradient_is_the_finite_difference_of_the_distance() -> None:
    field, at, step = shaken(sphere()), points(50), 0.05
    corners = torch.tensor([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    values = torch.stack([field.distance(at + step * corner) for corner in corners])
    expected = sum(corner * value[:, None] for corner, value in zip(corners, values, strict=True)) / (4 * step)
    torch.testing.assert_close(field.gradient(at, step), expected)


def test_distance_and_color_are_those_asked_for_one_by_one() -> None:
    field, at = shaken(sphere()), points()
    distance, color = field.distance_and_color(at)
    assert torch.equal(distance, field.distance(at))
    assert torch.equal(color, field.color(at))
    assert (distance - field.base_distance(at)).abs().max() > 1e-3
    assert 0 <= color.min().item() < color.max().item() <= 1


def test_inactive_levels_do_not_count() -> None:
    field, at = shaken(sphere()), points()
    field.active.fill_(2)
    before = field.distance(at)
    with torch.no_grad():
        field.tables[SMALL.offsets[2] :] += 1
    assert torch.equal(field.distance(at), before)
    field.active.fill_(3)
    assert not torch.equal(field.distance(at), before)


def test_every_parameter_learns() -> None:
    field, at = shaken(sphere()), points()
    distance, color = field.distance_and_color(at)
    (distance.sum() + color.sum()).backward()
    assert all(parameter.grad is not None and parameter.grad.any() for parameter in field.parameters())


def test_state_holds_all_of_the_field() -> None:
    from safetensors.torch import load, save

    field, at = shaken(sphere()), points()
    field.active.fill_(3)
    again = field_from(load(save(field.state_dict())), layout=SMALL)
    assert torch.equal(again.distance(at), field.distance(at))
    assert torch.equal(again.color(at), field.color(at))


def test_seed_decides_the_start() -> None:
    assert torch.equal(sphere(seed=1).tables, sphere(seed=1).tables)
    assert not torch.equal(sphere(seed=1).tables, sphere(seed=2).tables)


def test_clamped_distances_are_continued() -> None:
    distance, origin, voxel = grid_of()
    reach = 2 * voxel
    fusion = Fusion(distance.clip(-reach, reach), origin, voxel, reach)
    base = field_of(fusion).base.numpy()
    near = np.abs(distance) < 0.9 * reach
    np.testing.assert_array_equal(base[near], distance[near])
    assert (np.sign(base) == np.sign(distance)).all()
    about = distance < 12 * voxel
    assert np.abs(base - distance)[about].max() < 1.5 * voxel
    assert np.abs(base[~near]).min() >= 0.9 * reach


def test_a_plate_thinner_than_two_voxels_keeps_its_place() -> None:
    voxel, reach = 0.1, 0.15
    z = np.broadcast_to(voxel * np.arange(30, dtype=np.float32) - 1.5, (30, 30, 30))
    clamped = (np.abs(z) - np.float32(0.06)).clip(-reach, reach).astype(np.float32)
    grown = continued(clamped, voxel, reach)
    about = np.abs(z) < 12 * voxel
    np.testing.assert_allclose(grown[about], np.abs(z[about]) - 0.06, atol=1.1 * voxel)
    near = np.abs(clamped) < 0.9 * reach
    np.testing.assert_array_equal(grown[near], clamped[near])


@pytest.mark.parametrize("value", [-0.1, 0.1])
def test_a_grid_without_a_surface_stays_as_it_is(value: float) -> None:
    grid = np.full((4, 4, 4), value, np.float32)
    np.testing.assert_array_equal(continued(grid, 0.1, 0.1), grid)
