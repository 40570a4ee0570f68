"""Model folders: `config.json` and `model.safetensors`, which carries the configuration in its metadata too.

Nothing but safetensors is read: a pickle can run code.
"""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch
from accelerate import init_empty_weights
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from mv3d_cli.diffusion.model import Model
from mv3d_cli.diffusion.model.config import ModelConfig, config_from_text, text_from_config
from mv3d_cli.errors import BadWeights, MissingInput, OutOfSpace

CONFIG, WEIGHTS = "config.json", "model.safetensors"
AUTOENCODER = "autoencoder"  # the part of a model that can be kept alone


def save_model(
    model: Model,
    folder: Path,
    dtype: torch.dtype | None = None,
    record: Sequence[Mapping[str, Any]] = (),
    part: str = "",
) -> None:
    """Write a model folder, its weights in `dtype` if given; an older one stays whole until the new one is complete.

    `record` tells of the model's training, stage by stage. With `part`, such as "autoencoder", only that part's
    weights are kept: the others are drawn anew on loading. Raises OutOfSpace.
    """
    text = text_from_config(model.config)
    kept = {name: value for name, value in model.state_dict().items() if name.startswith(part)}
    weights = {name: value.detach().to("cpu", dtype).contiguous() for name, value in kept.items()}
    metadata = {"config": text, "training": json.dumps(list(record), sort_keys=True)}

    def write(path: Path) -> None:
        save_file(weights, path, metadata=metadata)
        _put_in_order(path)

    folder.mkdir(parents=True, exist_ok=True)
    written_whole(folder / WEIGHTS, write)
    written_whole(folder / CONFIG, lambda path: path.write_text(text))


def _put_in_order(path: Path) -> None:
    """Sort a safetensors file's metadata, which is written in an order of chance: the same model is the same bytes."""
    with path.open("r+b") as file:
        size = int.from_bytes(file.read(8), "little")
        header = json.loads(file.read(size))
        header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
        file.seek(8)
        file.write(json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode().ljust(size))


def load_model(source: Path, dtype: torch.dtype = torch.float32) -> Model:
    """The model of a folder, or of a weights file alone.

    Raises MissingInput without configuration or weights, BadWeights for weights that are damaged or of other shapes.
    """
    path = weights_of(source)
    if source.is_dir() and not (source / CONFIG).is_file():
        raise MissingInput(f"the model folder {source} has no {CONFIG}", "give the folder that `mv3d train` wrote")
    state = read_weights(path)
    config = _config_of_folder(source) if source.is_dir() else _config_of_file(path)
    if state and all(name.startswith(f"{AUTOENCODER}.") for name in state):
        return _with_autoencoder(config, state, path, dtype)
    model = empty_model(config)
    fill(model, state, str(path), dtype)
    return model.eval()


def _with_autoencoder(config: ModelConfig, state: Mapping[str, Tensor], path: Path, dtype: torch.dtype) -> Model:
    """A model of which only the autoencoder has been taught; the rest comes from torch's global generator."""
    empty_model(config)  # says what is wrong with it
    model = Model(config)
    inner = {name.removeprefix(f"{AUTOENCODER}."): value for name, value in state.items()}
    fill(model.autoencoder, inner, str(path), dtype)
    return model.to(dtype).eval()


def weights_of(source: Path) -> Path:
    """Where the weights of a model folder, or of a weights file, are."""
    return source / WEIGHTS if source.is_dir() else source


def record_of_weights(path: Path) -> list[dict[str, Any]]:
    """What a weights file tells of its training, stage by stage; empty where it tells nothing."""
    with safe_open(path, framework="pt") as file:
        told = (file.metadata() or {}).get("training", "[]")
    return json.loads(told)


def read_weights(path: Path) -> dict[str, Tensor]:
    """All tensors of a safetensors file. Raises MissingInput, BadWeights."""
    if not path.is_file():
        raise MissingInput(f"there are no weights at {path}", "give a model folder with its .safetensors file")
    if path.suffix != ".safetensors":
        raise BadWeights(
            f"{path} is not a safetensors file, and pickled weights can run code", f"convert it: {CONVERT_HINT}"
        )
    try:
        with safe_open(path, framework="pt") as file:
            return {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  it is no mapping
    except (SafetensorError, OSError) as error:
        raise BadWeights(f"the weights in {path} are damaged: {error}", "download or copy the file again") from error


CONVERT_HINT = (
    "in Python, where you trust the file, diffusers.StableDiffusionImageVariationPipeline.from_pretrained(SOURCE)"
    ".save_pretrained(FOLDER), then give FOLDER"
)


def empty_model(config: ModelConfig) -> Model:
    """A model whose parameters have shapes but no values (nor memory) yet. Raises BadWeights."""
    try:
        with init_empty_weights():
            return Model(config)
    except (TypeError, ValueError, KeyError, RuntimeError, ZeroDivisionError) as error:
        raise BadWeights(f"the configuration describes no model: {error}", "copy the model folder again") from error


def fill(module: nn.Module, state: Mapping[str, Tensor], name: str, dtype: torch.dtype) -> None:
    """Put values, cast to `dtype`, into an empty module. Raises BadWeights when names or shapes differ."""
    expected = module.state_dict()
    missing, unknown = sorted(expected.keys() - state.keys()), sorted(state.keys() - expected.keys())
    if missing or unknown:
        kind, names = ("lack", missing) if missing else ("have an unknown", unknown)
        raise BadWeights(
            f"the weights in {name} {kind} {names[0]} (and {len(names) - 1} more)",
            "they belong to another model: give weights and configuration of one model",
        )
    for key, value in state.items():
        if value.shape != expected[key].shape:
            raise BadWeights(
                f"in {name}, {key} is {tuple(value.shape)}; the configuration says {tuple(expected[key].shape)}",
                "give weights and configuration of one model",
            )
    module.load_state_dict({key: value.to(dtype) for key, value in state.items()}, assign=True)


def _config_of_folder(folder: Path) -> ModelConfig:
    return config_from_text((folder / CONFIG).read_text(errors="replace"), str(folder / CONFIG))


def _config_of_file(path: Path) -> ModelConfig:
    with safe_open(path, framework="pt") as file:
        metadata = file.metadata() or {}
    if "config" not in metadata:
        raise MissingInput(f"{path} carries no configuration", "give the whole model folder")
    return config_from_text(metadata["config"], str(path))


def written_whole(path: Path, write: Callable[[Path], object]) -> None:
    """Write to a temporary sibling, sync, rename: until then an older file stays as it was. Raises OutOfSpace."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        write(temporary)
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    except (OSError, SafetensorError) as error:
        if getattr(error, "errno", None) == errno.ENOSPC or f"os error {errno.ENOSPC}" in str(error):
            raise OutOfSpace(f"no space left for {path}", "free some space and run it again") from error
        raise
    finally:
        with suppress(FileNotFoundError):
            temporary.unlink()
