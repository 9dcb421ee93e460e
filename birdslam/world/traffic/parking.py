"""Parking: along kerbs, perpendicular or angled in front of houses, and on lots beside the street."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from birdslam.world.rendering import materials as m
from birdslam.world.street.street import Street
from birdslam.world.traffic.placement import Scenery

ALONG_M, ACROSS_M = 6.2, 2.8  # spacing of parallel and perpendicular places
_ROW_M, _AISLE_M = 5.0, 5.5  # depth of a perpendicular row, and of the aisle between two rows


@dataclass(frozen=True)
class Row:
    """Cars side by side, or one behind the other, between s0 and s1; `turn_rad` is the first choice of two."""

    d_m: float
    turn_rad: float
    odds: float  # probability that a place is taken
    s0_m: float
    s1_m: float

    @property
    def along(self) -> bool:
        return abs(math.sin(self.turn_rad)) < 0.2

    @property
    def pitch_m(self) -> float:
        """Spacing of places along the street."""
        return ALONG_M if self.along else ACROSS_M / abs(math.sin(self.turn_rad))


@dataclass(frozen=True)
class Lot:
    """Rows of places on free ground beside the street."""

    s0_m: float
    s1_m: float
    near_m: float  # its side towards the street, d
    far_m: float
    rows: tuple[Row, ...]
    border_m: float  # height of the hedge towards the street; 0: none


def kerb_rows(rng: np.random.Generator, street: Street, full: float, s0_m: float, s1_m: float) -> list[Row]:
    """Rows along the kerbs that the street's cross-section allows; `full` in [0, 1] is the occupancy."""
    rows = [Row(d, 0.0 if direction >= 0 else math.pi, 0.5 + 0.5 * full, s0_m, s1_m) for d, direction in street.parking]
    if street.kind in ("residential", "urban", "industrial", "alley"):
        for edge, front, sign in ((street.right_m, street.front_right_m, -1), (street.left_m, street.front_left_m, 1)):
            if rng.random() < 0.25:  # two wheels on the pavement
                rows.append(Row(edge + sign * 0.8, math.pi if sign > 0 else 0.0, 0.15 + 0.5 * full, s0_m, s1_m))
            if rng.random() < 0.25:  # perpendicular, in front of houses
                rows.append(Row(front + sign * 3.2, 0.5 * math.pi, 0.4 * full, s0_m, s1_m))
    return rows


def draw_lots(rng: np.random.Generator, street: Street, ego_s_m: float) -> tuple[Lot, ...]:
    """Up to two lots on each side of a town street: angled or perpendicular bays, or a car park of several rows."""
    if street.kind in ("country", "motorway"):
        return ()
    out: list[Lot] = []
    sides = (-1.0, street.right_m, street.front_right_m), (1.0, street.left_m, street.front_left_m)
    for sign, edge, front in sides:
        s = ego_s_m + float(rng.uniform(-8.0, 30.0))
        for _ in range(2):
            u = rng.random(8)
            s1 = s + 14.0 + 45.0 * float(u[0])
            rows = 1 if u[1] < 0.55 else int(rng.integers(2, 4))
            near = front + sign * (0.3 if u[2] < 0.6 else float(rng.uniform(1.0, 9.0)))
            if u[4] < 0.4 and not any(d * sign > 0.0 for d, _ in street.parking):  # bays right beside the lanes
                near = edge + sign * 0.3
            far = near + sign * (rows * _ROW_M + (rows - 1) * 0.6 * _AISLE_M + 1.0)
            if u[3] < 0.35 and _level(street, s, s1, far):
                out.append(_lot(rng, s, s1, near, far, sign, rows))
            s = s1 + float(rng.uniform(6.0, 40.0))
    return tuple(out)


def _level(street: Street, s0_m: float, s1_m: float, far_m: float) -> bool:
    """Whether no side road and no sharp bend crosses the lot."""
    side = 1 if far_m > 0.0 else -1
    stations = np.arange(s0_m, s1_m, 4.0)
    return not any(street.in_crossing(s, 6.0, side) or street.curvature(s) * far_m > 0.6 for s in stations)


def _lot(
    rng: np.random.Generator, s0_m: float, s1_m: float, near_m: float, far_m: float, sign: float, rows: int
) -> Lot:
    aslant = rng.random() < 0.5
    tilt = float(rng.uniform(0.7, 1.25)) if aslant else 0.5 * math.pi
    turn = sign * tilt if rng.random() < 0.5 else sign * (math.pi - tilt)  # nose away from the street
    odds = float(rng.uniform(0.45, 1.0))
    along = rows > 1 and rng.random() < 0.15
    out, at = [], near_m + sign * (0.5 + 0.5 * _ROW_M)
    for index in range(rows):
        out.append(Row(at, 0.0 if along else turn, odds, s0_m + 1.5, s1_m - 1.5))
        # Two rows nose to nose, then an aisle
        at += sign * ((_ROW_M if index % 2 else _ROW_M + _AISLE_M) if rows > 1 else 0.0) * (0.55 if along else 1.0)
    far_m = out[-1].d_m + sign * (0.5 * _ROW_M + 0.5)
    border = float(rng.uniform(0.15, 0.7)) if rng.random() < 0.4 else 0.0
    return Lot(s0_m, s1_m, near_m, far_m, tuple(out), border)


def cleared(standing: Scenery, lots: tuple[Lot, ...], rng: np.random.Generator) -> Scenery:
    """Moves scenery off the lots: houses behind them, plants to their borders."""
    out = Scenery([], [], [], [], [])
    columns = (standing.kind, standing.s_m, standing.d_m, standing.turn_rad, standing.parameters)
    for kind, s_m, d_m, turn_rad, P in zip(*columns, strict=True):
        along, across = float(P[m.LENGTH]), float(P[m.WIDTH])
        if abs(math.sin(turn_rad)) > 0.7:
            along, across = across, along
        lot = next((lot for lot in lots if _on(lot, s_m, d_m, along, across)), None)
        if lot is not None and kind == m.BUILDING:
            d_m = lot.far_m + math.copysign(0.5 * across + float(rng.uniform(0.3, 4.0)), lot.far_m)
        elif lot is not None and kind in (m.POST, m.SIGN):
            if abs(d_m - lot.near_m) > 0.6:
                continue
        elif lot is not None and kind not in (m.LIGHTS, m.BRIDGE):
            continue
        out.kind.append(kind)
        out.s_m.append(s_m)
        out.d_m.append(d_m)
        out.turn_rad.append(turn_rad)
        out.parameters.append(P)
    for lot in lots:
        sign = math.copysign(1.0, lot.near_m)
        high_m = float(rng.uniform(0.8, 3.5)) if rng.random() < 0.5 else 0.0
        for d_m, h in ((lot.near_m - 0.1 * sign, lot.border_m), (lot.far_m + 0.8 * sign, high_m)):
            if h > 0.0:
                size = (lot.s1_m - lot.s0_m, float(rng.uniform(0.4, 1.2)), h)
                P = out.add(m.HEDGE, 0.5 * (lot.s0_m + lot.s1_m), d_m, 0.0, size)
                P[:3] = np.array([0.05, 0.08, 0.028]) * rng.uniform(0.4, 1.5)
                P[m.SEED] = rng.random()
    return out


def _on(lot: Lot, s_m: float, d_m: float, along_m: float, across_m: float) -> bool:
    low, high = sorted((lot.near_m, lot.far_m))
    return (
        lot.s0_m - 0.5 * along_m < s_m < lot.s1_m + 0.5 * along_m and low - 0.5 * across_m < d_m < high + 0.5 * across_m
    )
