"""`mv3d generate`: one photo becomes views, colour and depth, by multi-view diffusion.

The photo's object is cut out and framed; it is the front view. The artifact is a views folder, with besides
sheet.png (the photo, then the views), input.png (the photo as framed), mask.png (the cut-out at the photo's pixels).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from mv3d_cli.errors import UsageError
from mv3d_cli.scene.rig import HORIZONTAL
from mv3d_cli.steps.settings import Between, Doc, Runtime, Tell, Warned, check, key_config, silent
from mv3d_cli.store import Artifact, Recipe, produce

VERSION = 1  # bumped when the same settings and inputs give other bytes
STEPS = 4  # more gain the bundled model nothing

Sampler = Literal["lcm", "ddim", "dpm"]
Device = Literal["auto", "cpu", "cuda", "mps"]
Precision = Literal["auto", "fp32", "bf16"]

FRONT, BACK = HORIZONTAL[:2]
KEEP = "keep"


@dataclass(frozen=True)
class Config:
    """Settings of `mv3d generate`."""

    fill: Annotated[
        str, Doc("Share of the frame that the object's longest side takes, 0.2 to 1; keep: the photo's framing.")
    ] = "0.7"
    steps: Annotated[int, Doc("Steps of the sampler."), Between(1, 1000)] = STEPS
    sampler: Annotated[Sampler, Doc("How noise becomes pictures.")] = "ddim"
    guidance: Annotated[float, Doc("How far to exaggerate what the photo says; 1: not at all."), Between(1, 20)] = 1.0
    seed: Annotated[int, Doc("Seed of the noise."), Between(0, 2**31)] = 0
    model: Annotated[
        str, Doc("small: the bundled one; or a model folder, or a hub id in diffusers layout."), Runtime()
    ] = "small"
    views: Annotated[tuple[str, ...], Doc("Views to make; front, the photo itself, always comes first.")] = HORIZONTAL
    depth_only: Annotated[bool, Doc("Only the front view: the photo and its depth.")] = False
    device: Annotated[Device, Doc("Where the model runs; auto: a GPU where there is one."), Runtime()] = "auto"
    dtype: Annotated[Precision, Doc("Of the products; auto: bf16 where the device has units for it.")] = "auto"


def run(config: Config, inputs: Sequence[Path | bytes], tell: Tell = silent) -> Artifact:
    """The views of one photo, which is given as a file or as its bytes.

    Raises UsageError, MissingInput, BadImage, BadCameras for unknown views, BadWeights, MissingDependency, and
    WorkFailed where the model sees no object.
    """
    config = _plain(config)
    fill = fill_of(config.fill)
    if len(inputs) != 1:
        raise UsageError(f"one photo is wanted, not {len(inputs)}", "run the command once for each")
    from mv3d_cli.formats.cameras import load_cameras, select
    from mv3d_cli.steps.generate.models import found
    from mv3d_cli.steps.generate.photo import photo_of, subject_of

    cameras = select(load_cameras(), config.views)
    photo = photo_of(inputs[0])
    place = found(config.model)

    def build(folder: Path) -> None:
        subject = subject_of(photo, tell)  # a photo that is refused is refused before torch is loaded
        from mv3d_cli.steps.generate.making import write_views_of

        write_views_of(config, subject, cameras, place, folder, tell)

    settings = key_config(config) | {"fill": fill or KEEP}
    sources = {"photo": photo.name}
    recipe = Recipe("generate", VERSION, settings, {"photo": photo.digest}, weights=place.digest, sources=sources)
    return produce(recipe, build, device=config.device, on_notice=lambda text: tell(Warned(text)))


def fill_of(text: str) -> float | None:
    """The share of the frame that the object is to take; None: as in the photo. Raises UsageError."""
    if text.strip() == KEEP:
        return None
    try:
        fill = float(text)
    except ValueError:
        fill = math.nan
    if not 0.2 <= fill <= 1:
        raise UsageError(f"--fill {text} is no share of the frame", f"take a number from 0.2 to 1, or {KEEP}")
    return fill


def _plain(config: Config) -> Config:
    """The settings with the views that they come to: the front, then the others. Raises UsageError."""
    check(config)
    if not config.views:
        raise UsageError("--views names none", f"choose from {', '.join(HORIZONTAL)}")
    others = tuple(name for name in config.views if name != FRONT)
    return replace(config, views=(FRONT,) if config.depth_only else (FRONT, *others), depth_only=False)
