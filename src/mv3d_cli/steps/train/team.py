"""One training in one process or in several (accelerate, torchrun): the first alone writes, and tells the others."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from accelerate import Accelerator
from accelerate.utils import broadcast_object_list

from mv3d_cli.diffusion.devices import device_of


class Team:
    """The processes of a training and the device of this one. Raises UsageError for a device that is not here."""

    def __init__(self, device: str):
        self.accelerator = Accelerator(cpu=device_of(device).type == "cpu")
        self.device: torch.device = self.accelerator.device
        self.size, self.rank = self.accelerator.num_processes, self.accelerator.process_index
        self.first = self.accelerator.is_main_process
        self._told = False

    def tell_folder(self, folder: Path | None) -> None:
        """The first says, once, where the work lies; None: there is nothing to do."""
        if not self._told:
            self._told = True
            self._shared(None if folder is None else str(folder))

    def hear_folder(self) -> Path | None:
        """The others wait for that."""
        said = self._shared(None)
        return None if said is None else Path(said)

    def agreed(self, decision: bool) -> bool:
        """What the first decides."""
        return bool(self._shared(decision)) if self.size > 1 else decision

    def _shared(self, value: Any) -> Any:
        return broadcast_object_list([value])[0] if self.size > 1 else value
