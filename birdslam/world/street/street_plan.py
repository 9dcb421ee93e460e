"""Draws a random street: lanes and their lines, roadsides, crossings, paint across the road."""

from __future__ import annotations

import numpy as np

from birdslam.geometry.arrays import Floats32
from birdslam.world.street.course import MAX_CURVATURE_PER_M, Course, draw_course
from birdslam.world.street.street import (
    ARROW,
    ASPHALT,
    BAND,
    CEMENT,
    COBBLES,
    CROSSING,
    CYCLE,
    FIGURES,
    GRASS,
    HATCHED,
    KERB,
    LINE,
    LINE_KINDS,
    MANHOLE,
    MARK,
    PARKING,
    PATCH,
    RAILS,
    SLABS,
    SOIL,
    STOP_LINE,
    ZEBRA,
    Lane,
    Street,
)

_KINDS = ("residential", "urban", "avenue", "country", "motorway", "industrial", "alley")
_ODDS = (0.27, 0.25, 0.16, 0.1, 0.07, 0.08, 0.07)
_SPEED_MPS = {"residential": 9.0, "urban": 13.0, "avenue": 14.0, "country": 22.0, "motorway": 28.0,
              "industrial": 11.0, "alley": 6.0}  # fmt: skip


def draw_street(
    rng: np.random.Generator, length_m: float, ego_s_m: float, kind: str | None = None, course: Course | None = None
) -> Street:
    """A street of a kind (random unless given), `length_m` long, with its bends around the ego at `ego_s_m`."""
    kind = kind or str(rng.choice(_KINDS, p=_ODDS))
    course = course or draw_course(rng, length_m, ego_s_m, MAX_CURVATURE_PER_M[kind])
    u = rng.random(40)
    wide = {"motorway": 3.6, "avenue": 3.25, "country": 3.2, "alley": 2.4}.get(kind, 3.0)
    width = wide + 0.5 * (u[0] - 0.4)
    forth, back, median = _lane_counts(rng, kind)
    sides = [_Side(rng, kind), _Side(rng, kind)]  # right, left
    painted = u[1] < {"residential": 0.4, "alley": 0.1, "industrial": 0.65}.get(kind, 0.96)
    yellow = float(u[2] < 0.25)
    wear = u[3] ** 1.5
    left, right = back * width + 0.5 * median, -(forth * width + 0.5 * median)
    if kind in ("country", "motorway"):
        left, right = left + 0.3, right - 0.3
    lines = _lines(rng, forth, back, width, median, painted, yellow, wear, (right, left), sides, kind)
    surface = ASPHALT if u[4] < 0.82 else (COBBLES if u[4] < 0.9 and kind in ("residential", "alley") else CEMENT)
    tone = 0.75 + 0.5 * u[5]
    bands: list[tuple[float, ...]] = [(right, left, 0.0, 0.0, surface, tone)]
    if median > 0.0:
        k = 0.13 if u[6] < 0.8 else 0.0
        fill = float(rng.choice([GRASS, SLABS, RAILS, SOIL], p=[0.5, 0.2, 0.2, 0.1]))
        m = 0.5 * median
        bands = [
            (right, -m, 0.0, 0.0, surface, tone),
            (-m, -m + 0.02, 0.0, k, KERB, 1.0),
            (-m + 0.02, -m + 0.15, k, k, KERB, 1.0),
            (-m + 0.15, m - 0.15, k, k, fill, 0.9),
            (m - 0.15, m - 0.02, k, k, KERB, 1.0),
            (m - 0.02, m, k, 0.0, KERB, 1.0),
            (m, left, 0.0, 0.0, surface, tone),
        ]
    parking, fronts, edges = [], [], []
    limit = 0.75 / max(float(np.abs(course.curvature).max()), 1e-4)
    for side, edge, sign in ((sides[0], right, -1.0), (sides[1], left, 1.0)):
        rows, strip, edge_m, front_m = side.bands(edge, sign, tone, min(limit, 75.0))
        bands += rows
        if strip is not None:
            parking.append((strip, -1 if sign > 0 and back else 1))
        edges.append(edge_m)
        fronts.append(front_m)
    bands.sort()
    crossings = _crossings(rng, kind, length_m, ego_s_m)
    lanes = [Lane(-0.5 * median - (i + 0.5) * width, 1, _SPEED_MPS[kind]) for i in range(forth)]
    lanes += [Lane(0.5 * median + (i + 0.5) * width, -1, _SPEED_MPS[kind]) for i in range(back)]
    x, y, z, yaw = course.table()
    return Street(
        kind, x, y, z, yaw, np.array(bands, np.float32).reshape(-1, len(BAND)),
        np.array(lines, np.float32).reshape(-1, len(LINE)), crossings,
        _marks(rng, kind, length_m, ego_s_m, crossings, lanes, width, (right, left), painted), tuple(lanes),
        tuple(parking), edges[0], edges[1], fronts[0], fronts[1],
        {"country": 0.08, "motorway": 0.12, "industrial": 0.7}.get(kind, 0.55 + 0.45 * u[8]), 0.15 + 0.85 * u[9],
    )  # fmt: skip


