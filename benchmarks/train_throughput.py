"""How fast models learn, where the time goes, what it takes in memory, and how that grows.

Real examples of `../shared/objects`, drawn and encoded here one after another; bf16 products. On a GPU too, where there
is one. The last tables use drawn numbers instead of pictures: their cost is the network's alone.

    python benchmarks/train_throughput.py [--repeat 5]
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from mv3d_cli.capture.examples import Drawing
from mv3d_cli.diffusion.model import Model
from mv3d_cli.diffusion.model.config import ModelConfig, small, tiny
from mv3d_cli.diffusion.training.objectives import Batch, DiffusionObjective, Teaching
from mv3d_cli.formats.cameras import load_cameras
from mv3d_cli.formats.meshes import find_meshes
from mv3d_cli.steps.train import Config
from mv3d_cli.steps.train.sources import Source, example_of
from mv3d_cli.steps.train.supply import encoded
from shared_data import shared, table
from training_runs import use_two_threads

BATCH = 8
DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")


def seconds(work: Callable[[], Any], repeat: int) -> float:
    """The median of some runs, after one that warms up."""
    taken = []
    for _ in range(repeat + 1):
        started = time.perf_counter()
        work()
        if DEVICE.type == "cuda":
            torch.cuda.synchronize()
        taken.append(time.perf_counter() - started)
    return float(np.median(taken[1:]))


def drawn_batch(config: ModelConfig, views: int, objects: int) -> Batch:
    """A batch of random numbers of the right shapes."""
    channels, side = config.network["out_channels"], config.network["sample_size"]
    poses = np.stack([camera.world_from_camera for camera in load_cameras(None)[:views]]).astype(np.float32)
    generator = torch.Generator().manual_seed(0)
    return Batch(
        photo=torch.rand(objects, 3, config.picture_size, config.picture_size, generator=generator).to(DEVICE),
        latents=torch.randn(objects, 2, views, channels, side, side, generator=generator).to(DEVICE),
        photo_latent=torch.randn(objects, channels, side, side, generator=generator).to(DEVICE),
        world_from_camera=torch.from_numpy(poses).expand(objects, -1, -1, -1).to(DEVICE),
        seeds=tuple(range(objects)),
    )


def learning(config: ModelConfig, joint: bool, views: int = 8, repeat: int = 3) -> tuple[float, float, float]:
    """(seconds of forward and backward, seconds of the optimizer) for an object, and parameters in millions."""
    model = Model(config).to(DEVICE)
    objective = DiffusionObjective(model, Teaching(joint))
    parameters = objective.parameters_in_training()
    optimizer = torch.optim.AdamW(parameters, fused=True)
    batch = drawn_batch(config, views, BATCH)
    taken = seconds(lambda: objective(batch).backward(), repeat)
    stepping = seconds(optimizer.step, repeat)
    return taken / BATCH, stepping / BATCH, sum(p.numel() for p in parameters) / 1e6


def parts(name: str, config: ModelConfig, repeat: int) -> list[list[object]]:
    """Rows for stages 1 and 2: where an object's time goes."""
    settings, drawing = Config(), Drawing(size=config.picture_size)
    sources = [Source(file.name, "", mesh=file) for file in find_meshes(shared("objects"))[::100]]
    rng = np.random.default_rng(0)
    example_of(sources[0], settings, drawing, rng)
    started = time.perf_counter()
    examples = [example_of(source, settings, drawing, rng) for source in sources]
    rendering = (time.perf_counter() - started) / len(examples)
    tensors = {key: torch.from_numpy(value) for key, value in vars(examples[0]).items()}
    model = Model(config).to(DEVICE)
    encoding = seconds(lambda: encoded(tensors, model, DEVICE, torch.bfloat16), repeat)
    rows = []
    for stage, joint in (("1", False), ("2", True)):
        taken, stepping, parameters = learning(config, joint, repeat=repeat)
        preparing = (rendering + encoding) / settings.reuse
        milliseconds = [f"{1000 * value:.0f}" for value in (rendering, encoding, taken, stepping)]
        rate = 1 / (preparing + taken + stepping)
        rows.append([name, stage, f"{parameters:.1f} M", *milliseconds, f"{rate:.1f}", f"{peak():.1f} GiB"])
    return rows


def peak() -> float:
    """GiB at the peak so far: of the GPU's memory, or of this process."""
    if DEVICE.type == "cuda":
        return torch.cuda.max_memory_allocated() / 2**30
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def growth(repeat: int) -> list[list[object]]:
    """Milliseconds an object (stage 2) against views, latent size, and width."""
    config, rows = small(), []
    for views in (2, 4, 8, 12):
        rows.append(["views", views, learning(config, True, views, repeat)])
    for side in (8, 16, 32):
        network = config.network | {"sample_size": side}
        rows.append(["latents a side", side, learning(replace(config, network=network), True, repeat=repeat)])
    for factor in (0.5, 1, 1.5):
        widths = tuple(int(64 * factor) * 2**level for level in range(3))
        network = config.network | {"block_out_channels": widths}
        rows.append(["width", f"x {factor:g}", learning(replace(config, network=network), True, repeat=repeat)])
    return [[what, n, f"{parameters:.1f} M", f"{1000 * taken:.0f}"] for what, n, (taken, _, parameters) in rows]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeat", type=int, default=3)
    given = parser.parse_args()
    use_two_threads()
    print(f"on {DEVICE}, {torch.get_num_threads()} threads; examples serve {Config().reuse} steps\n")
    rows = parts("tiny, 32 x 32", tiny(), given.repeat) + parts("small, 256 x 256", small(), given.repeat)
    head = ["model", "stage", "parameters", "render ms", "encode ms", "network ms", "optimizer ms"]
    table([*head, "objects/s", "peak memory"], rows)
    print()
    table(["small, stage 2: grows", "to", "parameters", "network ms an object"], growth(given.repeat))


if __name__ == "__main__":
    main()
