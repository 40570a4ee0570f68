"""A training's state on disk, as safetensors: the parameters, their averages, the optimizer's moments, the step."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from mv3d_cli.diffusion.model.checkpoint import written_whole
from mv3d_cli.diffusion.training import State
from mv3d_cli.errors import DamagedArtifact

_MOMENTS = ("exp_avg", "exp_avg_sq", "step")


def save_state(state: State, path: Path, about: dict[str, Any]) -> None:
    """Write the state, with `about` beside it; an older file stays until the new one is complete. Raises OutOfSpace."""
    optimizer = state.optimizer.state_dict()["state"]
    tensors: dict[str, Tensor] = {}
    for index, (parameter, average) in enumerate(zip(state.parameters, state.average.shadow_params, strict=True)):
        tensors[f"{index}.value"], tensors[f"{index}.average"] = parameter.detach(), average
        tensors |= {f"{index}.{name}": optimizer[index][name] for name in _MOMENTS if index in optimizer}
    tensors = {name: value.cpu().contiguous() for name, value in tensors.items()}
    told = {"step": state.step, "averaged": state.average.optimization_step, "about": about}
    written_whole(path, lambda place: save_file(tensors, place, {"training": json.dumps(told)}))


def load_state(state: State, path: Path) -> dict[str, Any]:
    """Take the state of a file; returns what was written beside it.

    Raises DamagedArtifact for a file that is damaged or of another model.
    """
    try:
        with safe_open(path, framework="pt") as file:
            told = json.loads((file.metadata() or {})["training"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  it is no mapping
        step, averaged, about = (told[name] for name in ("step", "averaged", "about"))
        if {name: value.shape for name, value in tensors.items()} != _shapes(state):
            raise ValueError("its tensors are not those of this training")
        optimizer = state.optimizer.state_dict()
        with torch.no_grad():
            for index, parameter in enumerate(state.parameters):
                parameter.copy_(tensors[f"{index}.value"])
                state.average.shadow_params[index].copy_(tensors[f"{index}.average"])
                optimizer["state"][index] = {name: tensors[f"{index}.{name}"] for name in _MOMENTS}
        state.optimizer.load_state_dict(optimizer)
    except (SafetensorError, OSError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise DamagedArtifact(
            f"the training's checkpoint {path} cannot be used ({error})", f"remove {path.parent} and train anew"
        ) from error
    state.step, state.average.optimization_step = step, averaged
    return about


def _shapes(state: State) -> dict[str, torch.Size]:
    """What a file of this training holds once it has begun."""
    like = ("value", "average", *_MOMENTS[:2])
    shapes = {f"{index}.{name}": p.shape for index, p in enumerate(state.parameters) for name in like}
    return shapes | {f"{index}.step": torch.Size([]) for index in range(len(state.parameters))}
