"""Keyframes: which images stay in the window of the bundle adjustment, by parallax and by distance."""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.pose import Pose
from birdslam.odometry.corners.bundle_adjustment import adjust
from birdslam.odometry.corners.sliding_window import SlidingWindow
from birdslam.odometry.median import quantile

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]
Count = Annotated[int, msgspec.Meta(ge=1)]

# Information of each step of a pose, (translation, rotation): loose, but it alone carries the unit of length.
_STEP_PRIOR = np.array([1.0 / 0.3**2] * 3 + [1e2] * 3)
_LEAST_SHARED = 10  # landmarks that two images must share for a parallax


class KeyframeConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How many keyframes, how far apart, and what is adjusted after each image."""

    keyframes: Annotated[int, msgspec.Meta(ge=3)] = 8  # keyframes that are adjusted together
    adjusted_landmarks: Count = 400  # at most so many of them
    adjust_iterations: Count = 1  # each image adjusts again what the one before left
    keyframe_parallax_px: Positive = 8.0  # a new keyframe when the median landmark moved so far, rotation taken out
    keyframe_distance_m: Positive = 0.7  # a new keyframe also after so long a way
    sigma_track_px: Positive = 0.35  # 1-sigma of a followed corner
    reject_px: Positive = 2.2  # a landmark's reprojection error past it is an outlier


class KeyframeWindow(SlidingWindow):
    """Keyframes and, behind them, the newest image, which becomes one when the next is far enough from the last."""

    def __init__(self, focal_px: float, config: KeyframeConfig) -> None:
        super().__init__(focal_px, config.sigma_track_px, config.reject_px)
        self.config = config
        self._provisional = False  # the newest image is no keyframe yet

    def extend(self, frame_id: int, pose: Pose, ids: Ints, xy: Floats, held_m: float = np.inf) -> None:
        """Puts the present image into the window and triangulates its corners.

        `pose` is its relative pose, ids (N,) ascending and xy (N, 2) its corners in normalised coordinates; `held_m` is
        1-sigma of its place where a held speed gave it.
        """
        cfg = self.config
        if self._provisional and not self._becomes_keyframe(pose, ids, xy):
            self.drop(len(self.poses) - 1)
        self.append(frame_id, pose, ids, xy, held_m)
        self._provisional = True
        while len(self.poses) > cfg.keyframes + 1:
            self.drop(0)
        self.triangulate()

    def refine(self) -> Pose:
        """Adjusts poses and landmarks; gives the pose of the present image after that."""
        cfg, before = self.config, self.poses[-1]
        adjust(self, cfg.adjust_iterations, cfg.adjusted_landmarks, _STEP_PRIOR)
        if not np.isfinite(self.poses[-1].p).all():
            self.poses[-1] = before
        return self.poses[-1]

    def _becomes_keyframe(self, pose: Pose, ids: Ints, xy: Floats) -> bool:
        """Whether the provisional image stays: the present one is far from the last keyframe, and so is itself."""
        cfg = self.config
        present = self.poses[-2].between(pose)
        parallax_px = self._parallax_px(ids, xy, present.R)
        far = parallax_px > cfg.keyframe_parallax_px or float(np.linalg.norm(present.p)) > cfg.keyframe_distance_m
        provisional_m = float(np.linalg.norm(self.poses[-2].between(self.poses[-1]).p))
        near = provisional_m < 0.5 * cfg.keyframe_distance_m and parallax_px < 2.0 * cfg.keyframe_parallax_px
        return far and not near

    def _parallax_px(self, ids: Ints, xy: Floats, R_key_curr: Floats) -> float:
        """Median displacement of shared landmarks since the last keyframe, rotation taken out."""
        at = np.minimum(np.searchsorted(self.ids, ids), max(len(self.ids) - 1, 0))
        then = self.obs[len(self.poses) - 2, at]
        both = (self.ids[at] == ids) & np.isfinite(then[:, 0])
        if both.sum() < _LEAST_SHARED:
            return np.inf
        turned = xy[both] @ R_key_curr[:, :2].T + R_key_curr[:, 2]
        moved = np.abs(turned[:, :2] / turned[:, 2:] - then[both])
        return quantile(np.maximum(moved[:, 0], moved[:, 1]), 0.5) * self.focal_px