def _lane_counts(rng: np.random.Generator, kind: str) -> tuple[int, int, float]:
    """Lanes forth and back, and the width of the median."""
    if kind == "motorway":
        return int(rng.integers(2, 5)), int(rng.choice([0, 2, 3])), float(rng.uniform(1.5, 6.0))
    if kind == "avenue":
        forth = int(rng.integers(2, 5))
        back = int(rng.choice([0, forth, max(1, forth - 1)], p=[0.2, 0.5, 0.3]))
        return forth, back, float(rng.choice([0.0, rng.uniform(1.0, 8.0)])) if back else 0.0
    if kind == "urban":
        return int(rng.choice([1, 2, 3], p=[0.65, 0.25, 0.1])), int(rng.choice([0, 1, 2], p=[0.12, 0.68, 0.2])), 0.0
    if kind == "alley":
        return 1, int(rng.choice([0, 1])), 0.0
    return 1, int(rng.choice([0, 1], p=[0.15, 0.85])), 0.0


class _Side:
    """One roadside: parking, cycle lane, kerb, verge, pavement."""

    def __init__(self, rng: np.random.Generator, kind: str) -> None:
        u = rng.random(12)
        town = kind not in ("country", "motorway")
        self.parking_m = 1.9 + 0.6 * u[0] if town and u[1] < {"residential": 0.6, "urban": 0.5}.get(kind, 0.25) else 0.0
        self.parking_surface = [PARKING, COBBLES, SLABS][int(3 * u[2] * u[2])]
        self.cycle_m = 1.3 + 0.8 * u[3] if town and u[4] < 0.15 else 0.0
        self.kerb_m = 0.06 + 0.1 * u[5] if town and u[6] < 0.93 else 0.0
        self.verge_m = 0.8 + 2.5 * u[7] if u[8] < (0.35 if town else 1.0) else 0.0
        self.pavement_m = 1.2 + 3.0 * u[9] if town and u[10] < 0.93 else 0.0
        self.shoulder_m = 0.5 + 2.5 * u[9] if kind == "motorway" else (0.4 * u[9] if kind == "country" else 0.0)
        self.far = GRASS if u[11] < 0.6 else (SLABS if town and u[11] < 0.8 else SOIL)

    def bands(
        self, edge: float, sign: float, tone: float, limit_m: float
    ) -> tuple[list[tuple[float, ...]], float | None, float, float]:
        """Bands outwards from the edge of the lanes; the parking strip's centre, the edges of road and front."""
        rows: list[tuple[float, ...]] = []
        at, z, strip = edge, 0.0, None

        def go(width: float, surface: float, rise: float = 0.0, shade: float = 1.0) -> None:
            nonlocal at, z
            if width <= 0.0:
                return
            to = at + sign * width
            row = (at, to, z, z + rise) if sign > 0 else (to, at, z + rise, z)
            rows.append((*row, surface, shade))
            at, z = to, z + rise

        go(self.cycle_m, CYCLE, shade=tone)
        go(self.shoulder_m, ASPHALT, shade=tone * 0.95)
        if self.parking_m > 0.0:
            strip = at + sign * 0.5 * self.parking_m
            go(self.parking_m, self.parking_surface, shade=tone * 1.1)
        road_edge = at
        go(0.02, KERB, self.kerb_m)
        go(0.13 if self.kerb_m > 0.0 else 0.0, KERB)
        go(self.verge_m, GRASS)
        go(self.pavement_m, SLABS)
        front = at
        width = max(min(limit_m, 75.0) - abs(at), 0.5)
        go(min(6.0, 0.5 * width), self.far)
        go(width - min(6.0, 0.5 * width), GRASS)
        return rows, strip, road_edge, front


def _lines(
    rng: np.random.Generator, forth: int, back: int, width: float, median: float, painted: bool, yellow: float,
    wear: float, edges: tuple[float, float], sides: list[_Side], kind: str,
) -> list[tuple[float, ...]]:  # fmt: skip
    rows: list[tuple[float, ...]] = []
    phase, w = float(rng.uniform(0, 20)), float(rng.uniform(0.1, 0.18))
    period, dash = ((12.0, 4.0), (9.0, 3.0), (18.0, 6.0), (6.0, 3.0), (4.0, 2.0))[int(rng.integers(0, 5))]

    def line(d: float, name: str, thick: float = w, colour: float = 0.0) -> None:
        p, q = (2.0, 1.0) if name == "dotted" else (period, dash)
        rows.append((d, LINE_KINDS.index(name), thick, p, q, phase, colour, wear, len(rows)))

    for i in range(1, forth):
        line(
            -0.5 * median - i * width, "dashed" if painted and rng.random() < 0.88 else ("solid" if painted else "kerb")
        )
    for i in range(1, back):
        line(0.5 * median + i * width, "dashed" if painted else "kerb")
    if not painted:
        rows.clear()
    if back and median == 0.0 and painted:
        odds = [0.25, 0.45, 0.15, 0.1, 0.05] if kind == "avenue" or back + forth > 3 else [0.2, 0.7, 0.05, 0.03, 0.02]
        line(0.0, str(rng.choice(["solid", "dashed", "double", "double_dashed", "dotted"], p=odds)), w, yellow)
    elif back and median > 0.0:
        for d in (0.5 * median + 0.25, -0.5 * median - 0.25):
            line(d, "solid" if painted and rng.random() < 0.6 else "kerb", w, yellow)
    edge_paint = kind in ("country", "motorway") or (painted and rng.random() < 0.35)
    for side, d, sign in ((sides[0], edges[0], -1.0), (sides[1], edges[1], 1.0)):
        if edge_paint or (painted and side.cycle_m > 0.0):
            line(
                d - 0.15 * sign,
                str(rng.choice(["solid", "dotted"], p=[0.9, 0.1])),
                w,
                yellow * float(sign > 0 and not back),
            )
        if not edge_paint or side.parking_m > 0.0 or side.cycle_m > 0.0:
            line(d + sign * (side.cycle_m + side.parking_m), "kerb")
    return rows


