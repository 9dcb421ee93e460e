"""Keyframe selection: which images stay in the window of the bundle adjustment, by parallax and by distance."""

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

# Information of a pose's step, (translation, rotation): loose, but nothing else holds the scale.
_STEP_PRIOR = np.array([1.0 / 0.3**2] * 3 + [1e2] * 3)
_MIN_MATCHES = 10  # landmarks that two images must share for a parallax


class KeyframeConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How many keyframes, how far apart, and what is adjusted after each image."""

    keyframes: Annotated[int, msgspec.Meta(ge=3)] = 8  # keyframes that are adjusted together
    adjusted_landmarks: Count = 400  # at most so many of them
    adjust_iterations: Count = 1  # Gauss-Newton steps an image: the next one goes on from there
    # A short window under far landmarks loses its scale: by parallax alone a film of 30 Hz has keyframes 0.4 m
    # apart, and its window is 3 m long. So the distance decides, at any rate; the parallax only where houses are near
    keyframe_parallax_px: Positive = 60.0  # median parallax of a new keyframe, rotation compensated
    # With the road's comparisons left out, the town dashcam film's unit drifts from 0.97 to 1.27 of GPS in 17 s at
    # 0.7 m, from 0.96 to 1.05 at 1.5, from 0.92 to 1.06 at 3; KITTI odometry 01, 06 and the motorway clip hardly notice
    keyframe_distance_m: Positive = 1.2  # distance of a new keyframe, whatever the parallax
    sigma_track_px: Positive = 0.35  # 1-sigma of a tracked corner
    reject_px: Positive = 2.2  # a landmark's reprojection error past it is an outlier


class KeyframeWindow(SlidingWindow):
    """The keyframes and, last, the newest image, which is provisional: it stays if the next one needs a keyframe."""

    def __init__(self, focal_px: float, config: KeyframeConfig) -> None:
        super().__init__(focal_px, config.sigma_track_px, config.reject_px)
        self.config = config
        self._provisional = False  # the newest image is no keyframe yet

    def extend(self, frame_id: int, pose: Pose, ids: Ints, xy: Floats, predicted_sigma_m: float = np.inf) -> None:
        """Adds the present image to the window and triangulates its corners.

        `pose` is in the window's frame; ids (N,) ascending, xy (N, 2) corners in normalised coordinates;
        `predicted_sigma_m` as in `SlidingWindow`.
        """
        cfg = self.config
        if self._provisional and not self._needs_keyframe(pose, ids, xy):
            self.drop(len(self.poses) - 1)
        self.append(frame_id, pose, ids, xy, predicted_sigma_m)
        self._provisional = True
        while len(self.poses) > cfg.keyframes + 1:
            self.drop(0)
        self.triangulate()

    def refine(self) -> Pose:
        """Bundle adjustment; returns the adjusted pose of the present image."""
        cfg, before = self.config, self.poses[-1]
        adjust(self, cfg.adjust_iterations, cfg.adjusted_landmarks, _STEP_PRIOR)
        if not np.isfinite(self.poses[-1].p).all():
            self.poses[-1] = before
        return self.poses[-1]

    def _needs_keyframe(self, pose: Pose, ids: Ints, xy: Floats) -> bool:
        """Whether the provisional image becomes a keyframe: it and the present one are far from the last keyframe."""
        cfg = self.config
        present = self.poses[-2].between(pose)
        parallax_px = self._parallax_px(ids, xy, present.R)
        far = parallax_px > cfg.keyframe_parallax_px or float(np.linalg.norm(present.p)) > cfg.keyframe_distance_m
        provisional_m = float(np.linalg.norm(self.poses[-2].between(self.poses[-1]).p))
        near = provisional_m < 0.5 * cfg.keyframe_distance_m and parallax_px < 2.0 * cfg.keyframe_parallax_px
        return far and not near

    def _parallax_px(self, ids: Ints, xy: Floats, R_key_curr: Floats) -> float:
        """Median displacement of shared landmarks since the last keyframe, rotation compensated."""
        at = np.minimum(np.searchsorted(self.ids, ids), max(len(self.ids) - 1, 0))
        then = self.obs[len(self.poses) - 2, at]
        both = (self.ids[at] == ids) & np.isfinite(then[:, 0])
        if both.sum() < _MIN_MATCHES:
            return np.inf
        turned = xy[both] @ R_key_curr[:, :2].T + R_key_curr[:, 2]
        moved = np.abs(turned[:, :2] / turned[:, 2:] - then[both])
        return quantile(np.maximum(moved[:, 0], moved[:, 1]), 0.5) * self.focal_px
