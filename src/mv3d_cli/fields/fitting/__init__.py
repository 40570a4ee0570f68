"""The field is fitted to aligned views in small steps, which can be stopped and resumed anywhere.

Views with depth supervise the distances directly, at points near the surface that they saw; views without depth by
volume rendering. Only what the views say differently from the field moves it: its residual starts at zero.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mv3d_cli.fields.fitting import losses
from mv3d_cli.fields.fitting.samples import cameras_of, outside_of, pixels_of, rays_through, seen_by
from mv3d_cli.fields.fitting.volume import ends_near_surface, render
from mv3d_cli.fields.relief import Relief
from mv3d_cli.fields.sdf import Field, gradient_from_taps, taps_around

SHARES = {"depth": 1.0, "projective": 0.5, "hull": 0.5, "eikonal": 0.1, "normal": 0.1, "color": 1.0, "mask": 0.5}
LEAST = 1e-3  # of a loss: below, it is satisfied and falls silent
BETAS = (0.9, 0.99)
CALMER = 0.1  # the learning rate's share that is left in the end
SHARP = 200.0  # of volume rendering at the start, per scene unit
SLACK = 0.004  # scene units: outlines are not taken at their word, or they eat away what no view sees
SHAKEN = 0.03  # scene units: how far from the surface silhouettes are asked


@dataclass(frozen=True)
class Config:
    """How a field is fitted: counts are for each step, lengths in scene units.

    reach    how far from the surface seen distances count
    tap      finite differences of gradients: from, to
    levels   of the hash grid at the start; all of them from half-time on
    dropped  share of the worst errors that does not count
    """

    steps: int = 200
    rate: float = 4e-3
    surface: int = 8192
    space: int = 8192
    silhouette: int = 4096
    normals: int = 2048
    rays: int = 512
    reach: float = 0.02
    tap: tuple[float, float] = (0.012, 0.006)
    levels: int = 4
    dropped: float = 0.0
    seed: int = 0


@dataclass(frozen=True)
class Progress:
    """A step that was done, of how many, and its losses by name."""

    step: int
    steps: int
    losses: dict[str, float]


class Fit:
    """A field being fitted; `run` goes on from wherever it is.

    On a CPU a fit that was stopped and resumed from its state ends with the bits of one that ran through.
    """

    def __init__(self, field: Field, reliefs: Sequence[Relief], config: Config):
        """The reliefs are aligned already; the field lies on the device where the work is to be done."""
        device = str(field.base.device)
        self.field, self.reliefs, self.config, self.step = field, tuple(reliefs), config, 0
        self.cameras = cameras_of(reliefs, device)
        self.seen, self.pixels = seen_by(reliefs, device), pixels_of(reliefs, device)
        self.near = (field.base.abs() < 2 * field.voxel).nonzero()
        self.sharpness = torch.nn.Parameter(torch.tensor(math.log(SHARP), device=device))
        self.optimizer = torch.optim.Adam([*field.parameters(), self.sharpness], betas=BETAS, eps=1e-15, fused=True)
        self.balance = losses.Balance(SHARES, LEAST)
        self.generator = torch.Generator().manual_seed(config.seed)

    def run(self) -> Iterator[Progress]:
        """The steps that are left."""
        while self.step < self.config.steps:
            found = self._losses(self._schedule())
            self.optimizer.zero_grad(set_to_none=True)
            if found:
                self.balance.total(found).backward()
                self.optimizer.step()
            self.step += 1
            yield Progress(self.step, self.config.steps, {name: float(loss.detach()) for name, loss in found.items()})

    def state_dict(self) -> dict[str, Any]:
        """All that a resumed fit needs, for `torch.save`."""
        return {
            "field": self.field.state_dict(),
            "sharpness": self.sharpness.detach().clone(),
            "optimizer": self.optimizer.state_dict(),
            "balance": self.balance.state_dict(),
            "generator": self.generator.get_state(),
            "step": self.step,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes on from a state that `state_dict` gave, of a fit to the same reliefs with the same config."""
        self.field.load_state_dict(state["field"])
        with torch.no_grad():
            self.sharpness.copy_(state["sharpness"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.balance.load_state_dict(state["balance"])
        self.generator.set_state(state["generator"].cpu())
        self.step = int(state["step"])

    def _schedule(self) -> float:
        """Sets the learning rate and the active levels; returns the step of finite differences."""
        config, part = self.config, self.step / self.config.steps
        for group in self.optimizer.param_groups:
            group["lr"] = config.rate * CALMER**part
        levels = self.field.layout.levels
        grown = config.levels + int((levels - config.levels + 1) * 2 * part)
        self.field.active.fill_(min(levels, grown))
        first, last = config.tap
        return first * (last / first) ** part

    def _losses(self, tap: float) -> dict[str, Tensor]:
        found = {}
        if len(self.seen):
            found |= self._direct(tap)
        if len(self.pixels):
            found |= self._rendered()
        return found

    def _direct(self, tap: float) -> dict[str, Tensor]:
        """Losses at points on, near and outside the surface that views saw; one pass through the field."""
        config, device = self.config, self.seen.points.device
        on, off = self._drawn(self.seen, config.surface), self._drawn(self.seen, config.space)
        slanted = on[: config.normals]
        along = (2 * torch.rand(len(off), generator=self.generator).to(device) - 1) * 1.5 * config.reach
        space = off.points - off.rays * (along / off.facing)[:, None]
        around, outside = self._outside()
        parts = [on.points, space, around, taps_around(slanted.points, tap)]
        at, off_at, around_at, taps = self.field.distance(torch.cat(parts)).split([len(part) for part in parts])
        gradient = gradient_from_taps(taps, tap)
        # further behind the surface nobody has looked
        weight = off.weight * (along > -config.reach)
        errors = {
            "depth": (losses.depth_error(at), on.weight),
            "projective": (losses.projective_error(off_at, along, config.reach), weight),
            "hull": (losses.hull_error(around_at, (outside - SLACK).clamp(max=config.reach)), torch.ones_like(outside)),
            "eikonal": (losses.eikonal_error(gradient), torch.ones_like(slanted.weight)),
            "normal": (losses.normal_error(gradient, slanted.normals, slanted.facing), slanted.weight),
        }
        return {name: losses.ranked(error, weight, config.dropped) for name, (error, weight) in errors.items()}

    def _rendered(self) -> dict[str, Tensor]:
        """Losses of rays through views without depth."""
        config, cameras = self.config, self.cameras
        pixels = self._drawn(self.pixels, config.rays)
        rays = rays_through(cameras, pixels.view, pixels.at)
        with torch.no_grad():
            ends = ends_near_surface(self.field.distance, rays, self.generator)
        shown = render(self.field, rays, ends, self.sharpness.exp())
        color = losses.color_error(shown.color, pixels.color * pixels.inside[:, None])
        mask = losses.mask_error(shown.opacity, pixels.inside)
        return {
            "color": losses.ranked(color, pixels.weight * pixels.inside, config.dropped),
            "mask": losses.ranked(mask, pixels.weight, config.dropped),
        }

    def _outside(self) -> tuple[Float[Tensor, "points 3"], Float[Tensor, "points"]]:
        """Points about the surface, and how far outside the silhouettes they lie."""
        which = torch.randint(len(self.near), (self.config.silhouette,), generator=self.generator)
        shake = SHAKEN * torch.randn(len(which), 3, generator=self.generator)
        nodes = self.near[which.to(self.near.device)]
        points = self.field.origin + self.field.voxel * nodes + shake.to(nodes.device)
        return points, outside_of(points, self.reliefs, self.cameras)

    def _drawn(self, samples: Any, count: int) -> Any:
        """`count` of the samples, drawn with replacement on the CPU, so that devices draw alike."""
        which = torch.randint(len(samples), (count,), generator=self.generator)
        return samples[which.to(self.field.base.device)]


def fit(field: Field, reliefs: Sequence[Relief], config: Config | None = None) -> Iterator[Progress]:
    """Fits a field to aligned reliefs, in place, from the start."""
    return Fit(field, reliefs, config or Config()).run()
