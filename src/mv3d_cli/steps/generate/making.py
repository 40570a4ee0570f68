"""The views of a photo, asked of a model and written."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8

from mv3d_cli.capture.draft import draft_views
from mv3d_cli.capture.examples import BACKGROUNDS, composited, pictures_of, poses_of
from mv3d_cli.capture.photo.framing import INSIDE, framed
from mv3d_cli.capture.sheet import sheet_of_views
from mv3d_cli.capture.solid import views_between
from mv3d_cli.diffusion.autoencoder import pictures_from_bytes, stacked_pictures
from mv3d_cli.diffusion.devices import device_of, has_quick_bf16
from mv3d_cli.diffusion.generation import Sampling, generated
from mv3d_cli.diffusion.model import Model
from mv3d_cli.diffusion.model.checkpoint import load_model
from mv3d_cli.diffusion.model.stable_diffusion import model_from_stable_diffusion
from mv3d_cli.errors import WorkFailed
from mv3d_cli.formats.cameras import load_cameras, select
from mv3d_cli.formats.images import write_png
from mv3d_cli.formats.views_folder import write_views
from mv3d_cli.scene.camera import Camera
from mv3d_cli.scene.views import View, Views
from mv3d_cli.steps.generate import BACK, FRONT, Config, fill_of
from mv3d_cli.steps.generate.answers import (
    back_view,
    generated_view,
    halfway,
    is_level,
    outline_of,
    photo_view,
    unfolded,
)
from mv3d_cli.steps.generate.models import Place
from mv3d_cli.steps.generate.photo import Subject
from mv3d_cli.steps.settings import Tell, Warned

_WHITE = BACKGROUNDS["white"]

Photograph = UInt8[np.ndarray, "side side 4"]
Answer = tuple[UInt8[np.ndarray, "views side side 3"], Float[np.ndarray, "views side side"]]


def write_views_of(
    config: Config, subject: Subject, cameras: Sequence[Camera], place: Place, folder: Path, tell: Tell
) -> None:
    """Fill the folder of an artifact. Raises UsageError, BadWeights, MissingDependency, WorkFailed."""
    device = device_of(config.device)
    model = _loaded(place, config.seed, tell).to(device)
    photo = framed(subject.cut, model.config.picture_size, fill_of(config.fill))
    views = views_by(model, photo, cameras, config, tell)
    write_views(folder, views)
    write_png(folder / "input.png", photo)
    write_png(folder / "mask.png", np.ascontiguousarray(subject.cut[..., 3]))
    write_png(folder / "sheet.png", sheet_of_views(_beside(subject.whole, views)))


def views_by(model: Model, photo: Photograph, cameras: Sequence[Camera], config: Config, tell: Tell) -> Views:
    """The photo's views, the photo the first: those that the model was taught as it answers, the others as what
    lies between its front and its back shows them; their depth is the mean of the model's and the draft's, whose errors
    cancel in part. Raises WorkFailed where the model sees no object."""
    names = model.config.views
    others = [camera for camera in cameras if camera.name not in names]
    unfolds = bool(others) and {FRONT, BACK} <= set(names)
    asked = select(load_cameras(), (FRONT, *(name for name in names if name != FRONT))) if unfolds else cameras
    draft = draft_views(photo, asked)
    made = views_of(photo, asked, answered(model, photo, draft, config), tell)
    if not unfolds:
        return made
    known = {view.camera.name: view for view in made.frames}
    guesses = {view.camera.name: view for view in draft.frames}
    front, back = (halfway(known[name], guesses[name]) for name in (FRONT, BACK))
    known |= {FRONT: front, BACK: back}
    known |= {view.camera.name: unfolded(view, back.weight) for view in views_between(front, back, others).frames}
    return Views(tuple(known[camera.name] for camera in cameras if camera.name in known))


def answered(model: Model, photo: Photograph, draft: Views, config: Config) -> Answer:
    """(colours, depths) of the draft's views of the photo, as the model has them, on white."""
    device = next(model.parameters()).device
    picture = pictures_from_bytes(torch.from_numpy(composited(photo, _WHITE)))[None].to(device)
    poses = torch.from_numpy(poses_of([view.camera for view in draft.frames]))[None].to(device)
    drafts = None
    if model.config.drafts:
        color, depth = pictures_of(draft, _WHITE)
        drafts = stacked_pictures(torch.from_numpy(color), torch.from_numpy(depth))[None].to(device)
    sampling = Sampling(config.steps, config.sampler, config.guidance, config.seed)
    half = is_half(config.dtype, device)
    with torch.autocast(device.type, torch.bfloat16, enabled=half):
        color, depth = generated(model, picture, poses, sampling, drafts)
    pixels = ((color[0].float() + 1) * 127.5).round().to(torch.uint8).permute(0, 2, 3, 1)
    return pixels.cpu().numpy(), depth[0].float().cpu().numpy()


def views_of(photo: Photograph, cameras: Sequence[Camera], answer: Answer, tell: Tell) -> Views:
    """The photo as the first view, and those of the others in which the model sees the object.

    Raises WorkFailed where it sees none in the photo.
    """
    front = photo_view(photo, answer[1][0], cameras[0])
    if front is None:
        raise WorkFailed("the model sees no object in the photo", "take another --model, or more --steps")
    rows = np.asarray((photo[..., 3] >= INSIDE).any(axis=1))
    frames: list[View] = [front]
    for camera, color, depth in zip(cameras[1:], answer[0][1:], answer[1][1:], strict=True):
        outline = outline_of(depth, rows if is_level(camera) else None)
        if camera.name == BACK:
            frames.append(back_view(photo, color, depth, outline, camera))
        elif outline.mask.any():
            frames.append(generated_view(color, depth, outline, camera))
        else:
            tell(Warned(f"the model sees nothing in the view {camera.name}: it is left out"))
    return Views(tuple(frames))


def is_half(dtype: str, device: torch.device) -> bool:
    """Whether products are of bf16; auto: where the device is quicker with them."""
    return has_quick_bf16(device) if dtype == "auto" else dtype == "bf16"


def _loaded(place: Place, seed: int, tell: Tell) -> Model:
    if not place.foreign:
        return load_model(place.path)
    tell(Warned(f"{place.path} was never taught to make views: teach it first, with `mv3d train --preset sd --from`"))
    torch.manual_seed(seed)
    return model_from_stable_diffusion(str(place.path))


def _beside(whole: UInt8[np.ndarray, "rows columns 4"], views: Views) -> Views:
    """The views after the photo as it came, for a sheet."""
    camera = Camera("photo", np.eye(4), views.frames[0].camera.projection)
    empty = np.zeros(whole.shape[:2], np.float32)
    return Views((View(camera, whole, empty, np.zeros((*empty.shape, 3), np.uint8)), *views.frames))
