"""The torch twin of the fusion: whole grids at once, picture by picture."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from mv3d_cli.kernels.fuse import Picture
from mv3d_cli.kernels.fuse.warp_kernels import STEP
from mv3d_cli.scene.camera import Perspective, pixel_from_camera


def fuse(
    pictures: Sequence[Picture],
    resolution: int,
    origin: tuple[float, float, float],
    voxel: float,
    reach: float,
    device: str = "cpu",
) -> Float32[np.ndarray, "x y z"]:
    """Signed distances on a grid: same arguments and results as the kernel's `fuse`."""
    axes = [first + voxel * torch.arange(resolution, dtype=torch.float64, device=device) for first in origin]
    points = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, 3)
    outside = torch.full_like(points[:, 0], -reach)
    total, weights = torch.zeros_like(outside), torch.zeros_like(outside)
    for picture in pictures:
        depth, facing, outline, cosine, trust, z = _seen(points, picture)
        if picture.outlined:
            outside = torch.maximum(outside, outline)
        if picture.deep:
            distance = (depth - z) * facing
            weight = trust * picture.weight * cosine**2 * (1 + distance / reach).clamp(0, 1) * (outline < 0)
            total += weight * distance.clamp(max=reach)
            weights += weight
    mean = torch.maximum(total / weights, outside)
    distances = torch.where(weights > 1e-6, mean, outside).clamp(max=reach)
    return distances.reshape((resolution,) * 3).float().cpu().numpy()


def _seen(points: Float[Tensor, "points 3"], picture: Picture) -> tuple[Tensor, ...]:
    """Depth, |normal . ray| with the ray's z being 1, outline in scene units, cosine, trust, and the points' own z."""
    height, width = picture.texels.shape[:2]
    pose = torch.tensor(picture.camera.camera_from_world, device=points.device)
    (sx, ox), (sy, oy) = pixel_from_camera(picture.camera, width, height)
    x, y, z = (points @ pose[:3, :3].T + pose[:3, 3]).unbind(-1)
    unit = length = torch.ones_like(z)
    if isinstance(picture.camera.projection, Perspective):
        unit = z = z.clamp(min=1e-6)
        x, y = x / z, y / z
        length = (x**2 + y**2 + 1).sqrt()
    texels = torch.from_numpy(picture.texels).to(points)
    column, row = x * sx + ox, y * sy + oy
    depth, facing, outline, trust = _texels_at(texels, column, row).unbind(-1)
    over = (column - column.clamp(0.5, width - 0.501), row - row.clamp(0.5, height - 0.501))
    outline = outline + torch.hypot(*over) / sx
    return depth, facing, outline * unit, facing / length, trust, z


def _texels_at(
    texels: Float[Tensor, "height width 4"], x: Float[Tensor, "points"], y: Float[Tensor, "points"]
) -> Float[Tensor, "points 4"]:
    """Bilinear; beyond the border, the border; across a step in depth, the nearest texel's depth, cosine and trust."""
    height, width = texels.shape[:2]
    column, row = (x - 0.5).clamp(0, width - 1.001), (y - 0.5).clamp(0, height - 1.001)
    j, i = column.long(), row.long()
    right, down = (column - j)[:, None], (row - i)[:, None]
    a, b, c, d = corners = [texels[i + below, j + beside] for below in (0, 1) for beside in (0, 1)]
    mixed = (1 - down) * ((1 - right) * a + right * b) + down * ((1 - right) * c + right * d)
    depths = torch.stack(corners)[..., 0]
    step = depths.amax(0) - depths.amin(0) > STEP
    near = texels[i + (down[:, 0] >= 0.5), j + (right[:, 0] >= 0.5)]
    mixed[step] = torch.where(torch.arange(4) == 2, mixed[step], near[step])
    return mixed
