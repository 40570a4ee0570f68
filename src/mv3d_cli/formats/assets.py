"""Files that ship with the program: inside the wheel at `mv3d_cli/assets`, in a source tree at `assets/`."""

from __future__ import annotations

from pathlib import Path

from mv3d_cli.errors import MissingInput

_PACKAGE = Path(__file__).resolve().parents[1]
_FOLDERS = (_PACKAGE / "assets", _PACKAGE.parents[1] / "assets")


def asset(name: str) -> Path:
    """The path of a bundled file or folder. Raises MissingInput where the installation lacks it."""
    for folder in _FOLDERS:
        if (folder / name).exists():
            return folder / name
    raise MissingInput(
        f"the bundled file {name} is missing from this installation.",
        "Install mv3d-cli again: pip install --force-reinstall mv3d-cli",
    )
