"""Which corners the ego-motion is estimated from: those of the static street.

Left out are corners on vehicles (road/points.py), below-plane outliers (below_plane.py) and, where the windscreen is
dirty, those fixed in the image (obstruction/fixed_corners.py).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.geometry.pose import Pose
from birdslam.odometry.corners.below_plane import BelowPlaneConfig, BelowPlaneFilter
from birdslam.odometry.corners.feature_tracks import Tracks
from birdslam.odometry.corners.sliding_window import SlidingWindow, match_ids
from birdslam.odometry.obstruction.fixed_corners import FixedCorners, FixedCornersConfig
from birdslam.odometry.road.points import is_night, outside

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Corners:
    """The N corners of one image that lie outside vehicles and are no below-plane outliers."""

    ids: Ints  # (N,) ascending
    xy: Floats  # (N, 2) normalised coordinates
    displacement_px: Floats  # (M,) since the reference image, of those that it shows too and that are not fixed
    fixed: Bools  # (N,) fixed in the image while the car drives: on the windscreen, or on a line along the road

    def without_fixed(self) -> Corners:
        """The corners that are not fixed in the image."""
        moves = ~self.fixed
        return Corners(self.ids[moves], self.xy[moves], self.displacement_px, self.fixed[moves])


class CornerSelector:
    """State: that of the two filters. Reader: `Odometry`."""

    def __init__(self, camera: Camera, fixed_corners: FixedCornersConfig, below_plane: BelowPlaneConfig) -> None:
        self._camera = camera
        self._fixed_corners = FixedCorners(camera, fixed_corners)
        self._below_plane = BelowPlaneFilter(camera, below_plane)

    @property
    def obstructed(self) -> bool:
        """Whether there are corners on the glass."""
        return self._fixed_corners.present

    def select(
        self, tracks: Tracks, reference: Tracks, boxes_px: Floats, ground: GroundPlane, driven_m: float | None
    ) -> Corners:
        """The corners of the present image; `driven_m` is the car's travel since the image before, None if unknown."""
        static = outside(tracks.px, boxes_px, is_night(tracks.image))
        ids, px = tracks.ids[static], tracks.px[static]
        self._fixed_corners.begin(reference.ids, reference.px)
        fixed = self._fixed_corners.update(ids, px, ground, driven_m)
        inlier = self._below_plane.inliers(ids)
        ids, px, fixed = ids[inlier], px[inlier], fixed[inlier]
        fixed &= self.obstructed
        a, b = match_ids(reference.ids, ids)
        a, b = a[~fixed[b]], b[~fixed[b]]
        displacement: Floats = np.sqrt(((px[b] - reference.px[a]) ** 2).sum(axis=1))
        return Corners(ids, self._camera.to_xy(px), displacement, fixed)

    def reject_below_plane(self, window: SlidingWindow, pose: Pose, ground: GroundPlane) -> None:
        """Rejects landmarks of the window, which is in metres; not behind a dirty windscreen, whose depths err."""
        if not self._fixed_corners.present:
            self._below_plane.update(window, pose, ground)
