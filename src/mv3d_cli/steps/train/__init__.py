"""`mv3d train`: a multi-view diffusion model is taught, stage by stage, on objects drawn as it goes.

autoencoder   pictures <-> latents, fitted in closed form
1             photo -> views: colour or depth, drawn at random
2             colour and depth together
distill       few steps do what many did

The artifact is a model folder: config.json, model.safetensors (moving averages), training.json (settings, what was
done, scores), curve.csv (the loss of each step), validation/STEP.png, logs/ for tensorboard.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from mv3d_cli.errors import UsageError
from mv3d_cli.scene.rig import HORIZONTAL
from mv3d_cli.steps.settings import Between, Doc, Runtime, Tell, check, silent
from mv3d_cli.store import Artifact

VERSION = 1  # bumped when the same settings and inputs give other bytes

Stage = Literal["autoencoder", "1", "2", "distill"]
Preset = Literal["small", "tiny", "sd"]
Lighting = Literal["random", "studio", "none"]
Device = Literal["auto", "cpu", "cuda", "mps"]
Precision = Literal["auto", "bf16", "fp32"]
Up = Literal["auto", "y", "z"]


@dataclass(frozen=True)
class Config:
    """Settings of `mv3d train`."""

    stage: Annotated[Stage, Doc("What to teach: autoencoder, then 1, then 2, then distill.")] = "1"
    preset: Annotated[
        Preset, Doc("Without --from: the small model from scratch, a tiny one to try things out, or sd.")
    ] = "small"
    from_: Annotated[
        str | None, Doc("Model to start from: a folder, or for sd a hub id in diffusers layout."), Runtime()
    ] = None
    steps: Annotated[int, Doc("Steps of the optimizer."), Between(1, 100_000_000)] = 10_000
    max_time: Annotated[
        str | None, Doc("Pause after this time, such as 90s, 9m or 2h; the same command goes on."), Runtime()
    ] = None
    batch: Annotated[int, Doc("Objects a batch, in each process."), Between(1, 4096)] = 16
    accumulate: Annotated[int, Doc("Batches a step."), Between(1, 4096)] = 1
    lr: Annotated[
        float | None, Doc("Learning rate; by default 1e-4, or 5e-5 in stage 2, from scratch 5e-4."), Between(0, 1)
    ] = None
    warmup: Annotated[int, Doc("Steps over which the learning rate rises."), Between(0, 1_000_000)] = 100
    decay: Annotated[float, Doc("Last share of the steps over which it falls to zero."), Between(0, 1)] = 0.2
    ema: Annotated[float, Doc("Greatest decay of the weights' moving average."), Between(0, 1)] = 0.9999
    gamma: Annotated[float, Doc("Cap of the signal-to-noise weight (min-SNR)."), Between(0, 1000)] = 5.0
    floor: Annotated[float, Doc("Its least value; without one nothing is learnt from pure noise."), Between(0, 5)] = 1.0
    noisiest: Annotated[float, Doc("Share of the objects that get pure noise."), Between(0, 1)] = 0.3
    dropout: Annotated[float, Doc("Share taught without photo tokens, latent, or both (each)."), Between(0, 0.3)] = 0.05
    guidance: Annotated[float, Doc("Of the teacher in stage distill; 1: none."), Between(1, 20)] = 1.0
    views: Annotated[tuple[str, ...], Doc("Views to learn; the first takes the photo.")] = HORIZONTAL
    elevation: Annotated[float, Doc("Greatest height of the photos' camera, degrees."), Between(0, 89)] = 35.0
    facing: Annotated[float, Doc("Share of photos taken from about an object's own front."), Between(0, 1)] = 0.3
    least: Annotated[float, Doc("Smallest radius of an object; the largest is 1."), Between(0.05, 1)] = 0.45
    lighting: Annotated[Lighting, Doc("Drawn at random, the same for all, or none: albedo.")] = "random"
    backgrounds: Annotated[tuple[str, ...], Doc("What objects lie on, drawn at random: white, black, grey.")] = (
        "white",
        "black",
        "grey",
    )
    clean: Annotated[bool, Doc("Objects as they stand, on white, in studio light, nothing spoilt.")] = False
    reuse: Annotated[int, Doc("Steps for which each drawn example serves."), Between(1, 1000)] = 4
    procedural: Annotated[int, Doc("Objects of our own beside the data."), Between(0, 1_000_000)] = 0
    up: Annotated[Up, Doc("The meshes' up axis; auto: y in glTF and OBJ, z in PLY, STL and scanned sets.")] = "auto"
    seed: Annotated[int, Doc("Seed of everything random."), Between(0, 2**31)] = 0
    precision: Annotated[
        Precision, Doc("Of the products; auto: bf16 where it is the quicker. Weights are fp32 in any case.")
    ] = "auto"
    half: Annotated[bool, Doc("Store the model's weights in fp16, half the size.")] = False
    validation: Annotated[Path | None, Doc("Meshes to validate on; else some are held out of the data."), Runtime()] = (
        None
    )
    validate_every: Annotated[int, Doc("Steps between validations; 0: only at the end."), Between(0, 10**8)] = 1000
    jobs: Annotated[
        int | None,
        Doc("Processes that draw; 0: none of their own. By default as many as seem useful."),
        Between(0, 256),
        Runtime(),
    ] = None
    save_every: Annotated[float, Doc("Seconds between checkpoints."), Between(0, 1e6), Runtime()] = 120.0
    device: Annotated[Device, Doc("Where to train; auto: a GPU where there is one."), Runtime()] = "auto"


def run(config: Config, inputs: Sequence[Path], tell: Tell = silent, beside: Path | None = None) -> Artifact | None:
    """The model, as an artifact; None in all but the first of several processes.

    A paused training of other settings in the folder `beside` is refused: it would not be gone on with.

    Raises UsageError, MissingInput, BadWeights, and WorkFailed when the loss is no longer a number.
    """
    check(config)
    seconds_of(config.max_time)
    _check_backgrounds(config.backgrounds)
    from mv3d_cli.steps.train.course import run_in_team

    return run_in_team(config, inputs, tell, beside)


def _check_backgrounds(names: Sequence[str]) -> None:
    """Raises UsageError."""
    from mv3d_cli.capture.examples import BACKGROUNDS

    unknown = [name for name in names if name not in BACKGROUNDS]
    if unknown or not names:
        what = f"there is no background {unknown[0]}" if unknown else "--backgrounds names none"
        raise UsageError(what, f"choose from {', '.join(BACKGROUNDS)}")


def seconds_of(time: str | None) -> float | None:
    """90, 90s, 9m or 2h in seconds. Raises UsageError."""
    if time is None:
        return None
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([smh]?)", time.strip())
    if match is None:
        raise UsageError(f"--max-time {time} is no time", "such as 90s, 9m or 2h")
    return float(match[1]) * {"": 1, "s": 1, "m": 60, "h": 3600}[match[2]]
