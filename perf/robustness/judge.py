"""Compares the estimates that a planner receives during faults with the truth."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable

import numpy as np

from birdslam.types import INVALIDATING, Estimate, Status

# A pose is wrong if its error since the first valid pose of its epoch exceeds the sum of these:
SIGMAS = 3.0  # of its covariance
PATH_SHARE = 0.05  # of the distance; undisturbed odometry on the software camera errs by up to 2 %
TRUTH_FRAMES = 2.0  # uncertainty of the truth, one frame at each end
YAW_RAD = 0.05  # max. error of the yaw beside the sigmas
SEEN_STATUSES = 6


class Judge:
    """Evaluates the planner's estimates; `truth_m` gives the true position at a frame's capture."""

    def __init__(self, truth_m: Callable[[int], float], frame_m: float) -> None:
        self._truth_m, self._frame_m = truth_m, frame_m
        self.estimates: list[tuple[int, Estimate]] = []  # received (CLOCK_MONOTONIC ns)
        self.silent_ms = 0.0  # longest silence
        self.wrong = 0  # wrong poses that were marked valid
        self.error_m = 0.0  # largest error of a pose marked valid
        self.backwards = 0  # count of falling frame numbers
        self._anchors: dict[int, Estimate] = {}  # by epoch, the first valid measured estimate
        self._last_ns = time.monotonic_ns()

    def see(self, estimate: Estimate | None) -> None:
        """Takes the planner's next estimate; None: none for a moment."""
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
        """Number of estimates marked valid despite their status, invalid numbers, or a blind camera.

        Wrong positions are counted in `wrong`.
        """
        wrong = 0
        for _, estimate in self.estimates:
            contradicts = not INVALIDATING.isdisjoint(estimate.status)
            blinded = blind is not None and blind[0] <= estimate.t_capture_ns <= blind[1]
            wrong += estimate.valid and (contradicts or blinded or not np.isfinite(estimate.cov).all())
        return wrong

    def summary(self) -> str:
        """The text for the table."""
        invalid = sum(not estimate.valid for _, estimate in self.estimates)
        statuses = Counter(status.value for _, estimate in self.estimates for status in estimate.status)
        epochs = {estimate.epoch for _, estimate in self.estimates}
        carried = (Status.DETECTIONS_CARRIED, Status.SEGMENTATION_CARRIED)
        seen = [f"{name} {n}" for name, n in statuses.most_common(SEEN_STATUSES) if name not in carried]
        new = f", {len(epochs) - 1} new epochs" if len(epochs) > 1 else ""
        silence = f"silent for {self.silent_ms:.0f} ms at the most"
        return f"{len(self.estimates)} estimates, {invalid} invalid, {silence}{new}; {', '.join(seen) or 'no status'}"
