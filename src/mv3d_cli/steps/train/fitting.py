"""The autoencoder's stage: its directions are fitted, in one go, to some of what is learnt from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from mv3d_cli.diffusion.autoencoder import Projection
from mv3d_cli.diffusion.generation import Sampling
from mv3d_cli.diffusion.model.checkpoint import AUTOENCODER, save_model
from mv3d_cli.formats.images import write_png
from mv3d_cli.steps.train.learning import Learning, held_out_examples, write_record
from mv3d_cli.steps.train.supply import drawing_of
from mv3d_cli.steps.train.validation import examples_for, pictures_of, validated

TYPICAL = 300  # objects, at most
TAKEN = 4  # pictures of each


def fit_autoencoder(learning: Learning, folder: Path) -> None:
    """Writes a model folder that keeps the autoencoder alone. Raises MissingInput where no object can be used."""
    model, sources = learning.start.model.to(learning.team.device), learning.sources
    assert isinstance(model.autoencoder, Projection)
    some = sources[:: -(-len(sources) // TYPICAL)]
    drawing = replace(drawing_of(learning.config, model.config), drafts=False)
    examples = examples_for(some, learning.config, drawing, "learn from")
    pictures = [pictures_of(example) for example in examples]
    chosen = [of_one[number % 2 :: max(len(of_one) // TAKEN, 1)] for number, of_one in enumerate(pictures)]
    model.autoencoder.fit(torch.cat(chosen).to(learning.team.device))
    score = validated(model.eval(), held_out_examples(learning, model), AUTOENCODER, Sampling())
    done = {
        "stage": AUTOENCODER,
        "objects": len(examples),
        "psnr": round(score.psnr, 3),
        "depth_error": round(score.depth, 4),
    }
    record = [*learning.start.record, done]
    (folder / "validation").mkdir(exist_ok=True)
    write_png(folder / "validation" / "autoencoder.png", score.sheet)
    save_model(model, folder, record=record, part=AUTOENCODER)
    write_record(learning, folder, record, paused=False)
