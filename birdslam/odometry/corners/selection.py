"""Selection of the static corners for the ego-motion.

Excludes corners on vehicles (road/points.py), below-plane outliers (below_plane.py) and, on a dirty windscreen, corners
that are fixed in the image (obstruction/fixed_corners.py).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.geometry.pose import Pose
from birdslam.odometry.corners.below_plane import BelowPlaneConfig, BelowPlaneFilter
from birdslam.odometry.corners.feature_tracks import Tracks
from birdslam.odometry.corners.sliding_window import SlidingWindow
from birdslam.odometry.obstruction.fixed_corners import FixedCorners, FixedCornersConfig
from birdslam.odometry.road.points import is_night, outside

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Corners:
    """The N corners of one image outside vehicles, without below-plane outliers."""

    ids: Ints  # (N,) ascending
    xy: Floats  # (N, 2) normalised coordinates
    displacement_px: Floats  # (M,) since the reference image, of shared corners that are not fixed
    fixed: Bools  # (N,) fixed in the image while the car moves

    def without_fixed(self) -> Corners:
        """The corners that are not fixed in the image."""
        moves = ~self.fixed
        return Corners(self.ids[moves], self.xy[moves], self.displacement_px, self.fixed[moves])


class CornerSelector:
    """State: that of its two filters. Reader: `Odometry`."""

    def __init__(self, camera: Camera, fixed_corners: FixedCornersConfig, below_plane: BelowPlaneConfig) -> None:
        self._camera = camera
        self._fixed_corners = FixedCorners(camera, fixed_corners)
        self._below_plane = BelowPlaneFilter(camera, below_plane)

    @property
    def obstructed(self) -> bool:
        """Whether corners are fixed to the windscreen."""
        return self._fixed_corners.present

    def select(
        self, tracks: Tracks, reference: Tracks, boxes_px: Floats, ground: GroundPlane, travelled_m: float | None
    ) -> Corners:
        """The corners of the current image; `travelled_m` is since the previous image, None if unknown."""
        static = outside(tracks.px, boxes_px, is_night(tracks.image))
        ids, px = tracks.ids[static], tracks.px[static]
        self._fixed_corners.start(reference.ids, reference.px)
        fixed = self._fixed_corners.update(ids, px, ground, travelled_m)
        inlier = self._below_plane.inliers(ids)
        ids, px, fixed = ids[inlier], px[inlier], fixed[inlier] & self.obstructed
        old = (tracks.age[static][inlier] > 0) & ~fixed
        displacement: Floats = np.linalg.norm(tracks.flow_px[static][inlier][old], axis=1)
        return Corners(ids, self._camera.to_xy(px), displacement, fixed)

    def reject_below_plane(self, window: SlidingWindow, pose: Pose, ground: GroundPlane) -> None:
        """Rejects below-plane landmarks of the window (metres); disabled on a dirty windscreen."""
        if not self._fixed_corners.present:
            self._below_plane.update(window, pose, ground)
