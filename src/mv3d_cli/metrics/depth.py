"""How far a depth map is off: planar z in scene units, 0 = no surface; the same size."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def depth_error(predicted: Float[np.ndarray, "*shape"], true: Float[np.ndarray, "*shape"]) -> float:
    """Mean absolute error over the true surface, scene units; NaN where there is none.

    The prediction is taken as it is, so a pixel without a surface (0) counts as one at the camera.
    """
    surface = true > 0
    return float(np.abs(predicted[surface] - true[surface]).mean()) if surface.any() else float("nan")
