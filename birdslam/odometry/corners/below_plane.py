"""Below-plane outliers: landmarks that appear to lie below the road surface they are seen on.

A ray below the horizon meets the road; a landmark triangulated well beyond that point is wrong. It moves along with the
car (another car, the glow of lamps, dirt on the windscreen), slides along a lane line, or was mismatched with a
repetition of itself (the posts of a guard rail). Such corners agree with one another on a rotation that is too small or
on no motion at all, so that a robust kernel does not reject them.
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
    """When a landmark is an outlier. By judgement. On KITTI 00, 01 and 06 some 2 to 14 of 1000 corners below the
    horizon are, on the two rendered nights every third, on 0005 without boxes every fourth (the car ahead)."""

    depth_ratio: Positive = 2.0  # of the landmark's depth to the road's, at the least
    far_m: Positive = 40.0  # beyond it nothing is rejected: crests and dips hide more of the road there
    sigmas: Positive = 2.0  # of the inverse depth, by which the landmark must be too far


class BelowPlaneFilter:
    """State: the ids of the rejected corners, for as long as they are tracked. Reader: `CornerSelector`."""

    def __init__(self, camera: Camera, config: BelowPlaneConfig) -> None:
        self.camera, self.config = camera, config
        self._ids: Ints = np.zeros(0, np.int64)

    def update(self, window: SlidingWindow, pose: Pose, ground: GroundPlane) -> None:
        """Tests the landmarks (in metres) from a camera at `pose`; the depth of an outlier is set to unknown."""
        cfg = self.config
        with np.errstate(invalid="ignore"):
            seen, inverse_depths = window.seen_from(pose)
            road_inverse_depth = -(plane_normal(ground.pitch_rad, ground.roll_rad)[0] @ seen) / self.camera.height_m
            upper_bound = inverse_depths + cfg.sigmas * window.rho_sigma
            outlier = (road_inverse_depth > 1.0 / cfg.far_m) & (upper_bound < road_inverse_depth / cfg.depth_ratio)
        window.rho[outlier] = np.nan
        self._ids = np.union1d(self._ids, window.ids[outlier])

    def inliers(self, ids: Ints) -> Bools:
        """(N,) which of the corners (N,), ascending, are no outliers. Outliers that are not tracked are forgotten."""
        outlier, at = match_ids(self._ids, ids)
        self._ids = self._ids[outlier]
        inlier = np.ones(len(ids), bool)
        inlier[at] = False
        return inlier
