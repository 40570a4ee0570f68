"""Training samples: what the views saw, as points in space that move with the views' warps.

Warps as in `alignment.warps`: a pixel at (x, y, z) moves to (x + dx, y + dy, z + (z - r) scale + shift + dz). World
axes, scene units; `view` is an index into the reliefs. All tensors live on one device.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.functional import grid_sample

from mv3d_cli.fields.alignment.warps import Warp
from mv3d_cli.fields.relief import Relief
from mv3d_cli.scene.camera import Perspective, pixel_from_camera
from mv3d_cli.scene.conventions import RIG_RADIUS

STEEPEST = 0.1  # cosine: what a view sees at a more grazing angle it hardly sees


@dataclass(frozen=True)
class Cameras:
    """Cameras side by side: world_from_camera (v, 3, 3) and place (v, 3); scale and offset (v, 2) of pixels."""

    rotation: Float[Tensor, "views 3 3"]
    place: Float[Tensor, "views 3"]
    scale: Float[Tensor, "views 2"]
    offset: Float[Tensor, "views 2"]
    pinhole: Tensor


@dataclass(frozen=True)
class Pixels:
    """Pixels of all views: `at` (n, 2) their centres, `slope` of depth per pixel, `color` NaN where there is none.

    weight  the view's, times |cosine| between the surface and the ray
    corners, shares  (n, 4) control points of the view's warp, and how much each counts
    """

    view: Int[Tensor, "n"]
    at: Float[Tensor, "n 2"]
    depth: Float[Tensor, "n"]
    slope: Float[Tensor, "n 2"]
    color: Float[Tensor, "n 3"]
    weight: Float[Tensor, "n"]
    corners: Int[Tensor, "n 4"]
    shares: Float[Tensor, "n 4"]

    def __len__(self) -> int:
        return len(self.view)

    def __getitem__(self, which: Tensor) -> Pixels:
        return Pixels(**{field.name: getattr(self, field.name)[which] for field in fields(self)})


@dataclass(frozen=True)
class Lifted:
    """Pixels in space: points, outward unit normals, unit rays away from the viewer, cosine of normal and -ray."""

    points: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"]
    rays: Float[Tensor, "n 3"]
    facing: Float[Tensor, "n"]


class Warps(nn.Module):
    """The warps of all views as something to train: closed-form ones plus smooth changes, none at the start.

    Changes are drawn through the alignment's prior, so that `change` has unit variance wherever the prior is right,
    and the mean of its squares is the pull back to the closed form.
    """

    offsets: Tensor
    linear: Tensor
    root: Tensor
    spread: Tensor
    free: Tensor

    def __init__(self, warps: Sequence[Warp], held: Sequence[bool], spread: tuple[float, float, float], reach: float):
        super().__init__()
        grid = warps[0].offsets.shape[0]
        place = np.stack(np.meshgrid(*[np.linspace(0, 1, grid)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
        apart = ((place[:, None] - place[None]) ** 2).sum(-1)
        root = np.linalg.cholesky(np.exp(-apart / (2 * reach**2)) + 1e-3 * np.eye(len(place)))
        offsets = np.stack([warp.offsets.reshape(-1, 3) for warp in warps])
        free = np.ones((len(warps), 1, 3))
        free[np.asarray(held, dtype=bool), :, :2] = 0
        for name, value in {
            "offsets": offsets,
            "linear": np.array([[warp.scale, warp.shift] for warp in warps]),
            "root": root,
            "spread": np.array(spread),
            "free": free,
        }.items():
            self.register_buffer(name, torch.tensor(value, dtype=torch.float32))
        self.change = nn.Parameter(torch.zeros(len(warps), grid * grid, 3))

    def forward(self) -> Float[Tensor, "views controls 3"]:
        """dx, dy (pixels) and dz of every control point."""
        return self.offsets + self.root @ self.change * self.spread * self.free

    def pull(self) -> Tensor:
        """Mean square of the change, in standard deviations of the prior."""
        return (self.change * self.free).square().mean()


def cameras_of(reliefs: Sequence[Relief], device: str = "cpu") -> Cameras:
    """The reliefs' cameras as tensors."""
    pose = np.stack([relief.camera.world_from_camera for relief in reliefs])
    pixel = np.stack([pixel_from_camera(relief.camera, relief.shape[1], relief.shape[0]) for relief in reliefs])
    pinhole = np.array([isinstance(relief.camera.projection, Perspective) for relief in reliefs])
    arrays = (pose[:, :3, :3], pose[:, :3, 3], pixel[..., 0], pixel[..., 1])
    return Cameras(*(torch.tensor(a, dtype=torch.float32, device=device) for a in arrays), torch.tensor(pinhole, device=device))


