"""The ego's lane over time: its width, and the event of a lane change.

State of the front end: the width of lanes as it was seen, and the lines at the ego's sides. A lane change is when the
line that was at one side is at the other, and far enough that it is no wavering on the line.
"""

from __future__ import annotations

import math

from birdslam.lanes.line_filter import Tilt
from birdslam.lanes.topology import WIDTH_M, WIDTH_SIGMA_M, lane_row
from birdslam.types import Bound, Lane, LaneChange, LaneLine, Lanes, LineKind

CROSSED_M = 0.3  # past the line the ego has changed lanes
WIDTH_GAIN = 0.05  # of a frame's width, in the running mean
LEVEL = Tilt()
MIN_SIGMA_M = 0.15  # lanes of one road differ by this amount


class EgoLane:
    """Makes `Lanes` of each frame's lines."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """A new world: nothing is known."""
        self._width_m, self._sigma_m = WIDTH_M, WIDTH_SIGMA_M
        self._sides: dict[int, float] = {}  # line -> its side when it was last far enough: +1 left, -1 right

    def lanes(self, lines: tuple[LaneLine, ...], age_ns: int, tilt: Tilt = LEVEL, road_from_m: float = 0.0) -> Lanes:
        """The lanes between the lines (of a moment, in ego), and whether the ego has just changed."""
        row = lane_row(lines, self._width_m, self._sigma_m)
        own = None if row.ego is None else row.lanes[row.ego]
        self._learn_width(own)
        return Lanes(
            lines=lines,
            lanes=row.lanes,
            ego_index=row.ego,
            change=self._changed(lines),
            age_ns=age_ns,
            tilt_rad=tilt.tangent_rad,
            vertical_curvature_per_m=tilt.vertical_per_m,
            road_from_m=road_from_m,
        )

    def _learn_width(self, own: Lane | None) -> None:
        if own is None or own.left_bound is not Bound.PAINT or own.right_bound is not Bound.PAINT:
            return
        self._width_m += WIDTH_GAIN * (own.width_m - self._width_m)
        self._sigma_m = max(MIN_SIGMA_M, (1.0 - WIDTH_GAIN) * self._sigma_m)

    def _changed(self, lines: tuple[LaneLine, ...]) -> LaneChange:
        change = LaneChange.NONE
        sides: dict[int, float] = {}
        for line in lines:
            if line.kind is LineKind.EDGE:
                continue
            before = self._sides.get(line.line)
            side = math.copysign(1.0, line.offset_m) if abs(line.offset_m) > CROSSED_M else before
            if side is not None:
                sides[line.line] = side
            if before is not None and side is not None and side != before:
                change = LaneChange.LEFT if before > 0.0 else LaneChange.RIGHT
        self._sides = sides
        return change
