"""Corners that seem to lie behind the road that they are seen on: wrong ones.

Nothing that is seen below the horizon can be farther than the road there, but where the ground falls away. What seems
to be so moves along with the car (another car, the glow of its lamps, what is fixed to the glass), slides along a line
of the lane, or was taken for the next of several alike, as the posts of a rail are. Such corners agree with one
another: that the camera turns less than it does, or hardly moves.
"""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.geometry.pose import Pose
from birdslam.odometry.corners.sliding_window import SlidingWindow, common
from birdslam.odometry.road.alignment import plane_normal

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]


class BeyondRoadConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """When a corner lies too far away. By judgement. On KITTI 00, 01 and 06 some 2 to 14 of 1000 corners below the
    horizon do, on the two rendered nights every third, on 0005 without boxes every fourth (the car ahead)."""

    depth_ratio: Positive = 2.0  # times the road's distance
    far_m: Positive = 40.0  # the road's distance, past which crests and dips can hide more of it than that
    sigmas: Positive = 2.0  # of the inverse depth, by which a corner must be too far


class BeyondRoad:
    """State: the ids of the corners that were found so. Reader: `Odometry`, which corners to use."""

    def __init__(self, camera: Camera, config: BeyondRoadConfig) -> None:
        self.camera, self.config = camera, config
        self._ids: Ints = np.zeros(0, np.int64)

    def judge(self, window: SlidingWindow, pose: Pose, ground: GroundPlane) -> None:
        """Looks at the landmarks as a camera at `pose` sees them, in metres; those that are wrong leave the window."""
        cfg = self.config
        with np.errstate(invalid="ignore"):
            seen, inverse_depths = window.seen_from(pose)
            on_road = -(plane_normal(ground.pitch_rad, ground.roll_rad)[0] @ seen) / self.camera.height_m
            most = inverse_depths + cfg.sigmas * window.rho_sigma
            wrong = (on_road > 1.0 / cfg.far_m) & (most < on_road / cfg.depth_ratio)
        window.rho[wrong] = np.nan
        self._ids = np.union1d(self._ids, window.ids[wrong])

    def without(self, ids: Ints) -> Bools:
        """(N,) which of the corners (N,), ascending, are good; the others that are not among them are forgotten."""
        wrong, at = common(self._ids, ids)
        self._ids = self._ids[wrong]
        good = np.ones(len(ids), bool)
        good[at] = False
        return good
