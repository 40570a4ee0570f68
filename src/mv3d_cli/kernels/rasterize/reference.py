"""The rasteriser in torch, face by face over whole pictures: slow, plain, and what the kernel is tested against."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mv3d_cli.kernels.rasterize import Fragments
from mv3d_cli.scene.camera import Camera, Perspective, pixel_from_camera

NEAR = 1e-4


def rasterize(
    vertices: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
    cameras: Sequence[Camera],
    width: int,
    height: int,
) -> Fragments:
    """The faces seen from each camera: same arguments and results as the kernel's `rasterize`."""
    views = [_view(vertices.double(), faces.long(), camera, width, height) for camera in cameras]
    return Fragments(*(torch.stack(parts) for parts in zip(*views, strict=True)))


def _rays(camera: Camera, width: int, height: int) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w 3"]]:
    """Origins and directions (z = 1) of the rays through the pixel centres, camera axes."""
    (sx, ox), (sy, oy) = pixel_from_camera(camera, width, height)
    rows, columns = torch.meshgrid(
        torch.arange(height, dtype=torch.float64) + 0.5,
        torch.arange(width, dtype=torch.float64) + 0.5,
        indexing="ij",
    )
    across = torch.stack([(columns - ox) / sx, (rows - oy) / sy, torch.zeros_like(rows)], dim=-1)
    forward = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand_as(across)
    if isinstance(camera.projection, Perspective):
        return torch.zeros_like(across), across + forward
    return across, forward


def _view(
    vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"], camera: Camera, width: int, height: int
) -> tuple[Int[Tensor, "h w"], Float[Tensor, "h w 3"], Float[Tensor, "h w"]]:
    """One view: every ray meets every face (Moeller & Trumbore, 1997), the nearest in front stays."""
    camera_from_world = torch.as_tensor(camera.camera_from_world, dtype=torch.float64)
    points = vertices @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
    origin, direction = _rays(camera, width, height)
    nearest = torch.full((height, width), torch.inf, dtype=torch.float64)
    face = torch.full((height, width), -1, dtype=torch.int32)
    barycentric = torch.zeros((height, width, 3), dtype=torch.float64)
    for index, (a, b, c) in enumerate(points[faces]):
        normal = torch.linalg.cross(b - a, c - a)
        along = direction @ normal
        z = ((a - origin) @ normal) / along  # direction.z = 1, so the ray's parameter is planar z
        p = origin + z[..., None] * direction
        weights = torch.stack(
            [
                torch.linalg.cross(b - p, c - p) @ normal,
                torch.linalg.cross(c - p, a - p) @ normal,
                torch.linalg.cross(a - p, b - p) @ normal,
            ],
            dim=-1,
        ) / (normal @ normal)
        hit = (weights.min(dim=-1).values >= 0) & (z > NEAR) & (z < nearest) & (along != 0)
        nearest[hit], face[hit], barycentric[hit] = z[hit], index, weights[hit]
    depth = torch.where(face >= 0, nearest, 0.0)
    return face, barycentric.float(), depth.float()
