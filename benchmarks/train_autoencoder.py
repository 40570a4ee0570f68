"""How much the small model's autoencoder keeps: pictures of scans it was never taught with, there and back.

PSNR of colours (8 views, 256 x 256, on white), mean absolute depth error inside the true outline; and what fewer of
the directions would keep.

    python benchmarks/train_autoencoder.py [--model FOLDER]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

from mv3d_cli.diffusion.autoencoder import Projection
from mv3d_cli.diffusion.generation import Sampling
from mv3d_cli.diffusion.model.checkpoint import load_model
from mv3d_cli.formats.assets import asset
from mv3d_cli.steps.train.start import BUNDLED_AUTOENCODER
from mv3d_cli.steps.train.validation import answer_of, view_scores
from shared_data import table
from training_runs import scanned_examples, use_two_threads


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", type=Path, default=asset(BUNDLED_AUTOENCODER))
    model = load_model(parser.parse_args().model)
    use_two_threads()
    examples, rows = scanned_examples(model.config.picture_size), []
    autoencoder = model.autoencoder
    assert isinstance(autoencoder, Projection)
    basis, channels = autoencoder.basis.clone(), len(autoencoder.basis)
    for kept in (channels // 4, channels // 2, channels):
        autoencoder.basis.copy_(basis * (torch.arange(channels) < kept)[:, None])
        found = [view_scores(*answer_of("autoencoder")(model, e, Sampling()), e) for e in examples]
        (psnr, depth), worst = np.mean(found, axis=0), np.min(found, axis=0)[0]
        numbers = kept * model.config.network["sample_size"] ** 2
        rows.append([kept, numbers, f"{psnr:.2f}", f"{worst:.2f}", f"{depth:.3f}"])
    table(["directions", "numbers a picture", "PSNR dB", "worst scan", "depth error"], rows)
    print("\ntarget: at least 30 dB")


if __name__ == "__main__":
    main()
