"""A model that starts from Stable Diffusion Image Variations, in diffusers' folder layout:

unet/         config.json  diffusion_pytorch_model.safetensors     conv_in is widened from 4 to 8 channels
vae/          config.json  diffusion_pytorch_model.safetensors
image_encoder/config.json  model.safetensors                       CLIP with projection
scheduler/    scheduler_config.json
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from mv3d_cli.diffusion.model import Model
from mv3d_cli.diffusion.model.checkpoint import CONVERT_HINT, empty_model, fill, read_weights
from mv3d_cli.diffusion.model.config import ModelConfig
from mv3d_cli.diffusion.network import reset_additions
from mv3d_cli.diffusion.noise import NoiseSettings
from mv3d_cli.errors import BadWeights, MissingInput

DEFAULT_ID = "lambdalabs/sd-image-variations-diffusers"

_PARTS = {
    "unet": "diffusion_pytorch_model",
    "vae": "diffusion_pytorch_model",
    "image_encoder": "model",
}
# names that the autoencoder's attention had before diffusers 0.15
_OLD_ATTENTION = {"query": "to_q", "key": "to_k", "value": "to_v", "proj_attn": "to_out.0"}


def model_from_stable_diffusion(source: str = DEFAULT_ID, dtype: torch.dtype = torch.float32) -> Model:
    """The `sd` preset's start: a folder's or a hub id's weights, with fresh camera, task and colour-depth layers.

    At the start the network is Stable Diffusion, but for the camera's and the task's share of the time embedding.
    The fresh layers come from torch's global generator. `HF_HOME` and `HF_HUB_OFFLINE` apply, as huggingface_hub asks.
    Raises MissingInput, BadWeights, MissingDependency.
    """
    folder = folder_of(source)
    config = _config(folder)
    model = empty_model(config)
    unet = _weights(folder, "unet")
    unet["conv_in.weight"] = _widened(unet.get("conv_in.weight"), config.network["in_channels"], folder)
    reset_additions(model.network)
    fresh = {name: value for name, value in model.network.unet.state_dict().items() if value.device.type != "meta"}
    fill(model.network.unet, fresh | unet, f"{folder}/unet", dtype)
    fill(model.autoencoder.get_submodule("kl"), _new_attention_names(_weights(folder, "vae")), f"{folder}/vae", dtype)
    clip = _weights(folder, "image_encoder")
    clip.pop("vision_model.embeddings.position_ids", None)  # a constant that old versions saved
    fill(model.encoder.get_submodule("clip"), clip, f"{folder}/image_encoder", dtype)
    return model.to(dtype).eval()


def folder_of(source: str) -> Path:
    """The folder itself, or the hub's copy of it on this disk. Raises MissingInput."""
    folder = Path(source)
    if folder.is_dir():
        return folder
    if not re.fullmatch(r"[\w.-]+/[\w.-]+", source):
        raise MissingInput(f"{source} is no folder", f"give a diffusers folder, or a hub id such as {DEFAULT_ID}")
    from huggingface_hub import snapshot_download

    wanted = [pattern for part in _PARTS for pattern in (f"{part}/*.json", f"{part}/*.safetensors")]
    try:
        return Path(snapshot_download(source, allow_patterns=[*wanted, "scheduler/*.json"]))
    except (OSError, ValueError) as error:  # the hub's own errors are among these
        raise MissingInput(
            f"{source} is neither a folder here, nor in the hub's cache, nor could it be downloaded",
            f"with a network, run: hf download {source}; then it is found, also with HF_HUB_OFFLINE=1",
        ) from error


def _config(folder: Path) -> ModelConfig:
    unet, vae, clip = (_json(folder / part / "config.json") for part in _PARTS)
    scheduler = _json(folder / "scheduler" / "scheduler_config.json")
    if scheduler.get("beta_schedule") != "scaled_linear":
        raise BadWeights(
            f"{folder} was trained with the noise schedule {scheduler.get('beta_schedule')}",
            f"give a Stable Diffusion Image Variations folder, such as {DEFAULT_ID}",
        )
    channels = unet.get("out_channels", 4)
    names = {"num_train_timesteps": "timesteps", "beta_start": "beta_start", "beta_end": "beta_end"}
    noise = NoiseSettings(
        curve="scaled_linear",
        zero_terminal=scheduler.get("rescale_betas_zero_snr", False),
        prediction=scheduler.get("prediction_type", "epsilon"),
        **{ours: scheduler[theirs] for theirs, ours in names.items() if theirs in scheduler},
    )
    return ModelConfig(network=unet | {"in_channels": 2 * channels}, autoencoder=vae, clip=clip, noise=noise)


def _json(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise MissingInput(f"{path} is missing", f"give a folder in diffusers' layout, such as the hub's {DEFAULT_ID}")
    try:
        return json.loads(path.read_text())
    except ValueError as error:
        raise BadWeights(f"{path} is not JSON: {error}", "download the folder again") from error


def _weights(folder: Path, part: str) -> dict[str, Tensor]:
    stem = folder / part / _PARTS[part]
    candidates = [stem.with_name(f"{stem.name}{suffix}.safetensors") for suffix in ("", ".fp16")]
    for path in candidates:
        if path.is_file():
            return read_weights(path)
    if stem.with_suffix(".bin").is_file():
        return read_weights(stem.with_suffix(".bin"))  # refused there, with the reason
    raise MissingInput(f"{candidates[0]} is missing", f"if {part} has only .bin weights, convert them: {CONVERT_HINT}")


def _widened(weight: Tensor | None, channels: int, folder: Path) -> Tensor:
    """The first convolution's weight for more channels, which it ignores at first."""
    if weight is None or weight.ndim != 4 or weight.shape[1] > channels:
        raise BadWeights(f"{folder}/unet has no usable conv_in.weight", "download the folder again")
    return nn.functional.pad(weight, (0, 0, 0, 0, 0, channels - weight.shape[1]))


def _new_attention_names(state: dict[str, Tensor]) -> dict[str, Tensor]:
    pattern = re.compile(rf"\.attentions\.0\.({'|'.join(_OLD_ATTENTION)})\.")
    return {
        pattern.sub(lambda match: f".attentions.0.{_OLD_ATTENTION[match[1]]}.", name): value
        for name, value in state.items()
    }
