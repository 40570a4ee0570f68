"""Camera files: our own layout, lists of 3x4 matrices, and nerfstudio's transforms.json.

    {"version": 1, "cameras": [{"name": "front", "position": [0, -2, 0], "projection": {...}}, ...]}

A camera either looks at the origin from its `position` (scene units) or has `world_from_camera` (4x4, OpenCV).
`projection` is {"type": "orthographic", "half_extent": 1} or {"type": "perspective", "focal": [fx, fy],
"centre": [cx, cy]}, fractions of the picture's width and height.
"""

from __future__ import annotations

import difflib
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from mv3d_cli.errors import BadCameras
from mv3d_cli.formats.assets import asset
from mv3d_cli.formats.images import read_bytes
from mv3d_cli.scene.camera import (
    Camera,
    Orthographic,
    Perspective,
    look_at_origin,
    pixel_from_camera,
)
from mv3d_cli.scene.conventions import OPENCV_FROM_OPENGL

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*")
_PINHOLES = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
_ORTHOGRAPHIC = ("ORTHOGRAPHIC", "ORTHOPHOTO")
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")


def load_cameras(path: Path | None = None) -> tuple[Camera, ...]:
    """The cameras of a file, or those of the bundled rig. Raises MissingInput or BadCameras."""
    path = path or asset("cameras.json")
    try:
        return _cameras(read_json(path))
    except ValueError as error:
        hint = 'A cameras file looks like {"version": 1, "cameras": [{"name", "position", "projection"}, ...]}.'
        raise BadCameras(f"{path}: {error}.", hint) from None


def select(cameras: Sequence[Camera], names: Iterable[str]) -> tuple[Camera, ...]:
    """The cameras called `names`, in that order. Raises BadCameras for a name that is not there."""
    by_name = {camera.name: camera for camera in cameras}
    chosen = []
    for name in names:
        if name not in by_name:
            close = difflib.get_close_matches(name, by_name, n=1)
            guess = f"Did you mean {close[0]}? " if close else ""
            raise BadCameras(f"there is no view called {name}.", f"{guess}There are: {', '.join(by_name)}.")
        if any(name == camera.name for camera in chosen):
            raise BadCameras(f"the view {name} is asked for twice.", "Name each view once.")
        chosen.append(by_name[name])
    return tuple(chosen)


def read_json(path: Path) -> Any:
    """A JSON file's content. Raises MissingInput, or ValueError with the place of the mistake."""
    data = read_bytes(path)
    try:
        return json.loads(data)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"it is not JSON ({error})") from None


def camera_from_frame(frame: Mapping[str, Any], shared: Mapping[str, Any], name: str) -> Camera:
    """The camera of one frame of transforms.json; what the frame does not say is `shared`.

    An orthographic frame without `half_extent` takes `fl_x` as pixels per scene unit, as nerfstudio does.
    Raises ValueError.
    """
    said = {**shared, **frame}
    world_from_camera = _pose(said.get("transform_matrix"), "transform_matrix") @ OPENCV_FROM_OPENGL
    model = str(said.get("camera_model", "OPENCV")).upper()
    if model not in _PINHOLES + _ORTHOGRAPHIC:
        raise ValueError(f"camera_model {model} is not one of {', '.join(_PINHOLES + _ORTHOGRAPHIC)}")
    if any(said.get(key, 0) for key in _DISTORTION):
        raise ValueError("lens distortion is not supported: undistort the pictures first")
    if model in _ORTHOGRAPHIC and "half_extent" in said:
        return Camera(name, world_from_camera, Orthographic(_positive(said, "half_extent")))
    width, height = (_positive(said, key) for key in "wh")
    if "fl_x" not in said and "camera_angle_x" in said:
        said["fl_x"] = width / 2 / math.tan(_positive(said, "camera_angle_x") / 2)
    focal = _positive(said, "fl_x")
    if model in _ORTHOGRAPHIC:
        return Camera(name, world_from_camera, Orthographic(width / (2 * focal)))
    focal_y = _positive(said, "fl_y") if "fl_y" in said else focal
    centre = _array([said.get("cx", width / 2), said.get("cy", height / 2)], (2,), "cx, cy")
    projection = Perspective((focal / width, focal_y / height), (float(centre[0] / width), float(centre[1] / height)))
    return Camera(name, world_from_camera, projection)


def frame_from_camera(camera: Camera, width: int, height: int) -> dict[str, Any]:
    """The camera's part of a frame of transforms.json: the inverse of `camera_from_frame`.

    Poses and half-extents come back as they were, focal lengths to the last digit of a float64.
    """
    (fl_x, cx), (fl_y, cy) = pixel_from_camera(camera, width, height).tolist()
    frame = {
        "camera_model": "OPENCV",
        **{"w": width, "h": height, "fl_x": fl_x, "fl_y": fl_y, "cx": cx, "cy": cy},
        "transform_matrix": (camera.world_from_camera @ OPENCV_FROM_OPENGL).tolist(),
    }
    if isinstance(camera.projection, Orthographic):
        frame |= {"camera_model": "ORTHOGRAPHIC", "half_extent": camera.projection.half_extent}
    return frame


def check_names(names: Sequence[str]) -> None:
    """Raise ValueError unless the names are distinct and can be file names on any system."""
    for name in names:
        if not _NAME.fullmatch(name):
            raise ValueError(f"the name {name!r} has other characters than letters, digits, dot, dash and underscore")
    if len({name.casefold() for name in names}) < len(names):
        raise ValueError("two cameras have the same name")


