from __future__ import annotations

import math

import pytest
import torch

from mv3d_cli.fields.fitting.samples import Rays
from mv3d_cli.fields.fitting.volume import (
    SAMPLES,
    WIDTH,
    alpha_from_sdf,
    ends_near_surface,
    first_crossing,
    render,
    rendered_normal,
    span_in_sphere,
    weights_from_alpha,
)
from mv3d_cli.fields.sdf import Field
from mv3d_cli.kernels.hash_grid import Layout

RADIUS = 0.6


def rays(count: int = 200, extent: float = 0.9) -> Rays:
    """Parallel rays along +x from x = -2, at heights within `extent`."""
    across = (2 * torch.rand(count, 2, generator=torch.Generator().manual_seed(0)) - 1) * extent
    origins = torch.cat([torch.full((count, 1), -2.0), across], dim=1)
    return Rays(origins, torch.tensor([[1.0, 0, 0]]).expand(count, 3), torch.ones(count))


def sphere(points: torch.Tensor) -> torch.Tensor:
    return points.norm(dim=-1) - RADIUS


def sphere_field() -> Field:
    axis = torch.linspace(-1.05, 1.05, 97)
    grid = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1)
    layout = Layout(levels=2, features=2, coarsest=8, finest=16, table_size=1 << 10)
    return Field(sphere(grid), torch.full((3,), -1.05), 2.1 / 96, layout=layout)


def test_alpha_is_neus_equation_13() -> None:
    previous, following = torch.tensor([[0.02, -0.01, 0.0]]), torch.tensor([[-0.03, 0.02, -0.05]])
    inside = [torch.sigmoid(values * 50) for values in (previous, following)]
    expected = ((inside[0] - inside[1]) / inside[0]).clamp(0, 1)
    torch.testing.assert_close(alpha_from_sdf(previous, following, 50.0), expected)


def test_alpha_deep_inside_is_that_of_its_limit() -> None:
    """Both sigmoids vanish, and their ratio is exp(sharpness * (f' - f))."""
    found = alpha_from_sdf(torch.tensor([[-1.0]]), torch.tensor([[-1.01]]), 200.0)
    torch.testing.assert_close(found, torch.tensor([[1 - math.exp(-2)]]), atol=1e-4, rtol=0)


def test_a_constant_alpha_lets_through_a_geometric_series() -> None:
    weights = weights_from_alpha(torch.full((1, 8), 0.3))
    torch.testing.assert_close(weights[0], 0.3 * 0.7 ** torch.arange(8))


def test_opacity_telescopes_to_the_ends_of_the_ray() -> None:
    """Where f falls along the ray, NeuS lets through sigmoid(s f_last) / sigmoid(s f_first), however it is divided."""
    distance = torch.linspace(0.1, -0.02, 30)[None]
    opacity = weights_from_alpha(alpha_from_sdf(distance[:, :-1], distance[:, 1:], 60.0)).sum()
    expected = 1 - torch.sigmoid(torch.tensor(-0.02 * 60)) / torch.sigmoid(torch.tensor(0.1 * 60))
    torch.testing.assert_close(opacity, expected)


def test_rays_enter_a_sphere_where_the_closed_form_says() -> None:
    along = rays()
    apart = along.origins[:, 1:].norm(dim=1)
    near, far = span_in_sphere(along, 1.05)
    found = first_crossing(sphere, along, near, far)
    hit = apart < 0.95 * RADIUS
    torch.testing.assert_close(found[hit], 2 - (RADIUS**2 - apart[hit] ** 2).sqrt(), atol=2e-3, rtol=0)
    missed = (apart > RADIUS) & (apart < 1)
    torch.testing.assert_close(found[missed], torch.full_like(found[missed], 2.0), atol=0.03, rtol=0)


def test_span_is_the_sphere_s_chord() -> None:
    along = rays(extent=0.6)
    near, far = span_in_sphere(along, 1.0)
    for end in (near, far):
        torch.testing.assert_close(along.at(end[:, None])[:, 0].norm(dim=1), torch.ones(200))
    assert (near < far).all()


def test_ends_surround_the_crossing_and_follow_the_generator() -> None:
    along = rays()
    near, far = span_in_sphere(along, 1.05)
    ends, again, other = (ends_near_surface(sphere, along, torch.Generator().manual_seed(seed)) for seed in (1, 1, 2))
    assert ends.shape == (200, SAMPLES + 1)
    assert torch.equal(ends, again)
    assert not torch.equal(ends, other)
    apart = ends - first_crossing(sphere, along, near, far)[:, None]
    assert apart.abs().max() <= WIDTH * (1 + 1.001 / SAMPLES)
    assert (ends.diff(dim=1) > 0).all()


@pytest.mark.parametrize("forward", [1.0, 0.8])
def test_a_sphere_is_rendered_as_the_closed_form_says(forward: float) -> None:
    field, along = sphere_field(), rays()
    along = Rays(along.origins, along.directions, torch.full((200,), forward))
    apart = along.origins[:, 1:].norm(dim=1)
    shown = render(field, along, ends_near_surface(field.distance, along, torch.Generator().manual_seed(0)), 400.0)
    hit, missed = apart < 0.8 * RADIUS, apart > 1.05 * RADIUS
    assert shown.opacity[hit].min() > 0.99
    assert shown.opacity[missed].max() < 0.01
    depth = (2 - (RADIUS**2 - apart[hit] ** 2).sqrt()) * forward
    torch.testing.assert_close(shown.depth[hit], depth, atol=4e-3, rtol=0)
    torch.testing.assert_close(shown.color[hit], torch.full((int(hit.sum()), 3), 0.5), atol=0.01, rtol=0)
    normal = torch.nn.functional.normalize(rendered_normal(field, along, shown, 0.02)[hit], dim=1)
    points = along.at((shown.depth / forward)[:, None])[hit, 0]
    assert ((normal * points / points.norm(dim=1, keepdim=True)).sum(1) > 0.99).all()


def test_color_and_mask_move_the_field() -> None:
    field, along = sphere_field(), rays(50)
    ends = ends_near_surface(field.distance, along, torch.Generator().manual_seed(0))
    sharpness = torch.tensor(100.0, requires_grad=True)
    with torch.no_grad():
        field.residual[-1].weight.fill_(0.01)  # a silent last layer has no gradient to hand on
    shown = render(field, along, ends, sharpness)
    (shown.color.sum() + shown.opacity.sum()).backward()
    assert field.tables.grad is not None and field.tables.grad.any()  # noqa: PT018
    assert sharpness.grad is not None
    assert sharpness.grad != 0
