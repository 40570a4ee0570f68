"""Views of a tiny model: what a seed stands for, what one step is, and what becomes of latents that are known."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor, nn

from mv3d_cli.diffusion.generation import Sampling, generated, sampled
from mv3d_cli.diffusion.model import Model
from mv3d_cli.diffusion.network import MultiViewUNet
from mv3d_cli.diffusion.network.conditioning import Condition
from mv3d_cli.diffusion.sampling import initial_noise
from mv3d_cli.errors import UsageError
from mv3d_cli.formats.cameras import load_cameras

VIEWS = 3
SAMPLERS = ["ddim", "dpm", "lcm"]


@pytest.fixture
def photo() -> Tensor:
    return torch.rand(2, 3, 8, 8, generator=torch.Generator().manual_seed(3)) * 2 - 1


@pytest.fixture
def poses() -> Tensor:
    poses = [torch.tensor(camera.world_from_camera, dtype=torch.float32) for camera in load_cameras()[:VIEWS]]
    return torch.stack(poses).expand(2, -1, -1, -1)


class Knowing(MultiViewUNet):
    """In the network's place: answers so that the clean latents are `clean`, whatever the noise; counts its rows."""

    def __init__(self, model: Model, clean: Tensor):
        nn.Module.__init__(self)
        self.schedule, self.clean = model.schedule, clean
        self.weight = nn.Parameter(torch.zeros(()))
        self.rows: list[int] = []
        self.conditions: list[Condition] = []

    def forward(self, noisy: Tensor, timestep: Tensor, condition: Condition, **_: Any) -> Tensor:
        self.rows.append(len(noisy))
        self.conditions.append(condition)
        shape = (-1, *[1] * (noisy.ndim - 1))
        alpha, sigma = (x[timestep].float().view(shape) for x in (self.schedule.alpha, self.schedule.sigma))
        return alpha * (noisy - alpha * self.clean) / sigma - sigma * self.clean


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_a_seed_gives_the_same_views_and_another_others(model: Model, photo: Tensor, poses: Tensor, sampler) -> None:
    one, same, other = (generated(model, photo, poses, Sampling(2, sampler, seed=seed)) for seed in (4, 4, 5))
    for index in (0, 1):
        assert torch.equal(one[index], same[index])
        assert (one[index] - other[index]).abs().mean() > 0.01


@pytest.mark.parametrize("steps", [1, 3])
@pytest.mark.parametrize("sampler", SAMPLERS)
def test_every_step_is_told_and_views_have_their_shapes(model, photo, poses, sampler, steps: int) -> None:
    told = [*sampled(model, photo, poses, Sampling(steps, sampler))]
    assert len(told) == steps
    assert told[0].timestep == 999
    assert all(step.clean.shape == (2, 2, VIEWS, 12, 4, 4) for step in told)
    color, depth = generated(model, photo, poses, Sampling(steps, sampler))
    assert color.shape == (2, VIEWS, 3, 8, 8)
    assert depth.shape == (2, VIEWS, 8, 8)
    assert -1 <= color.min() < color.max() <= 1
    assert 1 <= depth.min() < depth.max() <= 3


@torch.no_grad()
def test_one_step_is_the_networks_own_answer_to_pure_noise(model: Model, photo: Tensor, poses: Tensor) -> None:
    """Nothing but noise is there at the last timestep, and v is then minus the clean latents."""
    (step,) = sampled(model, photo, poses, Sampling(1, seed=7))
    noise = initial_noise((2, 2, VIEWS, 12, 4, 4), 7, photo)
    condition = model.condition(photo, poses, torch.tensor([[0, 1]]).expand(2, -1))
    clean = -model.network(noise, torch.tensor([999, 999]), condition)
    torch.testing.assert_close(step.clean, clean, atol=1e-6, rtol=0)
    pictures = model.autoencoder.decode(clean)
    color, depth = generated(model, photo, poses, Sampling(1, seed=7))
    torch.testing.assert_close(color, pictures[:, 0].clamp(-1, 1), atol=1e-5, rtol=0)
    expected = 1 + (pictures[:, 1].mean(dim=2).clamp(-1, 1) + 1)  # from the sphere's near side to its far side
    torch.testing.assert_close(depth, expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_known_latents_become_their_pictures(model: Model, photo: Tensor, poses: Tensor, sampler) -> None:
    """A ramp of colours, and depths from the near to the far side; what is out of range is clipped."""
    color = torch.linspace(-1.3, 1.3, 2 * VIEWS * 3 * 64).view(2, VIEWS, 3, 8, 8)
    depth = torch.linspace(-1.3, 1.3, 2 * VIEWS * 64).view(2, VIEWS, 1, 8, 8).expand(-1, -1, 3, -1, -1)
    model.network = Knowing(model, model.autoencoder.encode(torch.stack([color, depth], dim=1)))
    made = generated(model, photo, poses, Sampling(2, sampler))
    torch.testing.assert_close(made[0], color.clamp(-1, 1), atol=1e-4, rtol=0)
    torch.testing.assert_close(made[1], depth[:, :, 0].clamp(-1, 1) + 2, atol=1e-4, rtol=0)


def test_what_is_far_stays_far_and_is_not_cut_off(model: Model, photo: Tensor, poses: Tensor) -> None:
    model.network = Knowing(model, torch.full((2, 2, VIEWS, 12, 4, 4), 1.5))
    color, depth = generated(model, photo, poses, Sampling(1))
    assert (color == 1).all()
    assert (depth == 3).all()


@pytest.mark.parametrize(("guidance", "rows"), [(1.0, 2), (2.5, 4)])
def test_guidance_asks_without_the_photo_too(model, photo, poses, guidance: float, rows: int) -> None:
    model.network = Knowing(model, torch.zeros(()))
    generated(model, photo, poses, Sampling(3, guidance=guidance))
    assert model.network.rows == [rows] * 3
    hidden = [bool((c.tokens == 0).all() and (c.photo_latent == 0).all()) for c in halves(model.network.conditions[0])]
    assert hidden == ([True, False] if rows == 4 else [False, False])


def halves(condition: Condition) -> list[Condition]:
    """The first and the second half of the objects."""
    parts = zip(*(value.chunk(2) for value in vars(condition).values() if value is not None), strict=True)
    return [Condition(*part) for part in parts]


def test_guidance_changes_the_views(model: Model, photo: Tensor, poses: Tensor) -> None:
    plain, guided = (generated(model, photo, poses, Sampling(2, guidance=scale)) for scale in (1.0, 3.0))
    assert (plain[0] - guided[0]).abs().max() > 1e-3


def test_nothing_is_learnt_from_sampling(model: Model, photo: Tensor, poses: Tensor) -> None:
    assert not any(step.clean.requires_grad for step in sampled(model, photo, poses, Sampling(2)))


@pytest.mark.parametrize("steps", [0, 1001])
def test_impossible_numbers_of_steps_are_refused_at_once(model, photo, poses, steps: int) -> None:
    with pytest.raises(UsageError, match="not possible"):
        sampled(model, photo, poses, Sampling(steps))
