"""What the landmarks on the road say of the length's unit: they lie on the plane whose distance is known.

Corners followed on the road give a length that is short by up to a tenth (see road/alignment.py), but one that nothing
on the glass can feign, since a reflection that stands still has no depth, and that no period of stripes can double. So
they say where the alignment of the road's image begins, and which of its answers can't be.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera
from birdslam.odometry.corners.sliding_window import SlidingWindow
from birdslam.odometry.road.alignment import plane_normal

Floats = NDArray[np.float64]

_NEAR_M, _FAR_M, _HALF_WIDTH_M = 3.0, 30.0, 6.0  # of the road that a landmark may lie on: a lane and its neighbours
_DEPTH_SIGMA_REL = 0.25  # a landmark's depth is known so well, or says nothing
_WIDTH_LOG = 0.1  # of the mode: what the tilt and the road's crown make of a height
_LEAST_VOTES, _LEAST_SHARE = 6.0, 0.45
_GRID_LOG = np.linspace(-4.0, 4.0, 321)


def length_unit(camera: Camera, tilt: tuple[float, float], window: SlidingWindow) -> float | None:
    """The factor that makes metres of the window's unit, by the mode of the heights of what lies in front on the road.

    None where too few landmarks agree on one height.
    """
    seen = np.isfinite(window.obs[-1, :, 0]) & np.isfinite(window.rho) & (window.rho > 1e-6)
    seen &= window.rho_sigma < _DEPTH_SIGMA_REL * window.rho
    xy, newest = window.obs[-1, seen], window.poses[-1]
    rays = np.column_stack([xy, np.ones(len(xy))])
    by_plane = -(rays @ plane_normal(*tilt)[0]) / camera.height_m  # 1 / m
    inverse_depth = window.inverse_depths(newest)[seen]
    road = (by_plane > 1.0 / _FAR_M) & (by_plane < 1.0 / _NEAR_M) & (np.abs(xy[:, 0]) < _HALF_WIDTH_M * by_plane)
    road &= np.isfinite(inverse_depth) & (inverse_depth > 0.0)
    if road.sum() < _LEAST_VOTES:
        return None
    ratio = np.log(inverse_depth[road] / by_plane[road])
    votes = np.exp(-0.5 * np.square((_GRID_LOG[:, None] - ratio) / _WIDTH_LOG)).sum(axis=1)
    best = int(votes.argmax())
    if votes[best] < max(_LEAST_VOTES, _LEAST_SHARE * len(ratio)):
        return None
    return float(np.exp(_GRID_LOG[best]))