def _cameras(content: Any) -> tuple[Camera, ...]:
    if not isinstance(content, dict):
        raise ValueError("it is not a JSON object")
    if "camera_from_world" in content:
        cameras = _matrix_cameras(content)
    elif isinstance(content.get("frames"), list):
        cameras = _frame_cameras(content)
    elif isinstance(content.get("cameras"), list):
        if content.get("version", 1) != 1:
            raise ValueError(f"version {content['version']} is newer than this program, which reads version 1")
        cameras = [_placed(_camera, camera, index) for index, camera in enumerate(content["cameras"])]
    else:
        raise ValueError('there is no list "cameras", "frames" or "camera_from_world" in it')
    if not cameras:
        raise ValueError("it holds no camera")
    check_names([camera.name for camera in cameras])
    return tuple(cameras)


def _placed(parse, item: Any, index: int) -> Camera:
    """What `parse` makes of the item; its mistakes are told with their place."""
    try:
        if not isinstance(item, dict):
            raise ValueError("is not a JSON object")
        return parse(item, index)
    except ValueError as error:
        name = item.get("name") if isinstance(item, dict) else None
        raise ValueError(f"camera {index}{f' ({name})' if name else ''}: {error}") from None


def _camera(item: dict[str, Any], index: int) -> Camera:
    name = item.get("name")
    if not isinstance(name, str):
        raise ValueError("it has no name")
    projection = _projection(item.get("projection", {"type": "orthographic"}))
    if "world_from_camera" in item:
        return Camera(name, _pose(item["world_from_camera"], "world_from_camera"), projection)
    x, y, z = _array(item.get("position"), (3,), "position").tolist()
    if x == y == z == 0:
        raise ValueError("its position is the origin, which it looks at")
    return look_at_origin(name, (x, y, z), projection)


def _projection(item: Any) -> Orthographic | Perspective:
    kind = item.get("type") if isinstance(item, dict) else item
    if kind == "orthographic":
        return Orthographic(_positive({"half_extent": 1.0, **item}, "half_extent"))
    if kind == "perspective":
        fx, fy = _array(item.get("focal"), (2,), "focal").tolist()
        cx, cy = _array(item.get("centre", (0.5, 0.5)), (2,), "centre").tolist()
        if min(fx, fy) <= 0:
            raise ValueError("focal is not positive")
        return Perspective((fx, fy), (cx, cy))
    raise ValueError(f"the projection type {kind!r} is neither orthographic nor perspective")


def _frame_cameras(content: dict[str, Any]) -> list[Camera]:
    def parse(frame: dict[str, Any], index: int) -> Camera:
        return camera_from_frame(frame, content, frame_name(frame, index))

    return [_placed(parse, frame, index) for index, frame in enumerate(content["frames"])]


def frame_name(frame: Mapping[str, Any], index: int) -> str:
    """What a frame of transforms.json is called: its `name`, its picture's, or its number."""
    return str(frame.get("name") or Path(str(frame.get("file_path", ""))).stem or f"{index:03d}")


def _matrix_cameras(content: dict[str, Any]) -> list[Camera]:
    """One intrinsic matrix in pixels, and a list of `camera_from_world`, 3x4 or 4x4, OpenCV axes."""
    if content.get("model", "perspective") != "perspective":
        raise ValueError(f"the model {content['model']!r} is not perspective")
    size = np.array([_positive(content, "width"), _positive(content, "height")])
    intrinsics = _array(content.get("K"), (3, 3), "K")
    focal, centre = intrinsics.diagonal()[:2] / size, intrinsics[:2, 2] / size
    if focal.min() <= 0:
        raise ValueError("the focal lengths in K are not positive")
    projection = Perspective((float(focal[0]), float(focal[1])), (float(centre[0]), float(centre[1])))
    poses = content["camera_from_world"]
    if not isinstance(poses, list):
        raise ValueError("camera_from_world is not a list of matrices")
    names = content.get("names") or [f"{index:03d}" for index in range(len(poses))]
    if len(names) != len(poses):
        raise ValueError(f"it has {len(names)} names and {len(poses)} cameras")
    return [
        Camera(str(name), np.linalg.inv(_pose(pose, f"camera_from_world {name}")), projection)
        for name, pose in zip(names, poses, strict=True)
    ]


def _pose(value: Any, what: str) -> Float[np.ndarray, "4 4"]:
    """A rigid motion from nested lists, 4x4 or 3x4."""
    if isinstance(value, list) and len(value) == 3:
        value = [*value, [0, 0, 0, 1]]
    pose = _array(value, (4, 4), what)
    rotation = pose[:3, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0:
        raise ValueError(f"{what} is not a rotation and a translation")
    if not np.allclose(pose[3], [0, 0, 0, 1]):
        raise ValueError(f"the last row of {what} is not 0 0 0 1")
    return pose


def _positive(item: Mapping[str, Any], key: str) -> float:
    value = float(_array(item.get(key), (), key))
    if value <= 0:
        raise ValueError(f"{key} is not positive")
    return value


def _array(value: Any, shape: tuple[int, ...], what: str) -> Float[np.ndarray, "*shape"]:
    if value is None:
        raise ValueError(f"{what} is missing")
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{what} is not made of numbers") from None
    if array.shape != shape:
        wanted = "x".join(map(str, shape)) or "one"
        raise ValueError(f"{what} does not hold {wanted} numbers")
    if not np.isfinite(array).all():
        raise ValueError(f"{what} is not finite")
    return array