def pixels_of(reliefs: Sequence[Relief], grid: int, device: str = "cpu") -> Pixels:
    """Every pixel whose depth can be trusted, of all views."""
    found = [_pixels(index, relief, grid) for index, relief in enumerate(reliefs) if relief.depth is not None]
    merged = [torch.cat([getattr(pixels, field.name) for pixels in found]).to(device) for field in fields(Pixels)]
    return Pixels(*merged)


def lift(pixels: Pixels, cameras: Cameras, offsets: Tensor, linear: Tensor) -> Lifted:
    """Pixels to space through the warps: `offsets` (views, controls, 3), `linear` (views, 2) scale and shift."""
    moved = (offsets[pixels.view[:, None], pixels.corners] * pixels.shares[..., None]).sum(1)
    scale, shift = linear[pixels.view].unbind(1)
    depth = pixels.depth + (pixels.depth - RIG_RADIUS) * scale + shift + moved[:, 2]
    zoom, pinhole = cameras.scale[pixels.view], cameras.pinhole[pixels.view][:, None]
    across = (pixels.at + moved[:, :2] - cameras.offset[pixels.view]) / zoom
    one = torch.ones_like(across[:, :1])
    place = torch.cat([torch.where(pinhole, across * depth[:, None], across), depth[:, None]], dim=1)
    slope = pixels.slope * zoom
    along = torch.where(pinhole[:, 0], depth + (slope * across).sum(1), one[:, 0])
    normal = torch.nn.functional.normalize(torch.cat([slope, -along[:, None]], dim=1), dim=1)
    ray = torch.nn.functional.normalize(torch.cat([torch.where(pinhole, across, 0 * across), one], dim=1), dim=1)
    rotation = cameras.rotation[pixels.view]
    facing = -(normal * ray).sum(1)
    points, normals, rays = ((rotation @ v[..., None])[..., 0] for v in (place, normal, ray))
    return Lifted(points + cameras.place[pixels.view], normals, rays, facing)


def outside_of(
    points: Float[Tensor, "n 3"], outlines: Float[Tensor, "views 1 height width"], cameras: Cameras
) -> Float[Tensor, "n"]:
    """How far points lie outside the silhouette that excludes them most, scene units; negative inside all."""
    local = torch.einsum("vji,vnj->vni", cameras.rotation, points[None] - cameras.place[:, None])
    z = local[..., 2:]
    pinhole = cameras.pinhole[:, None, None]
    across = torch.where(pinhole, local[..., :2] / z.clamp_min(1e-6), local[..., :2])
    pixel = across * cameras.scale[:, None] + cameras.offset[:, None]
    size = torch.tensor(outlines.shape[:1:-1], device=points.device)
    found = grid_sample(outlines, (2 * pixel / size - 1)[:, None], "bilinear", "border", align_corners=False)
    width = torch.where(pinhole, z, torch.ones_like(z))[..., 0] / cameras.scale[:, :1]
    return (found[:, 0, 0] * width).amax(0)


def _pixels(index: int, relief: Relief, grid: int) -> Pixels:
    assert relief.depth is not None
    assert relief.slope is not None
    place = np.nonzero(relief.smooth)
    at = np.stack([place[1], place[0]], axis=-1) + np.float32(0.5)
    color = relief.color[place] if relief.color is not None else np.full((len(at), 3), np.nan, np.float32)
    corners, shares = _controls(at, relief.shape, grid)
    slope = relief.slope[place]
    zoom = 1 / relief.pixel_width / (relief.depth[place] if isinstance(relief.camera.projection, Perspective) else 1)
    facing = 1 / np.sqrt(1 + ((slope * np.reshape(zoom, (-1, 1))) ** 2).sum(1))
    weight = relief.weight * facing * (facing > STEEPEST)
    arrays = (at, relief.depth[place], slope, color, weight)
    return Pixels(
        torch.full((len(at),), index),
        *(torch.tensor(a, dtype=torch.float32) for a in arrays),
        torch.tensor(corners),
        torch.tensor(shares),
    )


def _controls(at: np.ndarray, shape: tuple[int, int], grid: int) -> tuple[np.ndarray, np.ndarray]:
    """The four control points around each pixel and their bilinear shares, as `basis_of` has them."""
    u = np.clip(at / np.array(shape[::-1]) * (grid - 1), 0, grid - 1.001)
    cell = u.astype(np.int64)
    x, y = (u - cell).astype(np.float32).T
    first = cell[:, 1] * grid + cell[:, 0]
    corners = first[:, None] + np.array([0, 1, grid, grid + 1])
    return corners, np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y], axis=1)
