"""The ego's lane over time: its width and lane changes.

State: the mean width of the lanes seen, and the side of each line. A lane change is a line that moves from one side of
the ego to the other by at least MIN_CROSSED_M.
"""

from __future__ import annotations

import math

from birdslam.lanes.line_filter import Tilt
from birdslam.lanes.topology import WIDTH_M, WIDTH_SIGMA_M, lane_row
from birdslam.types import Bound, Lane, LaneChange, LaneLine, Lanes, LineKind

MIN_CROSSED_M = 0.3  # min. distance past the line after a lane change
WIDTH_GAIN = 0.05  # gain of the running mean of the width
LEVEL_ROAD = Tilt()
MIN_SIGMA_M = 0.15  # spread of the widths of one road's lanes


class EgoLane:
    """Builds `Lanes` from each frame's lines."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Restarts with the default width."""
        self._width_m, self._sigma_m = WIDTH_M, WIDTH_SIGMA_M
        self._sides: dict[int, float] = {}  # line -> its last clear side: +1 left, -1 right

    def lanes(
        self, lines: tuple[LaneLine, ...], age_ns: int, tilt: Tilt = LEVEL_ROAD, road_from_m: float = 0.0
    ) -> Lanes:
        """The lanes between the lines (in the current ego), and whether the ego has just changed lanes."""
        row = lane_row(lines, self._width_m, self._sigma_m)
        own = None if row.ego is None else row.lanes[row.ego]
        self._update_width(own)
        return Lanes(
            lines=lines,
            lanes=row.lanes,
            ego_index=row.ego,
            change=self._detect_change(lines),
            age_ns=age_ns,
            tilt_rad=tilt.tangent_rad,
            vertical_curvature_per_m=tilt.vertical_per_m,
            road_from_m=road_from_m,
        )

    def _update_width(self, own: Lane | None) -> None:
        if own is None or own.left_bound is not Bound.PAINT or own.right_bound is not Bound.PAINT:
            return
        self._width_m += WIDTH_GAIN * (own.width_m - self._width_m)
        self._sigma_m = max(MIN_SIGMA_M, (1.0 - WIDTH_GAIN) * self._sigma_m)

    def _detect_change(self, lines: tuple[LaneLine, ...]) -> LaneChange:
        change = LaneChange.NONE
        sides: dict[int, float] = {}
        for line in lines:
            if line.kind is LineKind.EDGE:
                continue
            before = self._sides.get(line.line)
            side = math.copysign(1.0, line.offset_m) if abs(line.offset_m) > MIN_CROSSED_M else before
            if side is not None:
                sides[line.line] = side
            if before is not None and side is not None and side != before:
                change = LaneChange.LEFT if before > 0.0 else LaneChange.RIGHT
        self._sides = sides
        return change
