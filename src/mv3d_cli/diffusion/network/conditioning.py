"""What the network knows beside its noisy latents: the photo, the cameras, and what is asked for.

Poses are `world_from_camera` (OpenCV axes, scene units) in the object's frame, where the photo is the front view.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from mv3d_cli.scene.conventions import RIG_RADIUS

COLOUR, DEPTH = 0, 1
"""Places on the domain axis, and the tasks' names."""

_OCTAVES = 3
_TASK_REPEATS = 16
FEATURES = 12 * 2 * _OCTAVES + 2 * _TASK_REPEATS
"""Numbers that describe one view of one domain: its camera's and its task's."""


@dataclass(frozen=True)
class Condition:
    """Everything that is known of a batch of objects; `drafts`, where the network mends them, of each view."""

    photo_latent: Float[Tensor, "objects channels height width"]
    tokens: Float[Tensor, "objects photo_tokens features"]
    world_from_camera: Float[Tensor, "objects views 4 4"]
    tasks: Int[Tensor, "objects domains"]
    drafts: Float[Tensor, "objects domains views channels height width"] | None = None


def camera_features(world_from_camera: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch features"]:
    """Sines and cosines of a pose's twelve numbers, at quarter, half and whole turns per unit.

    The three axes and the position are told rather than angles: they do not jump, and a camera straight above the
    object has no azimuth.
    """
    axes = world_from_camera[..., :3, :3].flatten(-2)
    position = world_from_camera[..., :3, 3] / RIG_RADIUS
    numbers = torch.cat([axes, position], dim=-1)
    frequencies = math.pi / 2 * 2.0 ** torch.arange(_OCTAVES, device=numbers.device, dtype=numbers.dtype)
    angles = (numbers[..., None] * frequencies).flatten(-2)
    return torch.cat([angles.sin(), angles.cos()], dim=-1)


def task_features(tasks: Int[Tensor, "*batch"]) -> Float[Tensor, "*batch features"]:
    """A task's code, each number told sixteen times: as loud as a camera in the layer that hears both."""
    return functional.one_hot(tasks, 2).float().repeat_interleave(_TASK_REPEATS, dim=-1)


def view_features(condition: Condition) -> Float[Tensor, "objects domains views features"]:
    """The camera's and the task's features of every view."""
    cameras, tasks = camera_features(condition.world_from_camera), task_features(condition.tasks)
    shape = (*tasks.shape[:2], cameras.shape[1])
    return torch.cat([cameras[:, None].expand(*shape, -1), tasks[:, :, None].expand(*shape, -1).to(cameras)], dim=-1)


def with_dropout(condition: Condition, draw: Float[Tensor, " objects"], rate: float = 0.05) -> Condition:
    """The condition with parts of the photo hidden: of `rate` of the objects the tokens, of as many the latent, of as
    many both. `draw`: a number for each object, even over [0, 1).

    Drafts are never hidden: without, what there is to add would be so much more that it drowned all else.
    """
    hide_tokens = (draw < rate) | ((draw >= 2 * rate) & (draw < 3 * rate))
    hide_latent = (draw >= rate) & (draw < 3 * rate)
    return replace(
        condition,
        tokens=_hidden(condition.tokens, hide_tokens),
        photo_latent=_hidden(condition.photo_latent, hide_latent),
    )


def without_photo(condition: Condition) -> Condition:
    """The condition with the photo hidden, but for its drafts: what guidance leads away from."""
    everyone = torch.ones(len(condition.tokens), dtype=torch.bool)
    return replace(
        condition,
        tokens=_hidden(condition.tokens, everyone),
        photo_latent=_hidden(condition.photo_latent, everyone),
    )


def stacked(first: Condition, second: Condition) -> Condition:
    """The objects of the first, then those of the second."""
    return Condition(
        photo_latent=torch.cat([first.photo_latent, second.photo_latent]),
        tokens=torch.cat([first.tokens, second.tokens]),
        world_from_camera=torch.cat([first.world_from_camera, second.world_from_camera]),
        tasks=torch.cat([first.tasks, second.tasks]),
        drafts=_joined(first.drafts, second.drafts),
    )


def _joined(first: Tensor | None, second: Tensor | None) -> Tensor | None:
    return None if first is None or second is None else torch.cat([first, second])


def _hidden(values: Tensor, objects: Tensor) -> Tensor:
    shape = (-1,) + (1,) * (values.ndim - 1)
    return values.masked_fill(objects.to(values.device).view(shape), 0)
