"""Keyframe selection by parallax and distance, for the window of the bundle adjustment."""

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

# Information of a pose's step (translation, rotation); weak, but it fixes the gauge freedom of the scale
_STEP_PRIOR = np.array([1.0 / 0.3**2] * 3 + [1e2] * 3)
_MIN_MATCHES = 10  # shared landmarks of two images, for a parallax


class KeyframeConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Parameters of the keyframe window and of its adjustment."""

    keyframes: Annotated[int, msgspec.Meta(ge=3)] = 8  # number of keyframes in the window
    adjusted_landmarks: Count = 400  # maximum number of adjusted landmarks
    adjust_iterations: Count = 1  # Gauss-Newton steps per image
    # Median rotation-compensated parallax of a new keyframe, for near structure; otherwise the distance decides
    keyframe_parallax_px: Positive = 60.0
    keyframe_distance_m: Positive = 1.2  # distance of a new keyframe: the scale of a short window drifts
    sigma_track_px: Positive = 0.35  # 1-sigma of a tracked corner
    reject_px: Positive = 2.2  # outlier threshold of the reprojection error


class KeyframeWindow(SlidingWindow):
    """The keyframes and the newest image, which is provisional until the next image arrives."""

    def __init__(self, focal_px: float, config: KeyframeConfig) -> None:
        super().__init__(focal_px, config.sigma_track_px, config.reject_px)
        self.config = config
        self._is_provisional = False  # whether the newest image is not a keyframe yet

    def extend(self, frame_id: int, pose: Pose, ids: Ints, xy: Floats, predicted_sigma_m: float = np.inf) -> None:
        """Adds the current image to the window and triangulates its corners.

        `pose` is in the window frame; ids (N,) are ascending; xy (N, 2) are corners in normalised coordinates;
        `predicted_sigma_m` is as in `SlidingWindow`.
        """
        cfg = self.config
        if self._is_provisional and not self._needs_keyframe(pose, ids, xy):
            self.drop(len(self.poses) - 1)
        self.append(frame_id, pose, ids, xy, predicted_sigma_m)
        self._is_provisional = True
        while len(self.poses) > cfg.keyframes + 1:
            self.drop(0)
        self.triangulate()

    def refine(self) -> Pose:
        """Runs the bundle adjustment and returns the pose of the current image."""
        cfg, before = self.config, self.poses[-1]
        adjust(self, cfg.adjust_iterations, cfg.adjusted_landmarks, _STEP_PRIOR)
        if not np.isfinite(self.poses[-1].p).all():
            self.poses[-1] = before
        return self.poses[-1]

    def _needs_keyframe(self, pose: Pose, ids: Ints, xy: Floats) -> bool:
        """Whether the provisional image becomes a keyframe: it and the current image are far from the last keyframe."""
        cfg = self.config
        present = self.poses[-2].between(pose)
        parallax_px = self._parallax_px(ids, xy, present.R)
        far = parallax_px > cfg.keyframe_parallax_px or float(np.linalg.norm(present.p)) > cfg.keyframe_distance_m
        provisional_m = float(np.linalg.norm(self.poses[-2].between(self.poses[-1]).p))
        near = provisional_m < 0.5 * cfg.keyframe_distance_m and parallax_px < 2.0 * cfg.keyframe_parallax_px
        return far and not near

    def _parallax_px(self, ids: Ints, xy: Floats, R_key_curr: Floats) -> float:
        """Median rotation-compensated displacement of shared landmarks since the last keyframe."""
        at = np.minimum(np.searchsorted(self.ids, ids), max(len(self.ids) - 1, 0))
        then = self.obs[len(self.poses) - 2, at]
        both = (self.ids[at] == ids) & np.isfinite(then[:, 0])
        if both.sum() < _MIN_MATCHES:
            return np.inf
        turned = xy[both] @ R_key_curr[:, :2].T + R_key_curr[:, 2]
        moved = np.abs(turned[:, :2] / turned[:, 2:] - then[both])
        return quantile(np.maximum(moved[:, 0], moved[:, 1]), 0.5) * self.focal_px
