"""Where the corners of one image are expected in the next, by the motion that is expected between them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.geometry.pose import Pose

Floats = NDArray[np.float64]

_NEAREST = 0.3  # a depth under this share of the assumed one says nothing any more
_FARTHEST_REL = 0.4  # of the image's width: no corner is looked for farther away


def corners_of_unknown_depth_px(camera: Camera, ground: GroundPlane, px: Floats, step: Pose) -> Floats:
    """(N, 2) of corners `px` (N, 2), after the motion T_prev_curr of `step` in metres.

    Each goes as if it lay twice as far as the road below the horizon, and endlessly far above it. Where that leads out
    of sight, it is expected where it was.
    """
    rays = np.column_stack([camera.to_xy(px), np.ones(len(px))])
    rho = np.maximum(-(rays @ ground.normal_cam) / camera.height_m, 0.0) * 0.5
    q = (rays - rho[:, None] * step.p) @ step.R
    out = camera.to_px(q[:, :2] / np.maximum(q[:, 2:], 0.2))
    lost = (q[:, 2] < _NEAREST) | (np.abs(out - px) > _FARTHEST_REL * camera.width_px).any(axis=1)
    out[lost] = px[lost]
    return out
