"""A signed distance field with colour: a closed-form fusion, plus a trained residual that is zero at the start.

World axes, scene units; distances are negative inside. A base grid is indexed [x, y, z] and holds distances at its
nodes: node (i, j, k) lies at origin + voxel * (i, j, k). Colours are sRGB in [0, 1].
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Float, Float32
from scipy.ndimage import distance_transform_edt
from torch import Tensor, nn
from torch.nn.functional import grid_sample

from mv3d_cli.fields.fusion import Fusion
from mv3d_cli.kernels.hash_grid import Layout, encode

LAYOUT = Layout(levels=8, features=2, coarsest=16, finest=256, table_size=1 << 16)
HIDDEN = 32
FIRST_FEATURES = 1e-4  # half-width of the tables' values at the start (Müller et al. 2022, section 3)
MARGIN = 12  # voxels about the object in which distances grow; beyond, they stay

TETRAHEDRON = ((1.0, 1.0, 1.0), (1.0, -1.0, -1.0), (-1.0, 1.0, -1.0), (-1.0, -1.0, 1.0))


class Field(nn.Module):
    """Signed distance = base grid + residual of a hash grid and a small network; colour from the same features.

    base    (x, y, z) distances at nodes; the field is exactly this until it is trained
    origin  (3,) world place of the first node; `voxel`: distance between nodes
    active  how many levels of the hash grid count: the finer ones wait (Neuralangelo, Li et al. 2023, section 3.2)
    """

    base: Tensor
    origin: Tensor
    voxel: Tensor
    active: Tensor

    def __init__(
        self,
        base: Float32[Tensor, "x y z"],
        origin: Float[Tensor, "3"],
        voxel: float,
        *,
        layout: Layout = LAYOUT,
        seed: int = 0,
    ):
        super().__init__()
        self.layout = layout
        self.register_buffer("base", base.float().contiguous())
        self.register_buffer("origin", origin.float())
        self.register_buffer("voxel", torch.tensor(float(voxel)))
        self.register_buffer("active", torch.tensor(layout.levels))
        generator = torch.Generator().manual_seed(seed)
        tables = torch.rand(layout.entries, layout.features, generator=generator)
        self.tables = nn.Parameter((2 * tables - 1) * FIRST_FEATURES)
        width = layout.levels * layout.features + 3
        self.residual = nn.Sequential(_layer(width, HIDDEN, generator), nn.ReLU(), _silent(HIDDEN, 1))
        self.shade = nn.Sequential(_layer(width, HIDDEN, generator), nn.ReLU(), _silent(HIDDEN, 3))

    def distance(self, points: Float32[Tensor, "points 3"]) -> Float32[Tensor, "points"]:
        """Signed distances, scene units."""
        return self.base_distance(points) + self.residual(self._features(points))[:, 0]

    def color(self, points: Float32[Tensor, "points 3"]) -> Float32[Tensor, "points 3"]:
        """Colours of the surface near the points, sRGB in [0, 1], the same from every side."""
        return torch.sigmoid(self.shade(self._features(points)))

    def distance_and_color(self, points: Float32[Tensor, "points 3"]) -> tuple[Tensor, Tensor]:
        """Both, for the price of one encoding."""
        features = self._features(points)
        distance = self.base_distance(points) + self.residual(features)[:, 0]
        return distance, torch.sigmoid(self.shade(features))

    def gradient(self, points: Float32[Tensor, "points 3"], step: float) -> Float32[Tensor, "points 3"]:
        """Gradient of the distance by finite differences `step` away along x, y and z, over a tetrahedron's corners."""
        return gradient_from_taps(self.distance(taps_around(points, step)), step)

    def base_distance(self, points: Float32[Tensor, "points 3"]) -> Float32[Tensor, "points"]:
        """The base alone, trilinear; beyond its box, the box's border."""
        last = torch.tensor(self.base.shape, device=points.device) - 1
        place = 2 * (points - self.origin) / (self.voxel * last) - 1
        grid = place.flip(-1)[None, None, None]  # the last axis comes first there
        return grid_sample(self.base[None, None], grid, "bilinear", "border", align_corners=True)[0, 0, 0, 0]

    def _features(self, points: Float32[Tensor, "points 3"]) -> Float32[Tensor, "points encoding"]:
        place = (points - self.origin) / (self.voxel * (max(self.base.shape) - 1))
        encoded = encode(place, self.tables, self.layout, levels=int(self.active))
        return torch.cat([encoded, 2 * place - 1], dim=1)


def taps_around(points: Float[Tensor, "points 3"], step: float) -> Float[Tensor, "taps 3"]:
    """Four points around each: the corners of a tetrahedron, one point's after the other's."""
    return (points[:, None] + step * points.new_tensor(TETRAHEDRON)).flatten(0, 1)


def gradient_from_taps(distance: Float[Tensor, "taps"], step: float) -> Float[Tensor, "points 3"]:
    """sum_k k f(x + h k) / 4h over the tetrahedron's corners k, from distances at `taps_around`."""
    return distance.unflatten(0, (-1, 4)) @ distance.new_tensor(TETRAHEDRON) / (4 * step)


def field_of(fusion: Fusion, *, seed: int = 0) -> Field:
    """The field that is the fusion, its distances continued beyond the fusion's reach."""
    base = torch.from_numpy(continued(fusion.distance, fusion.voxel, fusion.reach))
    return Field(base, torch.tensor(fusion.origin), fusion.voxel, seed=seed)


def field_from(state: Mapping[str, Tensor], *, layout: Layout = LAYOUT) -> Field:
    """The field whose `state_dict` this is."""
    field = Field(torch.empty_like(state["base"]), state["origin"], float(state["voxel"]), layout=layout)
    field.load_state_dict(state)
    return field


def continued(distance: Float32[np.ndarray, "x y z"], voxel: float, reach: float) -> Float32[np.ndarray, "x y z"]:
    """Distances that were clamped at `reach`, continued to MARGIN voxels about the object to within a voxel."""
    inside = distance < 0
    if inside.all() or not inside.any():
        return distance
    spans = [np.flatnonzero(inside.any(axis=other))[[0, -1]] for other in ((1, 2), (0, 2), (0, 1))]
    near = tuple(slice(max(first - MARGIN, 0), last + MARGIN + 1) for first, last in spans)
    behind, before = (np.asarray(distance_transform_edt(part)) for part in (inside[near], ~inside[near]))
    far = np.maximum((behind + before - 0.5) * voxel, reach)  # one of both is 0; half a voxel: from node to surface
    around = [(span.start, n - min(span.stop, n)) for span, n in zip(near, distance.shape, strict=True)]
    far = np.pad(far, around, mode="edge")
    return np.where(np.abs(distance) > 0.98 * reach, np.copysign(far, distance), distance).astype(np.float32)


def _layer(inputs: int, outputs: int, generator: torch.Generator) -> nn.Linear:
    """A linear layer before a ReLU, its weights uniform with the variance of He et al. (2015)."""
    layer = _silent(inputs, outputs)
    bound = (6 / inputs) ** 0.5
    nn.init.uniform_(layer.weight, -bound, bound, generator=generator)
    return layer


def _silent(inputs: int, outputs: int) -> nn.Linear:
    """A last layer: it says zero until it is trained."""
    layer = nn.Linear(inputs, outputs)
    nn.init.zeros_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer
