"""A first guess at an object's other sides, from one photo and its cut-out alone; nothing is learnt for it.

Under parallel rays, cameras that stand around the vertical see a slice of the object in the same row of their pictures.
What the slice looks like from above is unknown but for its width in the photo, so it is taken to be round: each run of
the object's pixels in a row is the diameter of a disc, whose far side looks like its near one. A vase comes out right,
a box too thick, a horse from its side like a barrel. The network is told of the guess and mends it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, UInt8

from mv3d_cli.capture.rendering import render
from mv3d_cli.capture.solid import Sheet, reduced, solid_between
from mv3d_cli.scene.camera import Camera
from mv3d_cli.scene.mesh import Mesh
from mv3d_cli.scene.views import Views

RESOLUTION = 96  # slices of the solid


def draft_views(photo: UInt8[np.ndarray, "side side 4"], cameras: Sequence[Camera]) -> Views:
    """Views, as large as the photo, of its object as a stack of discs. The photo, with straight alpha, spans the unit
    sphere from the front, and is the first view's colour; without an object there is a dot in its middle."""
    first, *others = render(solid_of_discs(photo), cameras, len(photo), None).frames
    return Views((replace(first, color=photo), *others))


def solid_of_discs(photo: UInt8[np.ndarray, "side side 4"]) -> Mesh:
    """The stack of discs."""
    color, mask = reduced(photo, RESOLUTION)
    depth = thickness(mask) * 2 / RESOLUTION
    return solid_between(mask, Sheet(-depth, color), Sheet(depth, color))


def thickness(mask: Bool[np.ndarray, "rows columns"]) -> Float[np.ndarray, "rows columns"]:
    """Half the thickness at each place, in places: every run of a row is a diameter, so it is a half circle over it."""
    padded = np.pad(mask, ((0, 0), (1, 1))).astype(np.int8)
    edges = np.diff(padded, axis=1)
    start, end = np.nonzero(edges == 1), np.nonzero(edges == -1)
    depth = np.zeros(mask.shape)
    for row, first, last in zip(start[0], start[1], end[1], strict=True):
        radius = (last - first) / 2
        across = np.arange(first, last) + 0.5 - (first + last) / 2
        depth[row, first:last] = np.sqrt(radius**2 - across**2)
    return depth
