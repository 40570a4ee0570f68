"""Training samples: what the views saw, as points in space, and how far points lie outside the silhouettes.

Reliefs are where they belong (aligned). World axes, scene units; samples lie side by side, all on one device.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from mv3d_cli.fields.relief import Relief
from mv3d_cli.scene.camera import Perspective, pixel_from_camera

STEEPEST = 0.1  # cosine: what a view sees at a more grazing angle does not count
BORDER = 8.0  # pixels around a silhouette whose rays are rendered too


@dataclass(frozen=True)
class Cameras:
    """Cameras side by side: `rotation` world_from_camera and `place`; `scale` and `offset` of pixels (x, y)."""

    rotation: Float[Tensor, "views 3 3"]
    place: Float[Tensor, "views 3"]
    scale: Float[Tensor, "views 2"]
    offset: Float[Tensor, "views 2"]
    pinhole: Bool[Tensor, "views"]


@dataclass(frozen=True)
class Rays:
    """Origins and unit directions; `forward`: planar z per unit of length."""

    origins: Float[Tensor, "rays 3"]
    directions: Float[Tensor, "rays 3"]
    forward: Float[Tensor, "rays"]

    def at(self, lengths: Float[Tensor, "rays samples"]) -> Float[Tensor, "rays samples 3"]:
        """Points along the rays."""
        return self.origins[:, None] + lengths[..., None] * self.directions[:, None]


@dataclass(frozen=True)
class Seen:
    """Surface that views saw: points, outward unit normals, unit rays away from the viewer.

    facing  cosine between the normal and the direction to the viewer
    weight  the view's, times that cosine: across a slanted surface depth says less
    """

    points: Float[Tensor, "seen 3"]
    normals: Float[Tensor, "seen 3"]
    rays: Float[Tensor, "seen 3"]
    facing: Float[Tensor, "seen"]
    weight: Float[Tensor, "seen"]

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, which: Tensor | slice) -> Seen:
        return Seen(**{field.name: getattr(self, field.name)[which] for field in fields(self)})


@dataclass(frozen=True)
class Pixels:
    """Pixels of views without depth: centres `at` (x, y), colour, how much of them the object fills, the weight."""

    view: Int[Tensor, "pixels"]
    at: Float[Tensor, "pixels 2"]
    color: Float[Tensor, "pixels 3"]
    inside: Float[Tensor, "pixels"]
    weight: Float[Tensor, "pixels"]

    def __len__(self) -> int:
        return len(self.view)

    def __getitem__(self, which: Tensor | slice) -> Pixels:
        return Pixels(**{field.name: getattr(self, field.name)[which] for field in fields(self)})


def cameras_of(reliefs: Sequence[Relief], device: str = "cpu") -> Cameras:
    """The reliefs' cameras as tensors."""
    pose = np.stack([relief.camera.world_from_camera for relief in reliefs])
    pixel = np.stack([pixel_from_camera(relief.camera, relief.shape[1], relief.shape[0]) for relief in reliefs])
    pinhole = torch.tensor([isinstance(relief.camera.projection, Perspective) for relief in reliefs], device=device)
    rotation, place, scale, offset = (
        torch.tensor(array, dtype=torch.float32, device=device)
        for array in (pose[:, :3, :3], pose[:, :3, 3], pixel[..., 0], pixel[..., 1])
    )
    return Cameras(rotation, place, scale, offset, pinhole)


def rays_through(cameras: Cameras, view: Int[Tensor, "rays"], at: Float[Tensor, "rays 2"]) -> Rays:
    """Rays through the pixels `at` (x, y) of views; parallel ones start in the camera's plane."""
    across = (at - cameras.offset[view]) / cameras.scale[view]
    pinhole = cameras.pinhole[view, None]
    nothing, one = torch.zeros_like(across), torch.ones_like(across[:, :1])
    direction = torch.cat([torch.where(pinhole, across, nothing), one], dim=1)
    start = torch.cat([torch.where(pinhole, nothing, across), 0 * one], dim=1)
    length = direction.norm(dim=1, keepdim=True)
    rotation = cameras.rotation[view]
    direction, start = ((rotation @ vector[..., None])[..., 0] for vector in (direction / length, start))
    return Rays(start + cameras.place[view], direction, 1 / length[:, 0])


