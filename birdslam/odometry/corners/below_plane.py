"""Below-plane outliers: landmarks that are triangulated beyond the intersection of their ray with the road.

Such corners move with the car (another car, the glow of lamps, dirt on the windscreen), slide along a line, or are
mismatched on a repeated texture. They are mutually consistent, so that a robust kernel does not reject them.
"""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera, GroundPlane, plane_normal
from birdslam.geometry.pose import Pose
from birdslam.odometry.corners.sliding_window import SlidingWindow, match_ids

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]


class BelowPlaneConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Thresholds of a below-plane outlier."""

    depth_ratio: Positive = 2.0  # minimum ratio of the landmark's depth to the road's
    far_m: Positive = 40.0  # maximum depth of the road: crests and dips hide the road beyond
    sigmas: Positive = 2.0  # significance, in sigmas of the inverse depth


class BelowPlaneFilter:
    """State: the ids of the rejected corners while they are tracked. Reader: `CornerSelector`."""

    def __init__(self, camera: Camera, config: BelowPlaneConfig) -> None:
        self.camera, self.config = camera, config
        self._ids: Ints = np.zeros(0, np.int64)

    def update(self, window: SlidingWindow, pose: Pose, ground: GroundPlane) -> None:
        """Tests the landmarks (metres) from a camera at `pose`; sets the depth of an outlier to unknown."""
        cfg = self.config
        with np.errstate(invalid="ignore"):
            seen, inverse_depths = window.seen_from(pose)
            road_inverse_depth = -(plane_normal(ground.pitch_rad, ground.roll_rad)[0] @ seen) / self.camera.height_m
            upper_bound = inverse_depths + cfg.sigmas * window.rho_sigma
            outlier = (road_inverse_depth > 1.0 / cfg.far_m) & (upper_bound < road_inverse_depth / cfg.depth_ratio)
        window.rho[outlier] = np.nan
        self._ids = np.union1d(self._ids, window.ids[outlier])

    def inliers(self, ids: Ints) -> Bools:
        """(N,) inliers among the corners (N,), ascending. Removes outliers that are no longer tracked."""
        outlier, at = match_ids(self._ids, ids)
        self._ids = self._ids[outlier]
        inlier = np.ones(len(ids), bool)
        inlier[at] = False
        return inlier
