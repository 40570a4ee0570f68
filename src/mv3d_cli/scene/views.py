"""Views: pictures of one object with their cameras. Colour, depth and normals as in `conventions`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, UInt8

from mv3d_cli.scene.camera import Camera

Source = Literal["photo", "generated", "rendered"]


@dataclass(frozen=True)
class View:
    """One picture of the object: what is not known of it is None.

    color   sRGB with straight alpha
    depth   planar z, scene units, 0 = no surface
    normal  viewer's axes, `conventions.bytes_from_normal`
    weight  how much a fit should trust this view; 1 is usual
    """

    camera: Camera
    color: UInt8[np.ndarray, "height width 4"] | None = None
    depth: Float[np.ndarray, "height width"] | None = None
    normal: UInt8[np.ndarray, "height width 3"] | None = None
    source: Source = "rendered"
    weight: float = 1.0

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) in pixels."""
        for picture in (self.color, self.depth, self.normal):
            if picture is not None:
                return picture.shape[0], picture.shape[1]
        raise ValueError(f"view {self.camera.name} holds no picture")


@dataclass(frozen=True)
class Views:
    """The views of one object, in the rig's order; camera names are unique."""

    frames: tuple[View, ...]

    def __len__(self) -> int:
        return len(self.frames)