def seen_by(reliefs: Sequence[Relief], device: str = "cpu") -> Seen:
    """Every pixel whose depth can be trusted, of all views."""
    cameras = cameras_of(reliefs, device)
    parts = [_seen(index, relief, cameras) for index, relief in enumerate(reliefs)]
    return Seen(*(torch.cat([getattr(part, field.name) for part in parts]) for field in fields(Seen)))


def pixels_of(reliefs: Sequence[Relief], device: str = "cpu") -> Pixels:
    """The pixels in and around the silhouettes of the views that have colour and no depth."""
    parts = [_pixels(index, relief) for index, relief in enumerate(reliefs)]
    return Pixels(*(torch.cat([getattr(part, field.name) for part in parts]).to(device) for field in fields(Pixels)))


def outside_of(
    points: Float[Tensor, "points 3"], reliefs: Sequence[Relief], cameras: Cameras
) -> Float[Tensor, "points"]:
    """How far points lie outside the silhouette that excludes them most, scene units; negative inside all.

    -inf where no view has an outline.
    """
    most = torch.full_like(points[:, 0], -torch.inf)
    for view, relief in enumerate(reliefs):
        if relief.outline is None:
            continue
        local = (points - cameras.place[view]) @ cameras.rotation[view]
        z = local[:, 2].clamp_min(1e-6) if cameras.pinhole[view] else torch.ones_like(local[:, 2])
        pixel = local[:, :2] / z[:, None] * cameras.scale[view] + cameras.offset[view]
        place = 2 * pixel / pixel.new_tensor(relief.shape[::-1]) - 1
        outline = torch.as_tensor(relief.outline, device=points.device)[None, None]
        found = grid_sample(outline, place[None, None], "bilinear", "border", align_corners=False)[0, 0, 0]
        most = torch.maximum(most, found * z / cameras.scale[view, 0])
    return most


def _seen(index: int, relief: Relief, cameras: Cameras) -> Seen:
    device = cameras.place.device
    if relief.depth is None or relief.slope is None:
        return Seen(*(torch.zeros((0, 3), device=device) for _ in range(3)), *(torch.zeros(0, device=device),) * 2)
    place = np.nonzero(relief.smooth)
    at, depth, slope = (
        torch.tensor(array, dtype=torch.float32, device=device)
        for array in (np.stack(place[::-1], axis=-1) + 0.5, relief.depth[place], relief.slope[place])
    )
    rays = rays_through(cameras, torch.full((len(at),), index, device=device), at)
    across, steepness = (at - cameras.offset[index]) / cameras.scale[index], slope * cameras.scale[index]
    along = depth + (steepness * across).sum(1) if cameras.pinhole[index] else torch.ones_like(depth)
    normals = normalize(torch.cat([steepness, -along[:, None]], dim=1), dim=1) @ cameras.rotation[index].T
    facing = -(normals * rays.directions).sum(1)
    seen = Seen(
        rays.at((depth / rays.forward)[:, None])[:, 0], normals, rays.directions, facing, relief.weight * facing
    )
    return seen[facing > STEEPEST]


def _pixels(index: int, relief: Relief) -> Pixels:
    if relief.depth is not None or relief.color is None:
        wanted = np.zeros(relief.shape, dtype=bool)
    else:
        wanted = relief.outline < BORDER if relief.outline is not None else np.ones(relief.shape, dtype=bool)
    rows, columns = np.nonzero(wanted)
    color = relief.color if relief.color is not None else np.zeros((*relief.shape, 3), np.float32)
    outline = relief.outline if relief.outline is not None else np.full(relief.shape, -BORDER)
    arrays = (
        np.stack([columns, rows], axis=-1) + 0.5,
        color[rows, columns],
        np.clip(0.5 - outline[rows, columns], 0, 1),
        np.full(len(rows), relief.weight),
    )
    view = torch.full((len(rows),), index)
    return Pixels(view, *(torch.tensor(array, dtype=torch.float32) for array in arrays))