def _crossings(rng: np.random.Generator, kind: str, length_m: float, ego_s_m: float) -> Floats32:
    rows: list[tuple[float, ...]] = []
    if kind in ("motorway",):
        return np.zeros((0, len(CROSSING)), np.float32)
    s = ego_s_m + rng.uniform(-25, 50)
    while s > 30.0:
        s -= rng.uniform(60, 140)
    while s < length_m:
        if rng.random() < (0.3 if kind == "country" else 0.75):
            left, right = ((1.0, 1.0), (1.0, 0.0), (0.0, 1.0))[int(rng.choice(3, p=[0.4, 0.3, 0.3]))]
            rows.append((s, rng.uniform(2.5, 6.5), left, right, rng.uniform(2.0, 7.0), float(rng.random() < 0.5)))
        s += rng.uniform(50, 150)
    return np.array(rows, np.float32).reshape(-1, len(CROSSING))


def _marks(
    rng: np.random.Generator, kind: str, length_m: float, ego_s_m: float, crossings: Floats32,
    lanes: list[Lane], width: float, edges: tuple[float, float], painted: bool,
) -> Floats32:  # fmt: skip
    rows: list[tuple[float, ...]] = []
    right, left = edges
    for s, half, *_ in crossings.tolist():
        zebra = rng.random() < 0.35
        for sign in (-1.0, 1.0):
            away = s + sign * (half + 2.5)
            if zebra:
                rows.append((ZEBRA, away, away + sign * 3.0, right, left, rng.random()))
            if painted and rng.random() < 0.6:
                stop = away + sign * (4.0 if zebra else 0.5)
                mine = [lane.d_m for lane in lanes if lane.direction == -sign]
                if mine:
                    rows.append(
                        (STOP_LINE, stop, stop + sign * 0.4, min(mine) - 0.45 * width, max(mine) + 0.45 * width, 0.0)
                    )
            for lane in lanes:
                if painted and lane.direction == -sign and len(lanes) > 2 and rng.random() < 0.6:
                    at = away + sign * rng.uniform(8, 25)
                    rows.append(
                        (
                            ARROW,
                            at,
                            at + 5.0,
                            lane.d_m - 0.5,
                            lane.d_m + 0.5,
                            lane.direction * (1 + int(rng.integers(0, 3))),
                        )
                    )
    for _ in range(int(rng.integers(0, 4))):
        lane = lanes[int(rng.integers(0, len(lanes)))]
        s = rng.uniform(0, length_m)
        rows.append(
            (
                FIGURES,
                s,
                s + rng.uniform(2, 4),
                lane.d_m - 0.8,
                lane.d_m + 0.8,
                lane.direction * (1 + int(rng.integers(0, 16))),
            )
        )
    if rng.random() < 0.06 and painted and len(lanes) > 1:
        s = ego_s_m + rng.uniform(5, 40)
        rows.append((HATCHED, s, s + rng.uniform(10, 30), -0.8, 0.8, 0.0))
    per_m = float(rng.choice([0.01, 0.03, 0.1]))
    for _ in range(int(per_m * min(length_m, 600.0))):
        s, d, long = rng.uniform(0, length_m), rng.uniform(right, left), rng.uniform(1, 14)
        rows.append((PATCH, s, s + long, d, d + rng.uniform(0.5, 2.5), rng.uniform(0.6, 1.3)))
        if rng.random() < 0.5:
            s, d = rng.uniform(0, length_m), rng.uniform(right, left)
            rows.append((MANHOLE, s - 0.35, s + 0.35, d - 0.35, d + 0.35, rng.random()))
    out = np.array(rows, np.float32).reshape(-1, len(MARK))
    flipped = out[:, 1] > out[:, 2]
    out[flipped, 1:3] = out[flipped, 2:0:-1]
    return out[np.argsort(out[:, 1], kind="stable")]
