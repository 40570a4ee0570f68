from __future__ import annotations

import math

import pytest
import torch

from mv3d_cli.fields.fitting import losses
from mv3d_cli.fields.fitting.losses import Balance, ranked


def test_depth_error_is_the_distance_to_the_field_s_surface() -> None:
    torch.testing.assert_close(losses.depth_error(torch.tensor([0.2, -0.3])), torch.tensor([0.2, 0.3]))


def test_projective_error_compares_near_the_surface_and_bounds_further_in_front() -> None:
    along = torch.tensor([0.01, -0.01, 0.05, 0.05])
    distance = torch.tensor([0.03, 0.01, 0.03, 0.5])
    expected = torch.tensor([0.02, 0.02, 0.01, 0.0])  # by hand, reach .04
    torch.testing.assert_close(losses.projective_error(distance, along, 0.04), expected)


def test_hull_error_holds_for_the_true_distances_of_a_sphere() -> None:
    """A sphere's distance is never less than that of its shadow, so the loss is zero; a fatter sphere violates it."""
    points = torch.randn(1000, 3, generator=torch.Generator().manual_seed(0))
    shadow = points[:, :2].norm(dim=1) - 0.5
    assert float(losses.hull_error(points.norm(dim=1) - 0.5, shadow).max()) == 0
    fatter = losses.hull_error(points.norm(dim=1) - 0.7, shadow)
    assert float(fatter[shadow <= 0].max()) == 0
    assert float(fatter.max()) > 0
    assert (fatter <= 0.2 + 1e-6).all()


def test_eikonal_error_is_zero_at_length_one() -> None:
    gradient = torch.tensor([[0.6, 0, 0.8], [0, 3, 0], [0, 0, 0]])
    torch.testing.assert_close(losses.eikonal_error(gradient), torch.tensor([0.0, 4.0, 1.0]), atol=1e-5, rtol=0)


def test_normal_error_is_an_angle_weighted_by_facing() -> None:
    normal = torch.tensor([[0.0, 0, 1]]).expand(4, 3)
    gradient = torch.tensor([[0.0, 0, 5], [0, 2, 0], [0, 0, -1], [0, 2, 0]])
    facing = torch.tensor([1.0, 0.5, 1.0, -0.1])
    expected = torch.tensor([0.0, math.exp(0.5), 2 * math.e, 0.0])
    torch.testing.assert_close(losses.normal_error(gradient, normal, facing), expected)


def test_color_error_is_the_mean_over_channels() -> None:
    found = losses.color_error(torch.tensor([[0.1, 0.5, 1.0]]), torch.tensor([[0.4, 0.5, 0.4]]))
    torch.testing.assert_close(found, torch.tensor([0.3]))


def test_mask_error_is_torch_s_binary_cross_entropy() -> None:
    opacity = torch.tensor([0.1, 0.9, 0.5, 0.3])
    inside = torch.tensor([0.0, 1.0, 0.25, 1.0])
    expected = torch.nn.functional.binary_cross_entropy(opacity, inside, reduction="none")
    torch.testing.assert_close(losses.mask_error(opacity, inside), expected)
    assert losses.mask_error(torch.tensor([0.0, 1.0]), torch.tensor([1.0, 0.0])).isfinite().all()


def test_ranked_drops_the_largest_errors() -> None:
    error = torch.tensor([5.0, 1.0, 2.0, 9.0, 3.0], requires_grad=True)
    found = ranked(error, torch.tensor([1.0, 1.0, 3.0, 1.0, 1.0]), 0.4)
    torch.testing.assert_close(found, torch.tensor((1 + 3 * 2 + 3) / 5))
    found.backward()
    assert error.grad is not None
    torch.testing.assert_close(error.grad, torch.tensor([0.0, 0.2, 0.6, 0.0, 0.2]))


@pytest.mark.parametrize("dropped", [0.0, 0.3])
def test_ranked_of_nothing_is_zero(dropped: float) -> None:
    assert float(ranked(torch.zeros(0), torch.zeros(0), dropped)) == 0


def test_balanced_losses_pull_by_their_shares_whatever_their_units() -> None:
    pulls = []
    for unit in (1.0, 1000.0):
        balance = Balance({"a": 1.0, "b": 0.25}, least=1e-3)
        a, b = torch.tensor(2.0, requires_grad=True), torch.tensor(3.0, requires_grad=True)
        balance.total({"a": a, "b": b * unit}).backward()
        pulls.append((float(a.grad) * 2, float(b.grad) * 3))  # type: ignore[arg-type]
    assert pulls[0] == pytest.approx((1.0, 0.25))
    assert pulls[1] == pytest.approx((1.0, 0.25))


def test_satisfied_losses_fall_silent() -> None:
    balance = Balance({"a": 1.0}, least=1e-3)
    assert float(balance.total({"a": torch.tensor(1e-6)})) == pytest.approx(1e-3)


def test_balance_follows_the_losses_and_resumes() -> None:
    one = Balance({"a": 1.0}, least=1e-3, memory=0.5)
    one.total({"a": torch.tensor(4.0)})
    assert float(one.total({"a": torch.tensor(2.0)})) == pytest.approx(2 / 3)
    other = Balance({"a": 1.0}, least=1e-3, memory=0.5)
    other.load_state_dict(one.state_dict())
    assert float(other.total({"a": torch.tensor(1.0)})) == float(one.total({"a": torch.tensor(1.0)}))
