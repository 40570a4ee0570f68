"""`mv3d fit-sdf`: views become a signed distance field and a textured mesh.

The views are aligned to each other, fused in closed form, and a small network refines the fusion. The artifact holds
the mesh, the field, the views, a turntable sheet and a self-check, so that `mv3d export` needs nothing else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from mv3d_cli.errors import UsageError
from mv3d_cli.steps import export
from mv3d_cli.steps.settings import Between, Doc, Runtime, Tell, Warned, check, key_config, silent
from mv3d_cli.store import Artifact, Recipe, produce

VERSION = 1  # bumped when the same settings and inputs give other bytes
MAIN = "mesh.glb"

QUICK_TEXTURE = 512  # texels a side
QUICK_RESOLUTION = 160  # voxels a side

Device = Literal["cpu", "cuda"]


@dataclass(frozen=True)
class Config:
    """Settings of `mv3d fit-sdf`."""

    steps: Annotated[
        int, Doc("Training steps of the refinement; 0: the closed-form fusion alone."), Between(0, 100_000)
    ] = 200
    quick: Annotated[bool, Doc("A faster, rougher result: no refinement, fewer voxels, a smaller texture.")] = False
    max_time: Annotated[float | None, Doc("Refine for at most this many seconds."), Between(0, 1e6)] = None
    resolution: Annotated[int, Doc("Voxels a side of the fusion."), Between(32, 512)] = 192
    weight: Annotated[tuple[str, ...], Doc("Trust in views, such as front=3,back=0.5; 0 leaves a view out.")] = ()
    from_: Annotated[
        Path | None, Doc("An earlier fit: its views are fitted together with the new ones."), Runtime()
    ] = None
    faces: Annotated[int, Doc("Most faces of the mesh."), Between(100, 2_000_000)] = 30_000
    texture: Annotated[int, Doc("Texels a side; 0: colours at the vertices."), Between(0, 8192)] = 1024
    seed: Annotated[int, Doc("Seed of the refinement."), Between(0, 2**31)] = 0
    device: Annotated[Device, Doc("Where the refinement runs."), Runtime()] = "cpu"


def texture_of(config: Config) -> int:
    """Texels a side of the mesh's texture."""
    return min(config.texture, QUICK_TEXTURE) if config.quick else config.texture


def resolution_of(config: Config) -> int:
    """Voxels a side of the fusion."""
    return min(config.resolution, QUICK_RESOLUTION) if config.quick else config.resolution


def export_settings(config: Config) -> export.Config:
    """What makes the fit's own mesh again, in another format."""
    texture = texture_of(config)
    return export.Config(faces=config.faces, texture=texture or QUICK_TEXTURE, vertex_colors=not texture)


def run(config: Config, inputs: Sequence[Path], tell: Tell = silent) -> Artifact:
    """The fit of a views folder. Raises UsageError, MissingInput, BadViews, BadImage, EmptySurface."""
    check(config)
    if len(inputs) != 1:
        raise UsageError(f"one views folder is wanted, not {len(inputs)}", "run the command once for each")
    from mv3d_cli.steps.fit_sdf.building import build, inputs_of

    views, digests = inputs_of(config, inputs[0], tell)
    sources = {"views": str(inputs[0])} | ({"from": str(config.from_)} if config.from_ is not None else {})
    recipe = Recipe("fit-sdf", VERSION, key_config(config), digests, sources=sources)
    return produce(
        recipe,
        partial(build, config, views, tell),
        main=MAIN,
        resumable=True,
        device=config.device,
        on_notice=lambda text: tell(Warned(text)),
    )
