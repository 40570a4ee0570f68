"""A model of Stable Diffusion's full size on a CPU, in bf16: eight views of 256², colour and depth, in four steps.

Weights are random, in a float16 folder of diffusers' layout that is written first and read by our own loader. Beside
joint attention stands the naive formulation, in which every view attends to a copy of all views' keys and values of its
own: once through the same attention kernel, and once with all attention weights in memory at a time. Each runs in a
process of its own, since a process's peak of memory never falls, and all must give the same answer to the first pass.

The last line says what the arithmetic alone would take at the speed of a large matrix product on this machine.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import torch
from diffusers import AutoencoderKL, PNDMScheduler, UNet2DConditionModel
from torch import Tensor
from torch.nn import functional
from torch.utils.flop_counter import FlopCounterMode
from transformers import CLIPVisionConfig, CLIPVisionModelWithProjection

from mv3d_cli.diffusion.model.checkpoint import empty_model
from mv3d_cli.diffusion.model.config import ModelConfig
from mv3d_cli.diffusion.model.stable_diffusion import model_from_stable_diffusion
from mv3d_cli.diffusion.network import guided
from mv3d_cli.diffusion.network.blocks import Arrangement, MultiViewBlock
from mv3d_cli.diffusion.network.conditioning import COLOUR, DEPTH, Condition
from mv3d_cli.diffusion.sampling import initial_noise, lcm, trailing_timesteps
from mv3d_cli.formats.cameras import load_cameras
from shared_data import table

VIEWS, STEPS, SIZE = 8, 4, 256
LATENTS = (1, 2, VIEWS, 4, SIZE // 8, SIZE // 8)
TARGET_SECONDS, TARGET_GIB = 45.0, 6e9 / 2**30
TOLERANCE = 0.05  # of the answer's deviation, in bf16
UNET = {"sample_size": 64, "block_out_channels": (320, 640, 1280, 1280), "cross_attention_dim": 768}
UNET |= {"attention_head_dim": 8}  # diffusers' name for the number of heads; the rest is its default
VAE = {"sample_size": 512, "block_out_channels": (128, 256, 512, 512), "layers_per_block": 2, "latent_channels": 4}
VAE |= {"down_block_types": ("DownEncoderBlock2D",) * 4, "up_block_types": ("UpDecoderBlock2D",) * 4}
CLIP = {"hidden_size": 1024, "intermediate_size": 4096, "num_hidden_layers": 24, "num_attention_heads": 16}
CLIP |= {"image_size": 224, "patch_size": 14, "projection_dim": 768}


def write_folder(folder: Path) -> None:
    """Stable Diffusion Image Variations with random weights."""
    torch.manual_seed(0)
    torch.set_default_dtype(torch.float16)
    unet = UNet2DConditionModel(**UNET)
    for name, parameter in unet.named_parameters():
        if name.endswith(("attn1.to_q.weight", "attn1.to_out.0.weight")):
            parameter.data *= 4  # as drawn, self-attention is too faint to be told from rounding
    unet.save_pretrained(folder / "unet", variant="fp16")
    AutoencoderKL(**VAE).save_pretrained(folder / "vae", variant="fp16")
    CLIPVisionModelWithProjection(CLIPVisionConfig(**CLIP)).save_pretrained(folder / "image_encoder")
    schedule = PNDMScheduler(beta_schedule="scaled_linear", beta_start=0.00085, beta_end=0.012)
    schedule.save_pretrained(folder / "scheduler")


def with_copies(attention: Callable[[Tensor, Tensor, Tensor], Tensor]) -> Callable[..., Tensor]:
    """The `MultiViewBlock._across_views` that repeats keys and values for each view."""

    def across_views(block: MultiViewBlock, hidden: Tensor, arrangement: Arrangement) -> Tensor:
        layer, views = block.attn1, arrangement.views if arrangement.across_views else 1
        rows, tokens, channels = hidden.shape
        normed = block._placed(block.norm1(hidden))

        def heads(values: Tensor) -> Tensor:
            return values.unflatten(-1, (layer.heads, -1)).transpose(1, 2)

        def copies(values: Tensor) -> Tensor:
            return values.reshape(rows // views, views * tokens, channels).repeat_interleave(views, dim=0)

        key, value = copies(layer.to_k(normed)), copies(layer.to_v(normed))
        attended = attention(heads(layer.to_q(normed)), heads(key), heads(value))
        return layer.to_out[0](attended.transpose(1, 2).flatten(2))

    return across_views


def with_all_weights(query: Tensor, key: Tensor, value: Tensor) -> Tensor:
    return (query @ key.transpose(-1, -2) * query.shape[-1] ** -0.5).softmax(-1) @ value


FORMULATIONS = {
    "ours": MultiViewBlock._across_views,
    "naive": with_copies(functional.scaled_dot_product_attention),
    "naive, weights in memory": with_copies(with_all_weights),
}


@contextmanager
def formulated(name: str) -> Iterator[None]:
    before = MultiViewBlock._across_views
    MultiViewBlock._across_views = FORMULATIONS[name]
    try:
        yield
    finally:
        MultiViewBlock._across_views = before


def poses() -> Tensor:
    return torch.tensor(np.stack([c.world_from_camera for c in load_cameras(None)[:VIEWS]])[None], dtype=torch.float32)


@dataclass
class Record:
    """What one process measured: seconds and the peak by the end of each stage, seconds of each pass."""

    seconds: dict[str, float] = field(default_factory=dict)
    peaks: dict[str, float] = field(default_factory=dict)
    passes: list[float] = field(default_factory=list)

    @contextmanager
    def stage(self, what: str) -> Iterator[None]:
        started = time.perf_counter()
        yield
        self.seconds[what] = time.perf_counter() - started
        self.peaks[what] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


@torch.no_grad()
def measure(folder: Path, name: str) -> None:
    """Load, sample and decode in this process; prints the record as JSON, leaves the first pass's answer."""
    torch.manual_seed(0)  # of the layers that Stable Diffusion lacks
    record, answers = Record(), []
    with record.stage("load"):
        model = model_from_stable_diffusion(str(folder), torch.bfloat16)
    with record.stage("photo"):
        photo = functional.interpolate(initial_noise((1, 3, 8, 8), 1, poses()), (SIZE, SIZE), mode="bilinear")
        condition = model.condition(photo.clamp(-1, 1), poses(), torch.tensor([[COLOUR, DEPTH]]))
    predict, noise = guided(model.network, condition), initial_noise(LATENTS, 2, poses())

    def timed(latents: Tensor, timestep: int) -> Tensor:
        started = time.perf_counter()
        answers.append(predict(latents, timestep))
        record.passes.append(time.perf_counter() - started)
        return answers[-1]

    timesteps, generator = trailing_timesteps(model.schedule, STEPS), torch.Generator().manual_seed(3)
    with record.stage("steps"):
        *_, last = lcm(timed, noise, model.schedule, timesteps, generator)
    with record.stage("decode"):
        pictures = model.autoencoder.decode(last.clean)
    assert pictures.shape == (*LATENTS[:3], 3, SIZE, SIZE)
    torch.save(answers[0], folder / f"{name}.pt")
    if name == "ours":
        alone = model.network(noise.bfloat16(), torch.tensor(timesteps[:1]), condition, across_views=False)
        torch.save(alone.float(), folder / "alone.pt")
    print(json.dumps(asdict(record)))


