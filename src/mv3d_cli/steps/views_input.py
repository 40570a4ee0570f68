"""A views folder as the input of a step: its views, its digest, and a word if someone edited it."""

from __future__ import annotations

from pathlib import Path

from mv3d_cli.formats.views_folder import read_views
from mv3d_cli.scene.views import Views
from mv3d_cli.steps.settings import Tell, Warned
from mv3d_cli.store import damage_of, digest_of_folder, find_artifact


def views_and_digest(folder: Path, tell: Tell) -> tuple[Views, str]:
    """The views of a folder and the digest of its files. Raises MissingInput, BadViews, BadImage."""
    views = read_views(folder)
    artifact = find_artifact(folder)
    if artifact is not None and artifact.path.resolve() == folder.resolve():
        for change in damage_of(artifact)[:1]:
            tell(Warned(f"{folder} was changed since it was made ({change}); it counts as a new input"))
    return views, digest_of_folder(folder)
