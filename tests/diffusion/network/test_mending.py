"""Mending against the normal distribution it stands for, and against the network that is silent."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from mv3d_cli.diffusion.model import Model
from mv3d_cli.diffusion.network.conditioning import Condition
from mv3d_cli.diffusion.network.mending import TURNS, Mending, between_turns
from mv3d_cli.diffusion.noise import NoiseSettings, schedule_from_settings
from mv3d_cli.formats.cameras import load_cameras

SCHEDULE = schedule_from_settings(NoiseSettings(prediction="sample"))
LAST = len(SCHEDULE.alpha) - 1


RIG = [camera for camera in load_cameras(None) if camera.name in ("front", "right", "back", "front_left")]
POSES = torch.from_numpy(np.stack([camera.world_from_camera for camera in RIG]))
PLACES = [round(4 * angle / 180) for angle in (0, 180, 90, 45)]
"""The turns of front, back, right and front_left, in the rig's order."""
TRUST, DEVIATION = torch.rand((2, 2, TURNS, 4), generator=torch.Generator().manual_seed(9), dtype=torch.float64) + 0.2


@pytest.fixture
def mending() -> Mending:
    """Of four channels, which all are trusted otherwise."""
    made = Mending(SCHEDULE, 4).double()
    made.trust.copy_(TRUST)
    made.deviation.copy_(DEVIATION)
    return made


def condition_for(drafts: torch.Tensor, tasks: Sequence[int] = (0, 1)) -> Condition:
    objects = len(drafts)
    return Condition(
        drafts[:, 0, 0],
        torch.zeros(objects, 1, 1),
        POSES.expand(objects, -1, 4, 4),
        torch.tensor([tasks] * objects),
        drafts,
    )


def pair(objects: int = 3) -> tuple[torch.Tensor, torch.Tensor]:
    """Noisy latents and drafts, of the rig's views."""
    generator = torch.Generator().manual_seed(0)
    noisy, draft = torch.randn((2, objects, 2, len(RIG), 4, 5, 5), generator=generator, dtype=torch.float64)
    return noisy, draft


LOUD = torch.tensor([1.0, 1, 1, 1, 0], dtype=torch.float64)[:, None, None]
"""An answer in every channel, without belief."""


def silence(noisy: torch.Tensor) -> torch.Tensor:
    """No answer, and no belief."""
    return torch.zeros_like(torch.cat([noisy, noisy[:, :, :, :1]], dim=3))


def each_channel() -> Iterator[tuple[int, int, int, float, float]]:
    """(domain, view, channel, trust, deviation)."""
    for domain, (view, turn), channel in product(range(2), enumerate(PLACES), range(4)):
        yield domain, view, channel, TRUST[domain, turn, channel].item(), DEVIATION[domain, turn, channel].item()


def test_silence_is_the_trusted_share_and_answers_count_in_deviations(mending) -> None:
    noisy, draft = pair()
    condition = condition_for(draft)
    silent = mending.clean(silence(noisy), condition)
    loud = mending.clean(silence(noisy) + LOUD, condition) - silent
    for domain, view, channel, trust, deviation in each_channel():
        torch.testing.assert_close(silent[:, domain, view, channel], trust * draft[:, domain, view, channel])
        assert (loud[:, domain, view, channel] - deviation).abs().max() < 1e-9


def test_who_believes_in_the_draft_gets_it(mending) -> None:
    noisy, draft = pair()
    condition = condition_for(draft)
    belief = silence(noisy)
    belief[:, :, :, -1, 1:] = 1  # in all rows but the first
    answer = mending.clean(belief, condition)
    torch.testing.assert_close(answer[..., 1:, :], draft[..., 1:, :])
    torch.testing.assert_close(answer[..., 0, :], mending.clean(silence(noisy), condition)[..., 0, :])


def test_surprise_has_unit_deviation_where_the_prior_holds(mending) -> None:
    generator = torch.Generator().manual_seed(1)
    draft, around, noise = torch.randn((3, 200, 2, 4, 4, 5, 5), generator=generator, dtype=torch.float64)
    trust, deviation = (part[:, PLACES][..., None, None] for part in (TRUST, DEVIATION))
    for timestep in (0, 400, 800, LAST):
        noisy = SCHEDULE.alpha[timestep] * (trust * draft + deviation * around) + SCHEDULE.sigma[timestep] * noise
        seen = mending.surprise(noisy, torch.full((200,), timestep), condition_for(draft))
        assert (seen.std(dim=(0, 4, 5)) - 1).abs().max() < 0.05


