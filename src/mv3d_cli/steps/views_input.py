"""A views folder as the input of a step: its views, its digest, and a word if someone edited it."""

from __future__ import annotations

from pathlib import Path

from mv3d_cli.errors import BadViews
from mv3d_cli.formats.views_folder import read_views
from mv3d_cli.scene.views import View, Views
from mv3d_cli.steps.settings import Tell, Warned
from mv3d_cli.store import damage_of, digest_of_folder, find_artifact

WHERE = "give depth/NAME.exr (0 = nothing there), or colour whose background is transparent"


def views_and_digest(folder: Path, tell: Tell) -> tuple[Views, str]:
    """The views of a folder and the digest of its files. Raises MissingInput, BadViews, BadImage."""
    views = read_views(folder)
    artifact = find_artifact(folder)
    if artifact is not None and artifact.path.resolve() == folder.resolve():
        for change in damage_of(artifact)[:1]:
            tell(Warned(f"{folder} was changed since it was made ({change}); it counts as a new input"))
    return views, digest_of_folder(folder)


def check_fittable(views: Views) -> None:
    """Raises BadViews for views that say too little of a surface to be fitted."""
    from mv3d_cli.fields.relief import mask_of

    if len(views) < 2:
        raise BadViews(
            f"there is only one view ({views.frames[0].camera.name}), and one view has no back",
            "`mv3d generate` makes eight views of one photo",
        )
    masks = {view.camera.name: mask_of(view) for view in views.frames}
    if all(mask is None for mask in masks.values()) and not any(_has_depth(view) for view in views.frames):
        raise BadViews("the views have neither depth nor a mask: nothing tells the object from the background", WHERE)
    empty = [name for name, mask in masks.items() if mask is not None and not mask.any()]
    if empty:
        raise BadViews(f"the object is nowhere to be seen in {_listed(empty)}", WHERE)
    if all(mask is None for mask in masks.values()):
        raise BadViews("depth fills every picture to the border, so it does not say where the object ends", WHERE)
    flat = [view.camera.name for view in views.frames if _is_flat(view)]
    if flat and len(flat) == sum(view.depth is not None for view in views.frames):
        raise BadViews(f"depth is the same everywhere in {_listed(flat)}", "depth is planar z in scene units")


def _has_depth(view: View) -> bool:
    from mv3d_cli.fields.relief import known

    return view.depth is not None and bool(known(view.depth).any())


def _is_flat(view: View) -> bool:
    from mv3d_cli.fields.relief import known

    if view.depth is None:
        return False
    depth = view.depth[known(view.depth)]
    return len(depth) == 0 or float(depth.max() - depth.min()) < 1e-6


def _listed(names: list[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
