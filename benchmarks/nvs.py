"""How well the other sides of scanned objects are guessed from one picture: the model's views against true renders.

The 18 scans stand as they are, on white, in studio light. The front is given; the 7 other horizontal views are scored
at 256 x 256 (PSNR, SSIM), depth in all 8 (mean absolute error on the true surface, scene units). Beside the model: an
empty picture, the front copied, the draft that the model starts from; what its autoencoder keeps of the truth, and the
true front and back unfolded as `generate` unfolds its own: the ceilings. The numbers that a 2024 report gives for other
systems are quoted: its 30 objects and renders are not these.

    python benchmarks/nvs.py [--model FOLDER] [--sheet PICTURE.png]
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from mv3d_cli.capture.examples import Example, pictures_of
from mv3d_cli.capture.sheet import sheet_of_rows
from mv3d_cli.capture.solid import views_between
from mv3d_cli.diffusion.generation import Sampling
from mv3d_cli.diffusion.model import Model
from mv3d_cli.diffusion.model.checkpoint import load_model, record_of_weights, weights_of
from mv3d_cli.formats.assets import asset
from mv3d_cli.formats.cameras import load_cameras, select
from mv3d_cli.formats.images import write_png
from mv3d_cli.metrics.depth import depth_error
from mv3d_cli.metrics.image import psnr, ssim
from mv3d_cli.scene.views import View
from mv3d_cli.steps.generate import HORIZONTAL, Config
from mv3d_cli.steps.generate.making import views_by
from mv3d_cli.steps.settings import silent
from mv3d_cli.steps.train.validation import answer_of
from shared_data import table
from training_runs import FARTHEST, scanned_examples, use_two_threads

QUOTED = {"Zero-1-to-3": 19.27, "SyncDreamer": 20.10, "the report": 25.27, "Wonder3D": 26.44}
"""PSNR in the report's table 1."""
STEPS = (1, 2, 4, 8, 16)

Views = tuple[np.ndarray, np.ndarray]
"""(colours, depths) of an example's views."""


def scored(name: str, examples: list[Example], answer: Callable[[Example], Views]) -> list[object]:
    """A row of the table."""
    found, started = [], time.perf_counter()
    for example in examples:
        color, depth = answer(example)
        pairs = [*zip(color[1:], example.color[1:], strict=True)]
        likeness = [(psnr(opaque(ours), opaque(true)), ssim(opaque(ours), opaque(true))) for ours, true in pairs]
        found.append((*np.mean(likeness, axis=0), depth_error(depth, example.depth)))
    seconds = (time.perf_counter() - started) / len(examples)
    mean = np.mean(found, axis=0)
    return [name, f"{mean[0]:.2f}", f"{mean[1]:.3f}", f"{mean[2]:.3f}", f"{seconds:.2f}"]


def opaque(color: np.ndarray) -> np.ndarray:
    return np.dstack([color, np.full(color.shape[:2], 255, np.uint8)])


def empty(example: Example) -> Views:
    return np.full_like(example.color, 255), np.full_like(example.depth, 2.0)


def copied(example: Example) -> Views:
    return np.repeat(example.photo[None], len(example.color), axis=0), np.full_like(example.depth, 2.0)


def drafted(example: Example) -> Views:
    assert example.draft_color is not None
    assert example.draft_depth is not None
    return example.draft_color, np.where(example.draft_depth > 0, example.draft_depth, FARTHEST)


def unfolded_truth(example: Example) -> Views:
    """The views of the solid between the true front and back."""
    cameras = select(load_cameras(), HORIZONTAL)
    alpha = np.where(example.depth > 0, 255, 0).astype(np.uint8)[..., None]
    front, back = (
        View(cameras[i], np.concatenate([example.color[i], alpha[i]], axis=-1), example.depth[i]) for i in (0, 1)
    )
    color, depth = pictures_of(views_between(front, back, cameras), 255)
    return color, np.where(depth > 0, depth, FARTHEST)


def kept(model: Model) -> Callable[[Example], Views]:
    """What the autoencoder keeps of the truth."""
    return lambda example: answer_of("autoencoder")(model, example, Sampling())


def generated(model: Model, steps: int) -> Callable[[Example], Views]:
    """What `mv3d generate` makes of the front view and its outline."""
    cameras = select(load_cameras(), HORIZONTAL)

    def answer(example: Example) -> Views:
        photo = np.dstack([example.photo, np.where(example.depth[0] > 0, 255, 0).astype(np.uint8)])
        views = views_by(model, photo, cameras, Config(steps=steps), silent)
        color, depth = pictures_of(views, 255)
        return color, np.where(depth > 0, depth, FARTHEST)

    return answer


def write_sheet(path: Path, examples: list[Example], answer: Callable[[Example], Views]) -> None:
    """True views, drafts and answers of every object."""
    rows = []
    for example in examples:
        rows += [[*map(opaque, part)] for part in (example.color, drafted(example)[0], answer(example)[0])]
    write_png(path, sheet_of_rows(rows))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", type=Path, default=None, help="a model folder; the bundled one if not given")
    parser.add_argument("--sheet", type=Path, help="where to draw all views")
    given = parser.parse_args()
    use_two_threads()
    folder = given.model or asset("weights/small")
    model = load_model(folder)
    examples = scanned_examples(model.config.picture_size, drafts=True)
    rows = [scored("white", examples, empty), scored("the front copied", examples, copied)]
    rows.append(scored("the draft", examples, drafted))
    rows += [scored(f"ours, {n} steps", examples, generated(model, n)) for n in STEPS]
    rows.append(scored("autoencoder's ceiling", examples, kept(model)))
    rows.append(scored("true front and back, unfolded", examples, unfolded_truth))
    rows += [[f"{name} (quoted)", f"{value:.2f}", "", "", ""] for name, value in QUOTED.items()]
    print(json.dumps(record_of_weights(weights_of(folder))))
    table(["7 views of 18 scans", "PSNR dB", "SSIM", "depth error", "seconds an object"], rows)
    if given.sheet:
        write_sheet(given.sheet, examples, generated(model, STEPS[0]))


if __name__ == "__main__":
    main()