def in_own_process(folder: Path, name: str) -> str:
    """The last line that this script prints there. This process stays small: a child's peak begins at its parent's."""
    command = [sys.executable, __file__, "--in-process", name, "--folder", str(folder)]
    output = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
    return output.strip().rpartition("\n")[2]


def tera_operations() -> float:
    """10^12 additions and multiplications of all passes and all decoding, counted without doing them."""
    model = empty_model(ModelConfig(UNET | {"in_channels": 8}, VAE, clip=CLIP))
    latents = torch.empty(LATENTS, device="meta")
    tokens = torch.empty(1, 1, UNET["cross_attention_dim"], device="meta")
    condition = Condition(latents[:, 0, 0], tokens, poses(), torch.tensor([[COLOUR, DEPTH]]))
    with torch.no_grad(), FlopCounterMode(display=False) as one_pass:
        model.network(latents, torch.zeros(1, device="meta"), condition)
    with torch.no_grad(), FlopCounterMode(display=False) as decoding:
        model.autoencoder.kl.decode(latents.flatten(0, 2))
    return (STEPS * one_pass.get_total_flops() + decoding.get_total_flops()) / 1e12


def best_rate(side: int = 4096) -> float:
    """10^12 operations a second of a large bf16 matrix product, the best of three."""
    factor = torch.ones(side, side, dtype=torch.bfloat16)
    seconds = []
    for _ in range(3):
        started = time.perf_counter()
        factor @ factor
        seconds.append(time.perf_counter() - started)
    return 2 * side**3 / min(seconds) / 1e12


