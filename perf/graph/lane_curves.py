"""Lane lines as curves in the graph: they hold ego and vehicles sideways and in heading, never along.

For the ablation `python -m perf lane_edges`, beside the graph, as factors of one's own are registered.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.se2 import SE2
from birdslam.graph.factors.factor import Factor, GraphFrame, Linearised
from birdslam.graph.state_layout import OF_VEHICLE
from birdslam.graph.window import Window
from birdslam.types import Lane, LineKind, Measurements

STATION_M = 1.0  # from one point of a curve to the next
NEAR_M, FAR_M = 3.0, 25.0  # of a curve that is put on the map
LEAST_OVERLAP_M = 8.0  # of a curve with its map, for an edge: a shorter piece has no heading
EVERY_M = 5.0  # of way between two edges of a line: what is filtered errs alike for a while
GATE = 9.0  # squared Mahalanobis distance
# Vehicles keep to their lane: 1-sigma from its middle and of their heading; both last, so that one a second counts
ASIDE_M, ALONG_RAD, LASTS_FRAMES = 0.4, 0.05, 10
LEAST_EXISTENCE = 0.9


@dataclass(frozen=True)
class SeenCurve:
    """A line in ego: stations (N,), x rising; covariance (2, 2) of its offset at their middle and its heading."""

    line: int
    x_m: Floats
    y_m: Floats
    cov: Floats


@dataclass(frozen=True)
class OnCurve:
    """A vehicle on a curve: the foot of its place there and the heading in ego, 1-sigma aside and in heading."""

    vehicle: int
    T_ego_foot: SE2
    aside_m: float
    along_rad: float


def seen_curves(m: Measurements, more: float = 1.0) -> list[SeenCurve]:
    """The painted lines of a frame that saw them; their covariances times `more`."""
    lanes = m.road_lanes
    if lanes is None or lanes.age_ns:
        return []
    out = []
    for line in lanes.lines:
        x = np.arange(NEAR_M, min(line.seen_to_m, FAR_M), STATION_M)
        if line.kind is LineKind.EDGE or line.existence < LEAST_EXISTENCE or not len(x):
            continue
        H = _offset_and_slope(0.5 * float(x[0] + x[-1]))
        y = np.array([line.y_m(at) for at in x.tolist()])
        out.append(SeenCurve(line.line, x, y, more * H @ np.reshape(line.cov, (4, 4)) @ H.T))
    return out


def vehicles_in_lanes(m: Measurements) -> list[OnCurve]:
    """The vehicles that are surely in a lane and move there."""
    lanes = m.road_lanes
    if lanes is None:
        return []
    out = []
    for edge in m.cv:
        T, sigma_y = edge.T_ego_vehicle, math.sqrt(edge.cov[4])
        for lane in lanes.lanes:
            inside = 0.5 * (lane.width_m + lane.width_slope * T.x_m) - abs(T.y_m - lane.centre_m(T.x_m))
            if edge.standing < 0.5 and 0.0 < T.x_m < lane.to_m and inside > 2.0 * sigma_y and not lane.carriageway:
                out.append(_on(lane, edge.vehicle, T))
    return out


def _on(lane: Lane, vehicle: int, T: SE2) -> OnCurve:
    H = _offset_and_slope(T.x_m)
    var_y, var_slope = np.diag(H @ np.reshape(lane.cov, (4, 4)) @ H.T).tolist()
    slope = lane.slope + T.x_m * (lane.curvature_per_m + 0.5 * T.x_m * lane.curvature_rate_per_m2)
    aside, along = math.hypot(ASIDE_M, math.sqrt(var_y)), math.hypot(ALONG_RAD, math.sqrt(var_slope))
    return OnCurve(vehicle, SE2(T.x_m, lane.centre_m(T.x_m), math.atan(slope)), aside, along)


def _offset_and_slope(x: float) -> Floats:
    """(2, 4) of `LaneLine`'s four numbers, `x` m ahead."""
    return np.array([[1.0, x, x * x / 2.0, x**3 / 6.0], [0.0, 1.0, x, x * x / 2.0]])