def test_one_domain_alone_is_trusted_as_its_task_is(mending) -> None:
    noisy, draft = pair()
    both = mending.surprise(noisy, torch.full((3,), 500), condition_for(draft))
    depth = mending.surprise(noisy[:, 1:], torch.full((3,), 500), condition_for(draft[:, 1:], [1]))
    torch.testing.assert_close(depth, both[:, 1:])


def test_trust_and_deviation_are_fitted() -> None:
    generator = torch.Generator().manual_seed(4)
    drafts, around = torch.randn((2, 60, 2, 4, 4, 8, 8), generator=generator, dtype=torch.float64)
    clean = TRUST[:, PLACES][..., None, None] * drafts + DEVIATION[:, PLACES][..., None, None] * around
    fitted = Mending(SCHEDULE, 4).double()
    fitted.fit(clean, drafts, POSES.expand(60, -1, 4, 4))
    torch.testing.assert_close(fitted.trust[:, PLACES], TRUST[:, PLACES], atol=0.05, rtol=0)
    torch.testing.assert_close(fitted.deviation[:, PLACES], DEVIATION[:, PLACES], atol=0.05, rtol=0)
    assert (fitted.trust[:, 3] == 1).all()  # nobody looked from there


def test_views_between_two_turns_are_told_between_them() -> None:
    for degrees, expected in [(0, [1, 0, 0, 0, 0]), (60, [0, 2 / 3, 1 / 3, 0, 0]), (180, [0, 0, 0, 0, 1])]:
        for around in ("z", "x"):
            pose = torch.eye(4, dtype=torch.float64)
            front = Rotation.from_euler("x", -90, degrees=True)  # looks along +Y
            turned = Rotation.from_euler(around, degrees, degrees=True) * front
            pose[:3, :3] = torch.from_numpy(turned.as_matrix())
            torch.testing.assert_close(between_turns(pose), torch.tensor(expected).double(), atol=1e-6, rtol=0)


@pytest.fixture
def mending_model(smallest) -> Model:
    torch.manual_seed(0)
    return Model(replace(smallest, drafts=True, noise=NoiseSettings(prediction="sample")))


def asked(model: Model, drafts: torch.Tensor | None) -> torch.Tensor:
    """The model's answer from pure noise."""
    generator = torch.Generator().manual_seed(2)
    photo = torch.rand(2, 3, 8, 8, generator=generator) * 2 - 1
    poses = torch.eye(4).expand(2, 3, 4, 4)
    tasks = torch.tensor([[0, 1]]).expand(2, -1)
    condition = model.condition(photo, poses, tasks, drafts)
    noise = torch.randn(2, 2, 3, 12, 4, 4, generator=generator)
    return model.network(noise, torch.full((2,), LAST), condition)


def test_an_untaught_network_answers_with_the_draft_and_learns_from_it(mending_model) -> None:
    drafts = torch.rand(2, 2, 3, 3, 8, 8, generator=torch.Generator().manual_seed(3)) * 2 - 1
    answer = asked(mending_model, drafts)
    torch.testing.assert_close(mending_model.autoencoder.decode(answer), drafts)
    (answer - 1).square().mean().backward()
    assert all(p.grad is not None and p.grad.abs().max() > 0 for p in mending_model.network.unet.conv_out.parameters())


def test_a_taught_network_sees_the_draft_of_each_view(mending_model) -> None:
    torch.nn.init.normal_(mending_model.network.unet.conv_out.weight)
    drafts = torch.zeros(2, 2, 3, 3, 8, 8)
    other = drafts.clone()
    other[0, 1, 2] += 0.5
    change = (asked(mending_model, other) - asked(mending_model, drafts)).abs().flatten(3).amax(dim=3)
    assert change[0, 1, 2] > 0.1
    assert change[0, 1].min() > 0  # the views of an object meet
    assert change[0, 0].max() == 0  # colour and depth not yet
    assert change[1].max() == 0


def test_a_network_that_mends_drafts_predicts_what_is_clean(smallest) -> None:
    with pytest.raises(ValueError, match="predicts what is clean"):
        Model(replace(smallest, drafts=True))
