"""What a training starts from: another model, Stable Diffusion, or nothing."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from mv3d_cli.diffusion.autoencoder import Folding
from mv3d_cli.diffusion.model import Model
from mv3d_cli.diffusion.model.checkpoint import AUTOENCODER, load_model, record_of_weights, weights_of
from mv3d_cli.diffusion.model.config import small, text_from_config, tiny
from mv3d_cli.diffusion.model.stable_diffusion import DEFAULT_ID, folder_of, model_from_stable_diffusion
from mv3d_cli.errors import UsageError
from mv3d_cli.formats.assets import asset
from mv3d_cli.store import canonical_json, digest_of_file, digest_of_folder

if TYPE_CHECKING:
    from mv3d_cli.steps.train import Config

BUNDLED_AUTOENCODER = "weights/autoencoder"  # of the small model, so that nobody has to train it first


@dataclass(frozen=True)
class Start:
    """A model to go on from: its digest, the record of its training so far, and where it lay."""

    model: Model
    digest: str
    record: list[dict[str, Any]]
    place: str = ""


def start_of(config: Config) -> Start:
    """The start that the settings ask for. Raises UsageError, MissingInput, BadWeights, MissingDependency."""
    start = _given(config) if config.from_ or config.preset == "sd" else _fresh(config)
    learnt = {done["stage"] for done in start.record}
    bare = isinstance(start.model.autoencoder, Folding)
    if config.stage == AUTOENCODER and (bare or start.model.config.clip):
        raise UsageError("this model has no autoencoder to train", "begin with --stage 1")
    if config.stage == "distill" and not learnt & {"1", "2"}:
        raise UsageError("there is nothing to distill yet", "train stages 1 and 2 first, then --from that model")
    return start


def rate_of(config: Config, model: Model) -> float:
    """The learning rate: the one given, or the stage's."""
    if config.lr is not None or config.stage == AUTOENCODER:  # which is fitted in closed form
        return config.lr or 0.0
    if model.config.clip:
        return {"1": 1e-4, "2": 5e-5, "distill": 1e-5}[config.stage]
    return {"1": 5e-4, "2": 5e-4, "distill": 5e-5}[config.stage]


def _given(config: Config) -> Start:
    """The model of a folder of ours, or of one in diffusers' layout."""
    source = config.from_ or DEFAULT_ID
    folder = Path(source)
    if (folder / "unet").is_dir() or (config.preset == "sd" and not weights_of(folder).is_file()):
        torch.manual_seed(config.seed)
        return Start(model_from_stable_diffusion(source), digest_of_folder(folder_of(source)), [], source)
    return _loaded(folder, config)


def _loaded(folder: Path, config: Config) -> Start:
    torch.manual_seed(config.seed)
    model, weights = load_model(folder), weights_of(folder)
    return Start(model, digest_of_file(weights), record_of_weights(weights), str(weights))


def _fresh(config: Config) -> Start:
    """A network that knows nothing, drawn from the seed, and the autoencoder that comes with the package."""
    if config.preset == "small" and config.stage != AUTOENCODER:
        return _loaded(asset(BUNDLED_AUTOENCODER), config)
    made = {"small": small, "tiny": tiny}[config.preset]()
    torch.manual_seed(config.seed)
    return Start(Model(made), canonical_json(json.loads(text_from_config(made))), [])
