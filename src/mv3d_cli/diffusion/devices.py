"""Which device is meant, and which products are quick on it."""

from __future__ import annotations

import torch

from mv3d_cli.errors import UsageError


def device_of(name: str) -> torch.device:
    """The device of that name; auto: a GPU where there is one. Raises UsageError for one that is not here."""
    here = {"cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available()}
    if not here.get(name, True):
        raise UsageError(f"--device {name}: there is no such device here", "leave it out, or take --device cpu")
    return torch.device(next((kind for kind in here if here[kind]), "cpu") if name == "auto" else name)


def has_quick_bf16(device: torch.device) -> bool:
    """Whether products of bf16 are quicker than those of fp32.

    On a CPU they are where it has tiles for them (AMX): 730 GFLOP/s against 145 on two cores with them, and 160 against
    290 on two cores without.
    """
    if device.type == "cpu":
        return torch.cpu._is_amx_tile_supported()
    return device.type == "cuda" and torch.cuda.is_bf16_supported()
