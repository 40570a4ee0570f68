"""The hash grid against its torch twin, finite differences, and functions that it must reproduce."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from mv3d_cli.kernels import runtime
from mv3d_cli.kernels.hash_grid import Layout, encode, reference

MIXED = Layout(levels=5, features=2, coarsest=3, finest=40, table_size=2**9)  # two dense levels, three hashed
DENSE = Layout(levels=1, features=4, coarsest=7, finest=7, table_size=2**9)


def uniform(*shape: int, seed: int = 0, low: float = 0.0, high: float = 1.0) -> Tensor:
    return torch.empty(shape).uniform_(low, high, generator=torch.Generator().manual_seed(seed))


def tables_of(layout: Layout, seed: int = 1) -> Tensor:
    return uniform(layout.entries, layout.features, seed=seed, low=-1)


def on_borders() -> Tensor:
    """Corners of the cube and of cells, points on faces, and points far outside."""
    axis = torch.tensor([-3.0, -1e-7, 0.0, 1 / 3, 0.5, 1 - 1e-7, 1.0, 1 + 1e-6, 7.0])
    return torch.cartesian_prod(axis, axis, axis)


def both(function, points: Tensor, tables: Tensor, layout: Layout, levels: int | None) -> tuple[Tensor, ...]:
    """Features, and the gradients of a weighted sum of them in points and tables."""
    points, tables = points.clone().requires_grad_(), tables.clone().requires_grad_()
    features = function(points, tables, layout, levels=levels)
    weights = uniform(*features.shape, seed=2, low=-1).to(features.device)
    return features.detach(), *torch.autograd.grad((features * weights).sum(), [points, tables])


def assert_same(ours: tuple[Tensor, ...], twin: tuple[Tensor, ...], layout: Layout) -> None:
    for name, mine, theirs, scale in zip(
        ("values", "points", "tables"), ours, twin, (1, layout.finest, 1), strict=True
    ):
        assert theirs.abs().max() > 0.1, name
        assert torch.allclose(mine.cpu(), theirs.cpu(), rtol=1e-4, atol=2e-5 * scale), name


@pytest.mark.parametrize("features", [1, 2, 4])
@pytest.mark.parametrize("levels", [1, 3, None])
def test_equals_the_torch_twin(features: int, levels: int | None) -> None:
    layout = Layout(MIXED.levels, features, MIXED.coarsest, MIXED.finest, MIXED.table_size)
    given_ = (torch.cat([uniform(5000, 3, low=-0.2, high=1.2), on_borders()]), tables_of(layout), layout, levels)
    assert_same(both(encode, *given_), both(reference.encode, *given_), layout)


@settings(deadline=None, max_examples=25)
@given(
    levels=st.integers(1, 8),
    features=st.sampled_from([1, 2, 4]),
    coarsest=st.integers(1, 20),
    growth=st.integers(0, 300),
    power=st.integers(1, 14),
    count=st.integers(1, 300),
)
def test_any_layout(levels: int, features: int, coarsest: int, growth: int, power: int, count: int) -> None:
    layout = Layout(levels, features, coarsest, coarsest + growth, 2**power)
    assert layout.resolutions[0] == coarsest
    assert levels == 1 or layout.resolutions[-1] == coarsest + growth
    assert sorted(layout.resolutions) == list(layout.resolutions)
    ends = [first + size for first, size in zip(layout.offsets, layout.sizes, strict=True)]
    assert [0, *ends] == [*layout.offsets, layout.entries]
    for level, (cells, size) in enumerate(zip(layout.resolutions, layout.sizes, strict=True)):
        assert size == (2**power if layout.is_hashed(level) else (cells + 1) ** 3) <= 2**power
    given_ = (uniform(count, 3, seed=count), tables_of(layout), layout)
    assert torch.allclose(encode(*given_), reference.encode(*given_), atol=1e-4)


@pytest.mark.parametrize(
    "change", [{"levels": 0}, {"features": 3}, {"coarsest": 0}, {"finest": 2}, {"table_size": 48}, {"table_size": 1}]
)
def test_impossible_layouts_are_refused(change: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="Layout"):
        Layout(**{"levels": 5, "features": 2, "coarsest": 3, "finest": 40, "table_size": 512, **change})


def test_arguments_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="tables of shape"):
        encode(uniform(4, 3), tables_of(MIXED)[1:], MIXED)
    with pytest.raises(ValueError, match="active levels"):
        encode(uniform(4, 3), tables_of(MIXED), MIXED, levels=6)


def test_a_dense_level_reproduces_linear_functions() -> None:
    """Corners that hold their own coordinates give back the point, clamped, with unit gradient inside."""
    axis = torch.linspace(0, 1, 8)
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    tables = torch.stack([x, y, z, 1 + x - 2 * y], dim=-1).reshape(-1, 4)
    points = torch.cat([uniform(2000, 3), on_borders()]).requires_grad_()
    features = encode(points, tables, DENSE)
    inside = points.detach().clamp(0, 1)
    assert torch.allclose(features[:, :3], inside, atol=1e-6)
    assert torch.allclose(features[:, 3], 1 + inside[:, 0] - 2 * inside[:, 1], atol=1e-6)
    (gradient,) = torch.autograd.grad(features[:, 3].sum(), points)
    within = (points >= 0) & (points <= 1)
    assert torch.allclose(gradient, within * torch.tensor([1.0, -2.0, 0.0]), atol=1e-5)


def test_hashed_corners_spread_over_the_table() -> None:
    """As many corners as entries, drawn at random, leave about 1 / e of the entries alone; each corner gives 1."""
    layout = Layout(1, 1, 255, 255, 2**15)
    corners = torch.randint(0, 256, (2**15, 3), generator=torch.Generator().manual_seed(0)) / 255
    tables = torch.zeros(layout.entries, 1, requires_grad=True)
    encode(corners, tables, layout).sum().backward()
    assert tables.grad is not None
    assert tables.grad.sum().item() == pytest.approx(len(corners), rel=1e-4)
    assert (tables.grad < 0.5).float().mean().item() == pytest.approx(0.368, abs=0.02)


def test_gradients_are_finite_differences() -> None:
    step, points, tables = 1e-3, uniform(4000, 3), tables_of(MIXED)
    weights = uniform(4000, MIXED.levels * MIXED.features, seed=2, low=-1)
    shares = torch.stack([(points * cells).frac() for cells in MIXED.resolutions])
    inside = ((shares - 0.5).abs().amax((0, 2)) < 0.5 - step * MIXED.finest) & (points.max(-1).values < 1 - step)
    assert inside.sum() > 500
    _, to_points, to_tables = both(encode, points, tables, MIXED, None)
    for axis in range(3):
        move = step * torch.eye(3)[axis]
        ahead, behind = (encode(points + sign * move, tables, MIXED) for sign in (1, -1))
        slope = ((ahead - behind) * weights).sum(-1) / (2 * step)
        assert torch.allclose(slope[inside], to_points[inside, axis], atol=0.03, rtol=2e-3)
    change = tables_of(MIXED, seed=5)
    difference = ((encode(points, tables + change, MIXED) - encode(points, tables, MIXED)) * weights).double().sum()
    assert difference.item() == pytest.approx((to_tables * change).double().sum().item(), rel=1e-3)


def test_inactive_levels_are_zero_and_stay_untouched() -> None:
    features, _, to_tables = both(encode, uniform(500, 3), tables_of(MIXED), MIXED, 2)
    assert (features[:, :4] != 0).float().mean() > 0.99
    assert (features[:, 4:] == 0).all()
    assert to_tables[: MIXED.offsets[2]].abs().sum() > 1
    assert (to_tables[MIXED.offsets[2] :] == 0).all()
    assert (encode(uniform(5, 3), tables_of(MIXED), MIXED, levels=0) == 0).all()


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_same_bits_on_any_number_of_threads(threads: int) -> None:
    given_ = (encode, uniform(20_001, 3), tables_of(MIXED), MIXED, None)
    first = both(*given_)
    runtime.use_threads(threads)
    try:
        again = both(*given_)
    finally:
        runtime.use_threads(0)
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))


def test_odd_inputs() -> None:
    """No points, points that are no number, views that are not contiguous, and gradients asked of one side only."""
    tables = tables_of(MIXED)
    assert encode(torch.zeros(0, 3), tables, MIXED).shape == (0, 10)
    assert encode(torch.full((3, 3), torch.nan), tables, MIXED).shape == (3, 10)
    points = uniform(3, 100).T
    assert torch.equal(encode(points, tables, MIXED), encode(points.contiguous(), tables, MIXED))
    assert not encode(points, tables, MIXED).requires_grad
    asked = points.clone().requires_grad_()
    encode(asked, tables, MIXED).sum().backward()  # the gradient of a sum is expanded, not contiguous
    assert asked.grad is not None
    assert asked.grad.abs().max() > 1


@pytest.mark.cuda
def test_cuda_equals_the_twin() -> None:
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    for levels in (None, 2):
        given_ = (torch.cat([uniform(50_000, 3), on_borders()]).cuda(), tables_of(MIXED).cuda(), MIXED, levels)
        assert_same(both(encode, *given_), both(reference.encode, *given_), MIXED)
