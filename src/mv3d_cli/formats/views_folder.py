"""Views folders: transforms.json in nerfstudio's schema, color/NAME.png, depth/NAME.exr, normal/NAME.png.

`transform_matrix` is world_from_camera in OpenGL's camera axes (x right, y up, z backwards); nerfstudio's world
is +Z up, as ours. Our extra keys per frame are `name`, `source`, `weight`, and `half_extent` where orthographic.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, get_args

import numpy as np
from jaxtyping import UInt8

from mv3d_cli.errors import BadViews, MissingInput
from mv3d_cli.formats.cameras import camera_from_frame, check_names, frame_from_camera, frame_name, read_json
from mv3d_cli.formats.images import read_depth, read_image, write_depth, write_png
from mv3d_cli.scene.views import Source, View, Views

TRANSFORMS = "transforms.json"
_HINT = "A views folder holds transforms.json and the pictures it names; `mv3d render` writes one."
_FILE_KEYS = {"color": "file_path", "depth": "depth_file_path", "normal": "normal_file_path"}
_THREADS = min(8, os.cpu_count() or 1)


def write_views(folder: Path, views: Views, *, color: bool = True, depth: bool = True, normal: bool = True) -> None:
    """Write the pictures that the views hold, of the kinds asked for, and their cameras.

    The folder is made if need be; same views, same bytes. Raises BadViews for names that cannot be files.
    """
    try:
        check_names([view.camera.name for view in views.frames])
    except ValueError as error:
        raise BadViews(f"these views cannot be written: {error}.", "Give every view a plain name.") from None
    wanted = {"color": color, "depth": depth, "normal": normal}
    jobs: list[Callable[[], None]] = []
    frames = []
    for view in views.frames:
        frame, writers = _frame(folder, view, wanted)
        frames.append(frame)
        jobs += writers
    folder.mkdir(parents=True, exist_ok=True)
    for kind in {Path(frame[key]).parent for frame in frames for key in _FILE_KEYS.values() if key in frame}:
        (folder / kind).mkdir(exist_ok=True)
    with ThreadPoolExecutor(_THREADS) as pool:  # encoders let go of the interpreter
        list(pool.map(lambda job: job(), jobs))
    content = {**_shared_model(frames), "frames": frames}
    (folder / TRANSFORMS).write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def read_views(folder: Path) -> Views:
    """The views of a folder, in its order; a picture that a frame does not name is None.

    A frame of someone else's without `source` is a photo. Raises MissingInput for no such folder, BadViews for
    a malformed one, BadImage for a damaged picture.
    """
    if not (folder / TRANSFORMS).is_file():
        raise MissingInput(f"{folder} is not a views folder: it has no {TRANSFORMS}.", _HINT)
    try:
        content = read_json(folder / TRANSFORMS)
        if not isinstance(content, dict) or not isinstance(content.get("frames"), list) or not content["frames"]:
            raise ValueError('there is no list "frames" in it')
        places = [_Place(folder, frame, content, index) for index, frame in enumerate(content["frames"])]
        check_names([place.name for place in places])
        with ThreadPoolExecutor(_THREADS) as pool:
            return Views(tuple(pool.map(_Place.view, places)))
    except ValueError as error:
        raise BadViews(f"{folder / TRANSFORMS}: {error}.", _HINT) from None


def _frame(folder: Path, view: View, wanted: dict[str, bool]) -> tuple[dict[str, Any], list[Callable[[], None]]]:
    """A frame of transforms.json, and what writes its pictures."""
    name = view.camera.name
    height, width = view.shape
    frame: dict[str, Any] = {"name": name}
    writers: list[Callable[[], None]] = []
    if wanted["color"] and (color := view.color) is not None:
        frame["file_path"] = f"color/{name}.png"
        writers.append(lambda: write_png(folder / "color" / f"{name}.png", color))
    if wanted["depth"] and (depth := view.depth) is not None:
        frame["depth_file_path"] = f"depth/{name}.exr"
        writers.append(lambda: write_depth(folder / "depth" / f"{name}.exr", depth))
    if wanted["normal"] and (normal := view.normal) is not None:
        frame["normal_file_path"] = f"normal/{name}.png"
        writers.append(lambda: write_png(folder / "normal" / f"{name}.png", normal))
    frame |= {"source": view.source, "weight": view.weight, **frame_from_camera(view.camera, width, height)}
    return frame, writers


def _shared_model(frames: list[dict[str, Any]]) -> dict[str, str]:
    """nerfstudio asks for one camera model for all frames, and calls the orthographic one ORTHOPHOTO."""
    models = {frame["camera_model"] for frame in frames}
    if len(models) != 1:
        return {}
    return {"camera_model": models.pop().replace("ORTHOGRAPHIC", "ORTHOPHOTO")}


class _Place:
    """One frame of a folder, and where its mistakes are told."""

    def __init__(self, folder: Path, frame: Any, shared: dict[str, Any], index: int):
        if not isinstance(frame, dict):
            raise ValueError(f"frame {index} is not a JSON object")
        self.folder, self.frame = folder, frame
        self.shared = {key: value for key, value in shared.items() if key not in ("frames", *_FILE_KEYS.values())}
        self.name = frame_name(frame, index)

    def view(self) -> View:
        """The view, read. Raises ValueError with the place of the mistake, or BadImage."""
        try:
            camera = camera_from_frame(self.frame, self.shared, self.name)
            source = self.frame.get("source", "photo")
            if source not in get_args(Source):
                raise ValueError(f"the source {source!r} is not one of {', '.join(get_args(Source))}")
            weight = self.frame.get("weight", 1.0)
            if not isinstance(weight, int | float) or not math.isfinite(weight) or weight < 0:
                raise ValueError(f"the weight {weight!r} is not a number of at least 0")
            pictures = self._pictures()
            self._check_sizes(pictures)
        except ValueError as error:
            raise ValueError(f"view {self.name}: {error}") from None
        return View(camera, **pictures, source=source, weight=float(weight))

    def _pictures(self) -> dict[str, Any]:
        pictures: dict[str, Any] = {}
        if path := self._path("file_path"):
            pictures["color"] = read_image(path)
            if mask := self._path("mask_path"):
                pictures["color"] = _masked(pictures["color"], read_image(mask))
        if path := self._path("depth_file_path"):
            if path.suffix.lower() != ".exr":
                raise ValueError(f"the depth map {path.name} is not an EXR file")
            pictures["depth"] = read_depth(path)
        if path := self._path("normal_file_path"):
            pictures["normal"] = read_image(path)[..., :3].copy()
        if not pictures:
            raise ValueError("it names no picture")
        return pictures

    def _path(self, key: str) -> Path | None:
        name = self.frame.get(key)
        if name is None:
            return None
        path = (self.folder / str(name)).resolve()
        if not path.is_relative_to(self.folder.resolve()):
            raise ValueError(f"{key} {name} lies outside the folder")
        if not path.is_file():
            raise ValueError(f"there is no file {name}")
        return path

    def _check_sizes(self, pictures: dict[str, Any]) -> None:
        sizes = {kind: f"{picture.shape[1]}x{picture.shape[0]}" for kind, picture in pictures.items()}
        said = {**self.shared, **self.frame}
        if "w" in said and "h" in said:
            sizes[TRANSFORMS] = f"{said['w']:g}x{said['h']:g}"
        if len(set(sizes.values())) > 1:
            raise ValueError("sizes differ: " + ", ".join(f"{kind} {size}" for kind, size in sizes.items()))


def _masked(
    color: UInt8[np.ndarray, "height width 4"], mask: UInt8[np.ndarray, "rows columns 4"]
) -> UInt8[np.ndarray, "height width 4"]:
    """The picture, transparent where the mask is black (nerfstudio's meaning of a mask)."""
    if color.shape != mask.shape:
        raise ValueError("the mask's size differs from the picture's")
    color[..., 3] = np.where(mask[..., 0] > 0, color[..., 3], 0)
    return color
