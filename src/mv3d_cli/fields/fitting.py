"""The field is fitted to the views: a generator of small steps, which can be stopped and resumed anywhere."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mv3d_cli.fields import losses
from mv3d_cli.fields.alignment import Alignment, Prior
from mv3d_cli.fields.alignment.warps import warped
from mv3d_cli.fields.relief import Relief
from mv3d_cli.fields.samples import Pixels, Warps, cameras_of, lift, outside_of, pixels_of
from mv3d_cli.fields.sdf import Field


@dataclass(frozen=True)
class Config:
    """How to fit; distances in scene units."""

    steps: int = 200
    rate: float = 5e-3
    rate_net: float = 2e-3
    rate_warp: float = 0.0
    surface: int = 8192
    tapped: int = 2048
    space: int = 8192
    hull: int = 4096
    reach: float = 0.02
    tap: tuple[float, float] = (0.012, 0.006)
    levels: tuple[int, int] = (4, 8)
    grow: float = 0.5
    dropped: float = 0.0
    shares: tuple = (("depth", 1.0), ("projective", 0.5), ("hull", 0.5), ("eikonal", 0.05), ("normal", 0.1), ("pull", 0.1))
    balance: bool = True
    l2: bool = False
    seed: int = 0
    slack: float = 0.0


class Fit:
    def __init__(self, field_: Field, reliefs, alignment: Alignment, held, config: Config):
        self.field, self.config = field_, config
        self.reliefs = [warped(r, w) for r, w in zip(reliefs, alignment.warps)]
        grid = alignment.warps[0].offsets.shape[0]
        self.pixels = pixels_of(reliefs, grid)
        self.cameras = cameras_of(reliefs)
        prior = Prior()
        self.warps = Warps(alignment.warps, held, (prior.pixels, prior.pixels, prior.depth), prior.reach)
        self.outlines = torch.tensor(np.stack([r.outline for r in self.reliefs]))[:, None]
        c = config
        groups = [{"params": [field_.tables], "lr": c.rate}, {"params": [p for n, p in field_.named_parameters() if n != "tables"], "lr": c.rate_net}]
        if c.rate_warp:
            groups.append({"params": [self.warps.change], "lr": c.rate_warp})
        self.optimizer = torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-15, fused=True)
        self.base_rates = [g["lr"] for g in groups]
        self.generator = torch.Generator().manual_seed(c.seed)
        self.step_number = 0
        shares = dict(c.shares)
        self.balance = losses.Balance(shares, {k: 1e-3 for k in shares})
        self.chances = self.pixels.weight

    def rand(self, *n):
        return torch.rand(*n, generator=self.generator)

    def run(self) -> Iterator[dict]:
        while self.step_number < self.config.steps:
            yield self.step()

    def step(self):
        c, f = self.config, self.field
        t = self.step_number / c.steps
        lo, hi = c.levels
        f.active.fill_(min(hi, lo + int((hi - lo + 1) * t / c.grow)) if c.grow > 0 else hi)
        for g, r in zip(self.optimizer.param_groups, self.base_rates):
            g["lr"] = r * (0.1 ** t)
        tap = c.tap[0] * (c.tap[1] / c.tap[0]) ** t
        n = c.surface + c.space
        which = torch.randint(len(self.pixels), (n,), generator=self.generator)
        pixels = self.pixels[which]
        offsets = self.warps() if c.rate_warp else self.warps.offsets
        lifted = lift(pixels, self.cameras, offsets, self.warps.linear)
        surf = lifted.points[: c.surface]
        # along the ray
        a = (self.rand(c.space) * 2 - 1) * c.reach * 1.5
        facing = lifted.facing[c.surface:]
        sp = lifted.points[c.surface:] - lifted.rays[c.surface:] * (a / facing.clamp_min(0.1))[:, None]
        hp = self.rand(c.hull, 3) * 2.1 - 1.05 if False else self.hull_points()
        out = outside_of(hp, self.outlines, self.cameras) - c.slack
        taps = surf[: c.tapped].detach()
        corners = torch.tensor(((1.0, 1.0, 1.0), (1.0, -1.0, -1.0), (-1.0, 1.0, -1.0), (-1.0, -1.0, 1.0)))
        around = (taps[:, None] + tap * corners).flatten(0, 1)
        values = f.distance(torch.cat([surf, sp, hp, around]))
        ds, dp, dh, dt = values.split([c.surface, c.space, c.hull, 4 * c.tapped])
        gradient = dt.unflatten(0, (-1, 4)) @ corners / (4 * tap)
        w = pixels.weight
        L = losses
        e = L.depth_error(ds)
        if c.l2:
            e = e ** 2 * 100
        out_terms = {
            "depth": L.ranked(e, w[: c.surface], c.dropped),
            "projective": L.ranked(L.projective_error(dp, a, c.reach), w[c.surface:] * (a > -c.reach), c.dropped),
            "hull": L.hull_error(dh, out.clamp(max=c.reach)).mean(),
            "eikonal": L.eikonal_error(gradient).mean(),
            "normal": L.ranked(L.normal_error(gradient, lifted.normals[: c.tapped], lifted.facing[: c.tapped]), w[: c.tapped], c.dropped),
        }
        if c.rate_warp:
            out_terms["pull"] = self.warps.pull()
        shares = dict(c.shares)
        out_terms = {k: v for k, v in out_terms.items() if shares.get(k, 0) > 0}
        if c.balance:
            total = self.balance.total(out_terms)
        else:
            total = sum(shares[k] * v for k, v in out_terms.items())
        self.optimizer.zero_grad(set_to_none=True)
        total.backward()
        self.optimizer.step()
        self.step_number += 1
        return {k: float(v.detach()) for k, v in out_terms.items()}

    def hull_points(self):
        # points near the surface
        which = torch.randint(len(self.pixels), (self.config.hull,), generator=self.generator)
        p = lift(self.pixels[which], self.cameras, self.warps.offsets, self.warps.linear).points
        return p + torch.randn(p.shape, generator=self.generator) * 0.03
