"""The ego's lane ahead against what the line tracker finds when the ego gets there: a truth for drives without labels.

Near bounds of the ego lane, placed in world by the reported poses, are the borders of the lane that earlier frames saw
from afar. The odometry's drift over AHEAD_M adds to the errors; an error that is the same near and far is not seen.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from birdslam.bench.lanes.true_borders import RANGES_M, BorderScores
from birdslam.geometry.arrays import Floats
from birdslam.geometry.se2 import SE2
from birdslam.types import Estimate, LaneChange, Lanes

STEP_M = 1.0  # of the ego, between frames that count
AHEAD_M = RANGES_M[-1] + 2.0
NEAR_M = 6.0  # where bounds are true, or as near as the road is visible
MAX_NEAR_M = 12.0  # of that, since nothing is measured beyond
MAX_GAP_M = 3.0  # between places with a lane, for borders without a gap
WORST = 10  # frames that are named


@dataclass(frozen=True)
class Seen:
    """One frame: its number, pose and lanes; `stretch` changes where lanes of frames can't be compared."""

    frame_id: int
    stretch: int
    T_world_ego: SE2
    lanes: Lanes | None


@dataclass
class LaterLanes:
    """Collects the estimates of a drive."""

    seen: list[Seen] = field(default_factory=list)
    _stretch: int = 0
    _epoch: int = -1

    def add(self, estimate: Estimate) -> None:
        """Adds the next frame; lane changes, invalid frames and new epochs start a new stretch."""
        changes = estimate.lanes is not None and estimate.lanes.change != LaneChange.NONE
        if changes or not estimate.valid or estimate.epoch != self._epoch:
            self._stretch += 1
        self._epoch = estimate.epoch
        x_m, y_m = estimate.T_world_ego.x_m, estimate.T_world_ego.y_m
        if estimate.valid and (not self.seen or self._is_apart(x_m, y_m)):
            self.seen.append(Seen(estimate.frame_id, self._stretch, estimate.T_world_ego, estimate.lanes))

    def _is_apart(self, x_m: float, y_m: float) -> bool:
        last = self.seen[-1]
        moved_m = np.hypot(x_m - last.T_world_ego.x_m, y_m - last.T_world_ego.y_m)
        return last.stretch != self._stretch or bool(moved_m > STEP_M)

    def scores(self, first_frame: int) -> tuple[BorderScores, list[int]]:
        """Scores of all frames from `first_frame` on whose road is known later; the worst frames, worst first."""
        scores, worst = BorderScores(), list[tuple[float, int]]()
        for k, seen in enumerate(self.seen):
            borders = self._borders(k)
            if seen.frame_id < first_frame or borders is None:
                continue
            before = {x: len(errors) for x, errors in scores.errors.items()}
            scores.add(seen.lanes, *borders)
            off = [e for x, errors in scores.errors.items() for *bounds, _ in errors[before[x] :] for e in bounds]
            worst.append((max(off, default=0.0), seen.frame_id))
        return scores, [frame_id for _, frame_id in sorted(worst, reverse=True)[:WORST]]

    def _borders(self, k: int) -> tuple[Floats, Floats] | None:
        """(N, 2) points of the left and the right border in the ego of frame k, up to a gap; None if there are none."""
        here, points = self.seen[k], list[tuple[Floats, Floats]]()
        for later in self.seen[k:]:
            if later.stretch != here.stretch:
                break
            own = None if later.lanes is None else later.lanes.ego
            if later.lanes is None or own is None or (near_m := max(NEAR_M, later.lanes.road_from_m)) > MAX_NEAR_M:
                continue
            T_here_later = here.T_world_ego.between(later.T_world_ego)
            sides = (own.left_m(near_m), own.right_m(near_m))
            left, right = (T_here_later @ np.array([near_m, y_m]) for y_m in sides)
            if points and left[0] - points[-1][0][0] > MAX_GAP_M:
                break
            points.append((left, right))
            if left[0] > AHEAD_M:
                break
        if not points or points[-1][0][0] < RANGES_M[0]:
            return None
        return np.array([left for left, _ in points]), np.array([right for _, right in points])
