from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from mv3d_cli.diffusion.network.conditioning import (
    COLOUR,
    DEPTH,
    FEATURES,
    Condition,
    camera_features,
    stacked,
    task_features,
    view_features,
    with_dropout,
    without_photo,
)
from mv3d_cli.formats.cameras import load_cameras
from mv3d_cli.scene.camera import Orthographic, direction_on_sphere, look_at_origin


def poses() -> torch.Tensor:
    return torch.stack([torch.tensor(camera.world_from_camera, dtype=torch.float32) for camera in load_cameras(None)])


def drawn(objects: int) -> Condition:
    return Condition(
        torch.randn(objects, 4, 2, 2),
        torch.randn(objects, 3, 5),
        poses()[:2].expand(objects, -1, -1, -1),
        torch.tensor([[COLOUR, DEPTH]]).expand(objects, -1),
    )


def test_cameras_are_told_apart_by_their_features() -> None:
    features = camera_features(poses())
    assert (torch.cdist(features, features) + 10 * torch.eye(12)).min() > 1
    assert features.abs().max() <= 1


def test_a_small_move_is_a_small_change_all_the_way_round() -> None:
    around = [look_at_origin("", direction_on_sphere(a, 0.2), Orthographic()) for a in np.linspace(-np.pi, np.pi, 361)]
    features = camera_features(torch.tensor(np.stack([camera.world_from_camera for camera in around])))
    steps = (features[1:] - features[:-1]).norm(dim=-1)
    assert 0.05 < steps.min() <= steps.max() < 0.5
    torch.testing.assert_close(features[0], features[-1], atol=1e-6, rtol=0)


def test_the_task_is_as_loud_as_the_camera() -> None:
    cameras, tasks = camera_features(poses()), task_features(torch.tensor([COLOUR, DEPTH]))
    between_tasks = (tasks[0] - tasks[1]).norm()
    assert 0.5 < between_tasks / torch.cdist(cameras, cameras).mean() < 2


def test_every_view_of_every_domain_gets_its_own_features() -> None:
    features = view_features(drawn(2))
    assert features.shape == (2, 2, 2, FEATURES)
    assert len(torch.unique(features[0].flatten(0, 1), dim=0)) == 4
    torch.testing.assert_close(features[0], features[1])


def test_dropout_hides_tokens_latent_and_both_equally_often() -> None:
    condition = drawn(20_000)
    dropped = with_dropout(condition, torch.rand(20_000, generator=torch.Generator().manual_seed(0)), rate=0.05)
    no_tokens, no_latent = (dropped.tokens == 0).all((1, 2)), (dropped.photo_latent == 0).all((1, 2, 3))
    for hidden in (no_tokens & ~no_latent, no_latent & ~no_tokens, no_tokens & no_latent):
        assert abs(hidden.float().mean() - 0.05) < 0.006
    torch.testing.assert_close(dropped.tokens[~no_tokens], condition.tokens[~no_tokens])
    torch.testing.assert_close(dropped.photo_latent[~no_latent], condition.photo_latent[~no_latent])


def test_without_photo_keeps_cameras_and_tasks() -> None:
    condition = drawn(2)
    both = stacked(without_photo(condition), condition)
    assert both.tokens[:2].abs().max() == both.photo_latent[:2].abs().max() == 0
    torch.testing.assert_close(both.tokens[2:], condition.tokens)
    torch.testing.assert_close(view_features(both)[:2], view_features(condition))


def test_drafts_are_never_hidden() -> None:
    condition = replace(drawn(8), drafts=torch.ones(8, 2, 2, 4, 2, 2))
    for hidden in (with_dropout(condition, torch.zeros(8), rate=0.3), without_photo(condition)):
        assert hidden.tokens.abs().max() == 0
        assert hidden.drafts is condition.drafts
    both = stacked(without_photo(condition), condition)
    assert both.drafts is not None
    assert both.drafts.shape == (16, 2, 2, 4, 2, 2)
