"""Training examples: one object, once, as a photo and the views that the network should answer with.

The rig turns with the photo: the object is turned at random and the cameras stay, so the photo is the front view.
Pictures are composited on one even background, the same for the photo and all views, in sRGB.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

from mv3d_cli.capture.draft import draft_views
from mv3d_cli.capture.examples.augmentation import augmented
from mv3d_cli.capture.framing import placed
from mv3d_cli.capture.lighting import Lighting, light_for
from mv3d_cli.capture.rendering import render
from mv3d_cli.scene.camera import Camera
from mv3d_cli.scene.mesh import Mesh, transform
from mv3d_cli.scene.views import Views

BACKGROUNDS = {"white": 255, "black": 0, "grey": 128}
"""What photos are composited on in training, as sRGB values; on white when it counts."""


@dataclass(frozen=True)
class Drawing:
    """How examples are drawn.

    size        pixels a side
    elevation   greatest height from which photos are taken, degrees; None: the object stands as it stands
    facing      share of the photos that are taken from about the object's own front
    least       smallest radius of the object, scene units; the largest is 1
    varied      backgrounds are drawn and the photo is spoilt a little, as real ones are; otherwise white and clean
    drafts      whether the photo's drafts of the views are drawn too
    backgrounds from which one is drawn: keys of BACKGROUNDS
    """

    size: int = 256
    elevation: float | None = 35.0
    least: float = 0.45
    lighting: Lighting = "random"
    facing: float = 0.3
    varied: bool = True
    drafts: bool = False
    backgrounds: tuple[str, ...] = tuple(BACKGROUNDS)


EVALUATION = {"elevation": None, "least": 1.0, "lighting": "studio", "varied": False}
"""Settings of `Drawing` under which an object is always the same."""


@dataclass(frozen=True)
class Example:
    """A photo of an object and its views, all of one size; cameras are the views'; drafts are the photo's guesses."""

    photo: UInt8[np.ndarray, "height width 3"]
    color: UInt8[np.ndarray, "views height width 3"]
    depth: Float[np.ndarray, "views height width"]
    world_from_camera: Float[np.ndarray, "views 4 4"]
    draft_color: UInt8[np.ndarray, "views height width 3"] | None = None
    draft_depth: Float[np.ndarray, "views height width"] | None = None


def example_from_mesh(mesh: Mesh, cameras: Sequence[Camera], drawing: Drawing, rng: np.random.Generator) -> Example:
    """The mesh at a turn, a size and in a light drawn at random; the first camera takes the photo. Raises BadMesh."""
    turned = np.eye(4) if drawing.elevation is None else photographed(rng, drawing.elevation, drawing.facing)
    mesh, _ = placed(mesh, turned)
    radius = rng.uniform(drawing.least, 1)
    mesh = transform(mesh, np.diag([radius, radius, radius, 1.0]))
    views = render(mesh, cameras, drawing.size, light_for(drawing.lighting, rng))
    return example_from_views(views, drawing, rng)


def photographed(rng: np.random.Generator, elevation: float, facing: float = 0.0) -> Float[np.ndarray, "4 4"]:
    """The turn of an object before a camera that is anywhere around it, or (a share of `facing`) within some ten
    degrees of its front; most likely level, sometimes as high as `elevation` degrees or a third as far below, and not
    held quite straight."""
    heading = rng.normal(scale=10) if rng.uniform() < facing else rng.uniform(0, 360)
    height = rng.triangular(-elevation / 3, 0, elevation) if elevation else 0.0
    turned = np.eye(4)
    turned[:3, :3] = Rotation.from_euler("zxy", [heading, height, rng.normal(scale=3)], degrees=True).as_matrix()
    return turned


def example_from_views(views: Views, drawing: Drawing, rng: np.random.Generator) -> Example:
    """Views that hold colour and depth, the first of them as the photo; sizes are taken as they come."""
    drawn = drawing.backgrounds[rng.integers(len(drawing.backgrounds))] if drawing.varied else "white"
    background = BACKGROUNDS[drawn]
    taken = views.frames[0].color
    assert taken is not None
    photo = augmented(taken, rng) if drawing.varied else taken
    cameras = [view.camera for view in views.frames]
    drafts = pictures_of(draft_views(photo, cameras), background) if drawing.drafts else (None, None)
    return Example(composited(photo, background), *pictures_of(views, background), poses_of(cameras), *drafts)


def pictures_of(
    views: Views, background: int
) -> tuple[UInt8[np.ndarray, "views height width 3"], Float[np.ndarray, "views height width"]]:
    """Colours over a grey, and depths, of views that hold both."""
    colors = [composited(view.color, background) for view in views.frames if view.color is not None]
    depths = [view.depth for view in views.frames if view.depth is not None]
    return np.stack(colors), np.stack(depths).astype(np.float32)


def poses_of(cameras: Sequence[Camera]) -> Float[np.ndarray, "views 4 4"]:
    """The cameras' poses, as the network is told of them."""
    return np.stack([camera.world_from_camera for camera in cameras]).astype(np.float32)


def composited(pixels: UInt8[np.ndarray, "height width 4"], background: int) -> UInt8[np.ndarray, "height width 3"]:
    """The picture over a grey of that sRGB value; blended in sRGB, as published evaluations do."""
    alpha = pixels[..., 3:].astype(np.uint16)
    return ((pixels[..., :3] * alpha + background * (255 - alpha) + 127) // 255).astype(np.uint8)
