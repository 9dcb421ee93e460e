"""A street: its centre line with curves and grades, its cross-section, paint, crossings.

Positions on a street are (s, d): metres along the centre line, and metres to the left of it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from birdslam.geometry.arrays import Floats, Floats32
from birdslam.world.street.course import STEP_M, Course

# Surfaces of a band of the cross-section
(ASPHALT, CEMENT, SLABS, GRASS, SOIL, COBBLES, KERB, CYCLE, PARKING, RAILS) = range(10)
# Paint across the road
(STOP_LINE, ZEBRA, ARROW, HATCHED, PATCH, MANHOLE, FIGURES) = range(7)
LINE_KINDS = ("solid", "dashed", "dotted", "double", "double_dashed", "kerb")
# Columns of `bands`, `lines`, `crossings`, `marks`
BAND = ("d_right", "d_left", "z_right", "z_left", "surface", "tone")
LINE = ("d", "kind", "width", "period", "dash", "phase", "yellow", "wear", "lane_id")
CROSSING = ("s", "half_width", "left", "right", "radius", "lines")
MARK = ("kind", "s0", "s1", "d0", "d1", "seed")


@dataclass(frozen=True)
class Lane:
    """A lane of traffic: its centre, its direction (1 with s, -1 against it), and its speed."""

    d_m: float
    direction: int
    speed_mps: float


@dataclass(frozen=True)
class Street:
    """`x_m, y_m, z_m, yaw_rad` of the centre line every STEP_M from s = 0; arrays have the columns named above."""

    kind: str
    x_m: Floats
    y_m: Floats
    z_m: Floats
    yaw_rad: Floats
    bands: Floats32
    lines: Floats32
    crossings: Floats32
    marks: Floats32
    lanes: tuple[Lane, ...]
    parking: tuple[tuple[float, int], ...]  # (d, direction) of the middle of parking strips
    right_m: float  # edges of the drivable road with parking strips
    left_m: float
    front_right_m: float  # start of gardens or fields
    front_left_m: float
    built: float  # density of houses, 0-1
    green: float  # density of trees, 0-1

    @property
    def length_m(self) -> float:
        return STEP_M * (len(self.x_m) - 1)

    def place(self, s: Floats, d: Floats) -> tuple[Floats, Floats, Floats, Floats, Floats]:
        """x, y, z of the road, heading of the street, and its slope dz/ds at (s, d)."""
        s, d = np.asarray(s, dtype=np.float64), np.asarray(d, dtype=np.float64)
        at = np.clip(s / STEP_M, 0.0, len(self.x_m) - 1.000001)
        i = at.astype(np.int64)
        f = at - i
        yaw = self.yaw_rad[i] * (1.0 - f) + self.yaw_rad[i + 1] * f
        x = self.x_m[i] * (1.0 - f) + self.x_m[i + 1] * f - d * np.sin(yaw)
        y = self.y_m[i] * (1.0 - f) + self.y_m[i + 1] * f + d * np.cos(yaw)
        z = self.z_m[i] * (1.0 - f) + self.z_m[i + 1] * f
        rise = np.gradient(self.z_m, STEP_M)
        return x, y, z, yaw, rise[i] * (1.0 - f) + rise[i + 1] * f

    def rise(self, s_m: float, d_m: float) -> float:
        """Height of the ground at (s, d) over the road's plane: kerbs and the ground behind them."""
        if self.in_crossing(s_m, 2.0, 1 if d_m > 0.0 else -1):
            return 0.0
        for d0, d1, z0, z1 in self.bands[:, :4].tolist():
            if d0 <= d_m <= d1:
                return float(z0 + (z1 - z0) * (d_m - d0) / max(d1 - d0, 1e-9))
        return 0.0

    def along(self, course: Course) -> Street:
        """The same street on another centre line of the same length."""
        x, y, z, yaw = course.table()
        return replace(self, x_m=x, y_m=y, z_m=z, yaw_rad=yaw)

    def curvature(self, s: float) -> float:
        i = int(min(max(s / STEP_M, 4.0), len(self.yaw_rad) - 5.0))
        return float(self.yaw_rad[i + 4] - self.yaw_rad[i - 4]) / (8.0 * STEP_M)

    def in_crossing(self, s: float, margin_m: float, side: int = 0) -> bool:
        """Whether s is within a crossing and the margin; with a road to `side` (1 left, -1 right, 0 any)."""
        return any(
            abs(s - row[0]) < row[1] + margin_m and (side == 0 or row[2 if side > 0 else 3] > 0.5)
            for row in self.crossings
        )
