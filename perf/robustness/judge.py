"""What a planner receives of a vehicle under faults, compared with where the car really was."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable

import numpy as np

from birdslam.types import INVALIDATING, Estimate, Status

# A pose is wrong where it is farther from the truth than this, since the first valid one of its epoch:
SIGMAS = 3.0  # of its own covariance, and
PATH_SHARE = 0.05  # of the way (undisturbed the odometry errs by up to 2 % on the software camera's coarse image), and
TRUTH_FRAMES = 2.0  # to which the truth is known, one frame at each end
YAW_RAD = 0.05  # or turned by more, beside the same sigmas
SEEN_STATUSES = 6


class Judge:
    """Takes what comes to the planner; `truth_m` says how far the car had come when a frame was captured."""

    def __init__(self, truth_m: Callable[[int], float], frame_m: float) -> None:
        self._truth_m, self._frame_m = truth_m, frame_m
        self.estimates: list[tuple[int, Estimate]] = []  # received (CLOCK_MONOTONIC ns)
        self.silent_ms = 0.0  # longest silence
        self.wrong = 0  # poses that were marked valid and were not where the car was
        self.error_m = 0.0  # the largest of one marked valid
        self.backwards = 0  # frame numbers that fell
        self._anchors: dict[int, Estimate] = {}  # by epoch, the first valid estimate that was measured
        self._last_ns = time.monotonic_ns()

    def see(self, estimate: Estimate | None) -> None:
        """What the planner has just got; None: nothing for a moment."""
        now_ns = time.monotonic_ns()
        self.silent_ms = max(self.silent_ms, (now_ns - self._last_ns) / 1e6)
        if estimate is None:
            return
        self._last_ns = now_ns
        if self.estimates and estimate.epoch == self.estimates[-1][1].epoch:
            self.backwards += estimate.frame_id < self.estimates[-1][1].frame_id
        self.estimates.append((now_ns, estimate))
        if estimate.valid and Status.COASTING not in estimate.status:
            self._anchors.setdefault(estimate.epoch, estimate)
        if estimate.valid and estimate.epoch in self._anchors:
            self._compare(self._anchors[estimate.epoch], estimate)

    def _compare(self, anchor: Estimate, estimate: Estimate) -> None:
        driven_m = self._truth_m(estimate.t_capture_ns) - self._truth_m(anchor.t_capture_ns)
        moved = anchor.T_world_ego.between(estimate.T_world_ego)
        error_m = math.hypot(moved.x_m - driven_m, moved.y_m)
        grown = np.maximum(np.subtract(estimate.cov, anchor.cov)[[0, 4, 8]], 0.0)
        sigma_m = math.sqrt(grown[0] + grown[1] + (estimate.scale_sigma_rel * driven_m) ** 2)
        allowed_m = SIGMAS * sigma_m + PATH_SHARE * abs(driven_m) + TRUTH_FRAMES * self._frame_m
        turned = abs(moved.yaw_rad) > SIGMAS * math.sqrt(grown[2]) + YAW_RAD
        self.wrong += error_m > allowed_m or turned
        self.error_m = max(self.error_m, error_m)

    def wrongly_valid(self, blind: tuple[int, int] | None) -> int:
        """Estimates marked valid that can't be: by their own status, by numbers that are none, or captured while the
        camera showed nothing. Where the car was is `wrong`."""
        wrong = 0
        for _, estimate in self.estimates:
            contradicts = not INVALIDATING.isdisjoint(estimate.status)
            blinded = blind is not None and blind[0] <= estimate.t_capture_ns <= blind[1]
            wrong += estimate.valid and (contradicts or blinded or not np.isfinite(estimate.cov).all())
        return wrong

    def summary(self) -> str:
        """For the table."""
        invalid = sum(not estimate.valid for _, estimate in self.estimates)
        statuses = Counter(status.value for _, estimate in self.estimates for status in estimate.status)
        epochs = {estimate.epoch for _, estimate in self.estimates}
        carried = (Status.DETECTIONS_CARRIED, Status.SEGMENTATION_CARRIED)
        seen = [f"{name} {n}" for name, n in statuses.most_common(SEEN_STATUSES) if name not in carried]
        new = f", {len(epochs) - 1} new epochs" if len(epochs) > 1 else ""
        silence = f"silent for {self.silent_ms:.0f} ms at the most"
        return f"{len(self.estimates)} estimates, {invalid} invalid, {silence}{new}; {', '.join(seen) or 'no status'}"