def check_answers(folder: Path, names: Sequence[str]) -> None:
    """All formulations agree on the first pass, and better than with views that do not see each other."""
    answers = {name: torch.load(folder / f"{name}.pt") for name in (*names, "alone")}

    def apart(name: str) -> float:
        return ((answers[name] - answers["ours"]).abs().mean() / answers["ours"].std()).item()

    found = {name: apart(name) for name in (*names[1:], "alone")}
    print("first pass, mean difference from ours: " + ", ".join(f"{name} {100 * d:.2f} %" for name, d in found.items()))
    assert all(found[name] < min(TOLERANCE, found["alone"] / 3) for name in names[1:]), "the formulations differ"


def row(name: str, found: Record) -> list[str]:
    seconds, one_pass = found.seconds, np.median(found.passes[1:])
    times = seconds["load"], one_pass, seconds["steps"], seconds["decode"], seconds["steps"] + seconds["decode"]
    return [name, *(f"{s:.1f}" for s in times), f"{max(found.peaks.values()):.2f}"]


def report(found: dict[str, Record]) -> None:
    head = ["attention across views", "load s", "s per U-Net pass", "4 steps s", "decode s", "total s", "peak GiB"]
    rows = [row(name, record) for name, record in found.items()]
    table(head, rows)
    for name, record in found.items():
        print(f"{name}: peak GiB after " + ", ".join(f"{what} {gib:.2f}" for what, gib in record.peaks.items()))
    totals, peaks = ([float(line[place]) for line in rows] for place in (-2, -1))
    for name, total, peak in list(zip(found, totals, peaks, strict=True))[1:]:
        print(f"{name} / ours: {total / totals[0]:.2f} of the time, {peak / peaks[0]:.2f} of the memory")
    for what, here, target in (("s", totals[0], TARGET_SECONDS), ("GiB", peaks[0], TARGET_GIB)):
        print(f"ours {here:.1f} {what}, target {target:.1f} {what}: {'met' if here <= target else 'missed'}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="without the formulation that keeps attention weights")
    parser.add_argument("--in-process", help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.in_process:
        if given.in_process == "write":
            return write_folder(given.folder)
        with formulated(given.in_process):
            return measure(given.folder, given.in_process)
    names = list(FORMULATIONS)[: 2 if given.quick else None]
    with tempfile.TemporaryDirectory(prefix="mv3d-sd-") as scratch:
        in_own_process(Path(scratch), "write")
        found = {name: Record(**json.loads(in_own_process(Path(scratch), name))) for name in names}
        report(found)
        check_answers(Path(scratch), names)
    work, rate = tera_operations(), best_rate()
    print(f"{work:.1f} 10^12 operations; at the {1000 * rate:.0f} GFLOPS of a bf16 product: {work / rate:.0f} s")


if __name__ == "__main__":
    main()
