"""`mv3d render`: meshes become views.

One mesh becomes a views folder. Several, a folder of meshes, `--procedural` or `--rotations` become a data set: a
views folder per object and turn, `index.json` with what is there and `failures.json` with what is not, and why.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from mv3d_cli.steps.settings import Between, Doc, Runtime, Tell, Warned, check, key_config, silent
from mv3d_cli.store import Artifact, Recipe, digest_of_file, produce

VERSION = 1  # bumped when the same settings and inputs give other bytes

Lighting = Literal["random", "studio", "none"]
Engine = Literal["raster", "blender"]
Workers = Literal["processes", "ray"]
Device = Literal["cpu", "cuda"]
Up = Literal["auto", "y", "z"]


@dataclass(frozen=True)
class Config:
    """Settings of `mv3d render`."""

    size: Annotated[int, Doc("Picture side in pixels."), Between(8, 8192)] = 512
    views: Annotated[tuple[str, ...], Doc("Views to draw, such as front,right; all of the rig if not given.")] = ()
    cameras: Annotated[Path | None, Doc("Cameras file instead of the bundled rig."), Runtime()] = None
    lighting: Annotated[Lighting, Doc("Drawn per object from the seed, the same for all, or none: albedo.")] = "random"
    rotations: Annotated[int, Doc("Random turns of each object; 0 leaves it as it stands."), Between(0, 1000)] = 0
    tilt: Annotated[float, Doc("Most that a random turn tips the object over, degrees."), Between(0, 180)] = 30.0
    seed: Annotated[int, Doc("Seed of lights, turns and procedural objects."), Between(0, 2**31)] = 0
    procedural: Annotated[int, Doc("Make this many objects of our own."), Between(0, 1_000_000)] = 0
    up: Annotated[Up, Doc("The meshes' up axis; auto: y in glTF and OBJ, z in PLY, STL and scanned sets.")] = "auto"
    engine: Annotated[Engine, Doc("Our rasteriser, or Blender Cycles (extra: blender).")] = "raster"
    samples: Annotated[int, Doc("Cycles samples a pixel."), Between(1, 4096)] = 32
    jobs: Annotated[int, Doc("Worker processes of a batch; 0: one per processor."), Between(0, 256), Runtime()] = 0
    workers: Annotated[Workers, Doc("Of a batch: processes here, or the Ray cluster of RAY_ADDRESS."), Runtime()] = (
        "processes"
    )
    device: Annotated[Device, Doc("Where the rasteriser runs."), Runtime()] = "cpu"


def run(config: Config, inputs: Sequence[Path], tell: Tell = silent) -> Artifact:
    """The views of the meshes, as an artifact: a views folder, or a data-set folder.

    Raises UsageError, MissingInput, BadMesh, BadCameras; in a batch a bad mesh is an entry of failures.json.
    """
    check(config)
    from mv3d_cli.steps.render import objects

    objects.check_device(config)
    rig = objects.rig_of(config)
    work = objects.work_of(config, inputs)
    digests = {item.label: item.digest for item in work}
    if config.cameras is not None:
        digests["cameras"] = digest_of_file(config.cameras)
    sources = {item.label: str(item.source) for item in work if item.source is not None}
    batch = objects.is_batch(config, inputs, work)
    recipe = Recipe("render", VERSION, key_config(config) | {"batch": batch}, digests, sources=sources)
    if batch:
        build = partial(objects.render_all, config, rig, work, tell=tell)
    else:
        build = partial(objects.render_one, config, rig, work[0], tell=tell)
    return produce(recipe, build, resumable=batch, device=config.device, on_notice=lambda text: tell(Warned(text)))