class EgoOnLines(Factor):
    """A line is put on the map where it is first seen; what is seen of it later holds the ego's offset and heading."""

    name = "lane curves"
    equation = "y - y_map = -dy - x dyaw"

    def __init__(self) -> None:
        self.begin()

    def begin(self) -> None:
        """No line yet."""
        self._map: dict[int, list[complex]] = {}  # points in world, along the way
        self._cov: dict[int, Floats] = {}  # of the piece that was put there last
        self._at_m: dict[int, float] = {}  # of the ego's way, at a line's last edge
        self._way_m = 0.0
        self._seen: list[SeenCurve] = []

    def linearise(self, frame: GraphFrame, window: Window) -> Linearised | None:
        """The lines of this frame that lie on the map."""
        self._way_m += math.hypot(frame.motion.x_m, frame.motion.y_m)
        self._seen = [record for record in frame.records if isinstance(record, SeenCurve)]
        residuals: list[float] = []
        rows, covs = [], []
        for curve in self._seen:
            if curve.line not in self._map or self._way_m < self._at_m[curve.line] + EVERY_M:
                continue
            x_map, y_map = self._in_ego(curve.line, window.world)
            both = (curve.x_m >= x_map[0]) & (curve.x_m <= x_map[-1])
            x = curve.x_m[both]
            if len(x) * STATION_M < LEAST_OVERLAP_M:
                continue
            self._at_m[curve.line] = self._way_m
            middle = float(x.mean())
            turn, gap = np.polyfit(x - middle, curve.y_m[both] - np.interp(x, x_map, y_map), 1).tolist()
            residuals += [gap, turn]
            J = np.zeros((2, window.layout.size))
            J[:, 1:3] = (-1.0, -middle), (0.0, -1.0)
            rows.append(J)
            covs.append(curve.cov + self._cov[curve.line])
        return Linearised(residuals, np.vstack(rows), np.array(covs), GATE) if rows else None

    def conclude(self, frame: GraphFrame, window: Window) -> None:
        """Lengthens the map's lines by what is seen beyond them."""
        T = window.world
        heading = cmath.rect(1.0, T.yaw_rad)
        for curve in self._seen:
            known = self._map.setdefault(curve.line, [])
            end = self._in_ego(curve.line, T)[0][-1] if known else -math.inf
            new = [complex(x, y) for x, y in zip(curve.x_m.tolist(), curve.y_m.tolist(), strict=True) if x > end]
            if new:
                known += [complex(T.x_m, T.y_m) + heading * p for p in new]
                del known[:-200]
                self._cov[curve.line] = curve.cov
            self._at_m.setdefault(curve.line, self._way_m)
        alive = {curve.line for curve in self._seen}
        for line in [line for line in self._map if self._seen and line not in alive]:
            del self._map[line], self._cov[line], self._at_m[line]

    def _in_ego(self, line: int, T: SE2) -> tuple[Floats, Floats]:
        p = (np.array(self._map[line]) - complex(T.x_m, T.y_m)) * cmath.rect(1.0, -T.yaw_rad)
        ahead = np.maximum.accumulate(p.real)  # a line that comes back is none that is followed
        return ahead, p.imag


class VehiclesOnLanes(Factor):
    """A vehicle keeps to its lane: its place across it and its heading."""

    name = "vehicles in lanes"
    equation = "(n (foot - p), psi - yaw)"
    of_vehicles = True

    def linearise(self, frame: GraphFrame, window: Window) -> Linearised | None:
        """One edge for each vehicle of the window that a record is of."""
        row_of = {node.vehicle: row for row, node in enumerate(frame.vehicles.nodes)}
        residuals: list[float] = []
        rows, by_own, covs = [], [], []
        for record in frame.records:
            if not isinstance(record, OnCurve) or record.vehicle not in row_of:
                continue
            row = row_of[record.vehicle]
            at, heading = window.at[window.nodes + row], window.heading[window.nodes + row]
            along = cmath.rect(1.0, record.T_ego_foot.yaw_rad)
            if (along * heading.conjugate()).real < 0.0:  # it comes towards the ego
                along = -along
            aside = (complex(record.T_ego_foot.x_m, record.T_ego_foot.y_m) - at) * along.conjugate()
            residuals += [aside.imag, cmath.phase(along * heading.conjugate())]
            J = np.zeros((2, OF_VEHICLE))
            J[0, :2] = -along.imag, along.real
            J[1, 2] = 1.0
            rows.append(row)
            by_own.append(J)
            covs.append(np.diag([LASTS_FRAMES * record.aside_m**2, LASTS_FRAMES * record.along_rad**2]))
        return Linearised(residuals, np.array(by_own), np.array(covs), GATE, rows) if rows else None


# --- the most that lines could say ---


def line_along(way: dict[int, SE2], sigma_m: float, left_m: float = 1.75) -> dict[int, SeenCurve]:
    """Each frame's sight, without error, of a line without a gap that is painted at the left of the true way."""
    frames = sorted(way)
    world = [complex(way[f].x_m, way[f].y_m) + left_m * cmath.rect(1.0, way[f].yaw_rad + 0.5 * math.pi) for f in frames]
    spaced = [world[0]]
    for point in world:
        if abs(point - spaced[-1]) > 0.5 * STATION_M:
            spaced.append(point)
    line = np.array(spaced)
    out = {}
    for frame in frames:
        T = way[frame]
        p = (line - complex(T.x_m, T.y_m)) * cmath.rect(1.0, -T.yaw_rad)
        near = (p.real > -5.0) & (p.real < FAR_M + 5.0) & (abs(p) < FAR_M + 10.0)
        x, y = p.real[near], p.imag[near]
        if len(x) > 1 and (np.diff(x) > 0.0).all():
            at = np.arange(NEAR_M, min(FAR_M, float(x[-1])), STATION_M)
            if len(at) >= LEAST_OVERLAP_M / STATION_M:
                cov = np.diag([sigma_m**2, (sigma_m / (0.3 * len(at) * STATION_M)) ** 2])
                out[frame] = SeenCurve(0, at, np.interp(at, x, y), cov)
    return out


def poses_on_curves(
    ego: dict[int, SE2], vehicles: dict[int, dict[int, SE2]], matches: dict[int, dict[int, int]]
) -> Iterator[tuple[int, OnCurve]]:
    """Frame, and a vehicle's true place across its way and true heading, surer than any lane shows them."""
    for frame, match in matches.items():
        for label, vehicle in match.items():
            if frame in vehicles[label]:
                T = ego[frame].between(vehicles[label][frame])
                yield frame, OnCurve(vehicle, T, 0.1 / math.sqrt(LASTS_FRAMES), 0.02 / math.sqrt(LASTS_FRAMES))
