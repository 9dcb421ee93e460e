"""Which images stay in the window of the bundle adjustment: one after each piece of way that shows parallax."""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.pose import Pose
from birdslam.odometry.bundle_adjustment import SlidingWindow

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]
Count = Annotated[int, msgspec.Meta(ge=1)]


class KeyWindowConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How many images, how far apart, and what is adjusted after each."""

    key_images: Annotated[int, msgspec.Meta(ge=3)] = 8  # keyframes that are adjusted together
    adjusted_landmarks: Count = 400  # at most so many of them
    adjust_iterations: Count = 1  # each image adjusts again what the one before left
    key_parallax_px: Positive = 8.0  # a new key image when the median landmark has moved so far, rotation taken out
    key_distance_m: Positive = 0.7  # a new keyframe also after so long a way
    sigma_track_px: Positive = 0.35  # 1-sigma of a followed corner
    reject_px: Positive = 2.2  # a landmark that is off by more is an outlier


class KeyWindow(SlidingWindow):
    """Key images, and behind them the newest image, which becomes one where the next is far enough from the last."""

    def __init__(self, focal_px: float, config: KeyWindowConfig) -> None:
        super().__init__(focal_px, config.sigma_track_px, config.reject_px)
        self.config = config
        self._provisional = False  # the newest image is no key image yet

    def extend(self, frame_id: int, pose: Pose, ids: Ints, xy: Floats) -> Pose:
        """Puts the present image into the window in place of a provisional one, and adjusts; its pose after that."""
        cfg = self.config
        if self._provisional:
            newest = self.poses[-2].between(pose)
            parallax = self._parallax_px(ids, xy, newest.R)
            if parallax > cfg.key_parallax_px or float(np.linalg.norm(newest.p)) > cfg.key_distance_m:
                # The provisional image becomes a key image only if it is itself far enough from the last.
                held = self.poses[-2].between(self.poses[-1])
                if float(np.linalg.norm(held.p)) < 0.5 * cfg.key_distance_m and parallax < 2.0 * cfg.key_parallax_px:
                    self.drop(len(self.poses) - 1)
            else:
                self.drop(len(self.poses) - 1)
        self.append(frame_id, pose, ids, xy)
        self._provisional = True
        while len(self.poses) > cfg.key_images + 1:
            self.drop(0)
        self.triangulate()
        # The prior on steps: loose, but it alone carries the unit of length.
        loose = 1.0 / 0.3**2
        prior = np.array([loose, loose, loose, 1e2, 1e2, 1e2])
        self.adjust(cfg.adjust_iterations, cfg.adjusted_landmarks, prior)
        if not np.isfinite(self.poses[-1].p).all():
            self.poses[-1] = pose
        return self.poses[-1]

    def _parallax_px(self, ids: Ints, xy: Floats, R_key_curr: Floats) -> float:
        at = np.minimum(np.searchsorted(self.ids, ids), max(len(self.ids) - 1, 0))
        then = self.obs[len(self.poses) - 2, at]
        both = (self.ids[at] == ids) & np.isfinite(then[:, 0])
        if both.sum() < 10:
            return np.inf
        turned = np.column_stack([xy[both], np.ones(int(both.sum()))]) @ R_key_curr.T
        return float(np.median(np.abs(turned[:, :2] / turned[:, 2:] - then[both]).max(axis=1))) * self.focal_px
