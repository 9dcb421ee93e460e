"""Traffic simulation: vehicles in lanes, parked cars, people. Continuous in time.

Drivers follow the intelligent driver model (Treiber, Hennecke, Helbing, 2000): they hold a speed, keep a gap to the
vehicle ahead in their lane, and change lanes smoothly to overtake.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from birdslam.world.rendering import materials as m
from birdslam.world.street.street import Street
from birdslam.world.traffic.fleet import Body, draw_cyclist, draw_pedestrian, draw_shape, draw_truck, draw_vehicle
from birdslam.world.traffic.parking import Lot, Row, kerb_rows

ACCELERATION_MPS2, BRAKING_MPS2, GAP_S, GAP_M = 1.5, 2.2, 1.3, 2.2
CHANGE_S = 3.5  # duration of a lane change


@dataclass
class Mover:
    """A body at (s, d), rotated by `turn_rad` relative to the street, moving at `speed_mps` along its x axis."""

    body: Body
    s_m: float
    d_m: float
    turn_rad: float
    speed_mps: float = 0.0
    wish_mps: float = 0.0
    lane_d_m: float | None = None  # centre of its lane; None: it follows no lane
    drift_mps: float = 0.0  # across the street
    acceleration_mps2: float = 0.0
    phase_per_m: float = 0.0
    stops: tuple[tuple[float, float], ...] = ()  # (s, end time): a red light
    plan: list[tuple[float, float, float]] = field(default_factory=list)  # (from s, lane's d, desired speed)
    walks: list[tuple[float, float, float]] = field(default_factory=list)  # without lane: (from t_s, turn, m/s)

    @property
    def direction(self) -> int:
        return 1 if math.cos(self.turn_rad) > 0.0 else -1

    @property
    def velocity(self) -> tuple[float, float]:
        """Velocity along the street and across it, m/s."""
        if self.lane_d_m is None:
            return self.speed_mps * math.cos(self.turn_rad), self.speed_mps * math.sin(self.turn_rad)
        return self.speed_mps * self.direction, self.drift_mps

    @property
    def length_m(self) -> float:
        return float(self.body.parameters[m.LENGTH])

    @property
    def width_m(self) -> float:
        return float(self.body.parameters[m.WIDTH])


def populate(
    rng: np.random.Generator, street: Street, ego_s_m: float, ego_d_m: float, reach_m: float = 110.0,
    lots: tuple[Lot, ...] = (),
) -> list[Mover]:  # fmt: skip
    """Traffic, parked cars and people around the ego, without overlaps."""
    u = rng.random(8)
    dense = u[0] ** 1.3
    taken: list[tuple[float, float, float, float, Row | None]] = [(ego_s_m - 1.0, ego_d_m, 3.5, 1.1, None)]
    out: list[Mover] = []

    def add(mover: Mover, margin_m: float, row: Row | None = None) -> bool:
        """Adds a mover unless it overlaps; in a `row` its spacing replaces this test, since angled boxes overlap."""
        cos, sin = abs(math.cos(mover.turn_rad)), abs(math.sin(mover.turn_rad))
        hs = 0.5 * (cos * mover.length_m + sin * mover.width_m)
        hd = 0.5 * (cos * mover.width_m + sin * mover.length_m)
        if any(
            abs(mover.s_m - s) < hs + rs + margin_m
            and abs(mover.d_m - d) < hd + rd + min(0.25, margin_m)
            and not (row is not None and row is other)
            for s, d, rs, rd, other in taken
        ):
            return False
        taken.append((mover.s_m, mover.d_m, hs, hd, row))
        out.append(mover)
        return True

    if u[5] < 0.25:
        _pass(rng.spawn(1)[0], street, ego_s_m, ego_d_m, add)
    jam = u[1] < 0.24
    for lane in street.lanes:
        gap = (5.5 + 5.0 * u[2]) if jam else 14.0 + 60.0 * (1.0 - dense) * rng.uniform(0.5, 1.5)
        speed = rng.uniform(0.0, 3.0) if jam else lane.speed_mps * rng.uniform(0.7, 1.1)
        s = ego_s_m - 25.0 + rng.uniform(0.0, gap)
        while s < ego_s_m + reach_m:
            if rng.random() < 0.85:
                cyclist = rng.random() < 0.05 and street.kind not in ("motorway",)
                body = draw_cyclist(rng) if cyclist else draw_vehicle(rng)
                d = lane.d_m + (rng.normal(0.0, 0.18) if not cyclist else -1.0 * lane.direction)
                own = float(np.clip(speed * rng.normal(1.0, 0.06), 0.0, 35.0)) * (0.45 if cyclist else 1.0)
                turn = (0.0 if lane.direction > 0 else math.pi) + rng.normal(0.0, 0.015)
                if add(Mover(body, s, d, turn, own, own, d, phase_per_m=1.1), 1.5):
                    s += 0.5 * float(body.parameters[m.LENGTH])
            s += gap * rng.uniform(0.6, 1.4) + (0.0 if jam else 3.0)
    _park(rng, kerb_rows(rng, street, u[3], ego_s_m - 15.0, ego_s_m + reach_m), street, add)
    if lots:
        _park(rng.spawn(1)[0], [row for lot in lots for row in lot.rows], street, add)
    _cross(rng, street, ego_s_m, reach_m, add)
    _walk(rng, street, ego_s_m, reach_m, add, u[4])
    return out


def _pass(rng: np.random.Generator, street: Street, ego_s_m: float, ego_d_m: float, add) -> None:  # type: ignore[no-untyped-def]
    """Trucks, buses and vans close beside the ego, which the image border truncates."""
    near = [lane for lane in street.lanes if 2.4 < abs(lane.d_m - ego_d_m) < 4.8]
    if near:
        lane = near[int(rng.integers(0, len(near)))]
        s = ego_s_m + rng.uniform(-5.0, 9.0)
        for _ in range(int(rng.integers(1, 4))):
            pick = rng.random()
            body = draw_truck(rng) if pick < 0.6 else draw_shape(rng, "bus" if pick < 0.75 else "big_van")
            length_m = float(body.parameters[m.LENGTH])
            turn = (0.0 if lane.direction > 0 else math.pi) + rng.normal(0.0, 0.015)
            speed = lane.speed_mps * rng.uniform(0.0, 1.0)
            d = lane.d_m + rng.normal(0.0, 0.15)
            add(Mover(body, s + 0.5 * length_m, d, turn, speed, lane.speed_mps, lane.d_m), 0.3)
            s += length_m + rng.uniform(1.5, 12.0)


def _park(rng: np.random.Generator, rows: list[Row], street: Street, add) -> None:  # type: ignore[no-untyped-def]
    """Parked cars in rows: along a kerb mostly in the direction of traffic, perpendicular ones either way."""
    for row in rows:
        pitch = row.pitch_m
        s = row.s0_m + rng.uniform(0.0, pitch)
        while s < row.s1_m:
            side = 1 if row.d_m > 0 else -1
            if rng.random() < row.odds and not street.in_crossing(s, 7.0, side):
                body = draw_vehicle(rng, parked=True)
                length_m = float(body.parameters[m.LENGTH])
                own = row.turn_rad + (math.pi if rng.random() < (0.15 if row.along else 0.5) else 0.0)
                if row.along or length_m < 5.2:
                    mover = Mover(body, s, row.d_m + rng.normal(0.0, 0.08), own + rng.normal(0.0, 0.03))
                    if add(mover, 0.4, None if row.along else row):
                        s += 0.5 * (length_m - 4.0) if row.along else 0.0
            s += pitch * rng.uniform(0.9, 1.15)


def _cross(rng, street: Street, ego_s_m: float, reach_m: float, add) -> None:  # type: ignore[no-untyped-def]
    """Cars on side roads, waiting, approaching or turning."""
    for s, half, left, right, *_ in street.crossings.tolist():
        if not ego_s_m - 10.0 < s < ego_s_m + reach_m:
            continue
        for flag, sign, edge in ((left, 1, street.left_m), (right, -1, street.right_m)):
            if flag < 0.5:
                continue
            for heading in (1, -1):
                at = edge + sign * rng.uniform(3.0, 14.0)
                for _ in range(int(rng.integers(0, 4))):
                    turn = heading * math.pi / 2
                    body = draw_vehicle(rng)
                    where = s + heading * min(1.7, 0.5 * half)
                    slow = float(rng.uniform(0, 6)) if heading == sign else 0.0
                    add(Mover(body, where, at, turn + rng.normal(0, 0.04), slow, slow), 0.8)
                    at += sign * rng.uniform(6.5, 16.0)
        if rng.random() < 0.3:
            turn = float(rng.uniform(-math.pi, math.pi))
            lane = street.lanes[int(rng.integers(0, len(street.lanes)))]
            add(Mover(draw_shape(rng, "hatchback"), s + rng.uniform(-3, 3), lane.d_m, turn, 4.0, 4.0), 1.0)


def _walk(rng, street: Street, ego_s_m: float, reach_m: float, add, busy: float) -> None:  # type: ignore[no-untyped-def]
    """People on pavements, at crossings, and a few on the road."""
    if street.kind in ("motorway", "country") and rng.random() < 0.8:
        return
    for _ in range(int(rng.poisson(1.0 + 7.0 * busy**2))):
        left = rng.random() < 0.5
        edge, front = (street.left_m, street.front_left_m) if left else (street.right_m, street.front_right_m)
        d = (
            edge + (front - edge) * rng.uniform(0.2, 1.0)
            if rng.random() < 0.85
            else rng.uniform(street.right_m, street.left_m)
        )
        turn = float(rng.choice([0.0, math.pi])) + rng.normal(0.0, 0.2)
        if rng.random() < 0.15:
            turn = float(rng.uniform(-math.pi, math.pi))
        s = ego_s_m + 3.0 + reach_m * rng.random() ** 1.5
        body = draw_pedestrian(rng) if rng.random() < 0.85 else draw_cyclist(rng)
        speed = (
            float(np.clip(rng.normal(1.2, 0.4), 0.0, 2.0)) if body.kind == m.PEDESTRIAN else float(rng.uniform(2, 6))
        )
        add(Mover(body, s, d, turn, speed, speed, phase_per_m=4.3 if body.kind == m.PEDESTRIAN else 1.1), 0.1)


def set_initial_motion(movers: list[Mover], street: Street) -> list[Mover]:
    """Prepares a drive: movers without lane stop, except people beside the road, who walk along it."""
    for mover in movers:
        walks = mover.body.kind in (m.PEDESTRIAN, m.CYCLIST) and not street.right_m < mover.d_m < street.left_m
        if mover.lane_d_m is None and walks:
            mover.turn_rad = 0.0 if math.cos(mover.turn_rad) > 0.0 else math.pi
        elif mover.lane_d_m is None:
            mover.speed_mps = 0.0
    return [
        v for v in movers if v.lane_d_m is not None or not street.right_m < v.d_m < street.left_m or _parks(v, street)
    ]


def _parks(mover: Mover, street: Street) -> bool:
    return any(abs(mover.d_m - d) < 0.6 for d, _ in street.parking)


def advance(movers: list[Mover], ego: Mover, street: Street, t_s: float, dt_s: float) -> None:
    """Moves all movers and the ego by `dt_s` from the time `t_s`."""
    everyone = [*movers, ego]
    for mover in everyone:
        if mover.lane_d_m is None:
            while mover.walks and t_s >= mover.walks[0][0]:
                _, mover.turn_rad, mover.speed_mps = mover.walks.pop(0)
            along, across = mover.velocity
            mover.s_m += along * dt_s
            mover.d_m += across * dt_s
            mover.body.parameters[m.PHASE] += mover.phase_per_m * mover.speed_mps * dt_s
        else:
            _follow(mover, everyone, street, t_s, dt_s)


def _follow(mover: Mover, everyone: list[Mover], street: Street, t_s: float, dt_s: float) -> None:
    """One step of the driver model."""
    while mover.plan and (mover.s_m - mover.plan[0][0]) * mover.direction >= 0.0:
        _, mover.lane_d_m, mover.wish_mps = mover.plan.pop(0)
    gap, closing = _ahead(mover, everyone, t_s)
    v, a0, b0 = mover.speed_mps, ACCELERATION_MPS2, BRAKING_MPS2
    wanted = GAP_M + max(0.0, v * GAP_S + v * closing / (2.0 * math.sqrt(a0 * b0)))
    target = a0 * (1.0 - (v / max(mover.wish_mps, 0.1)) ** 4 - (wanted / max(gap, 0.3)) ** 2)
    mover.acceleration_mps2 += (float(np.clip(target, -6.0, a0)) - mover.acceleration_mps2) * min(1.0, dt_s / 0.25)
    mover.speed_mps = max(0.0, v + mover.acceleration_mps2 * dt_s)
    if mover.speed_mps < 0.12 and target <= 0.05:  # the foot stays on the brake
        mover.speed_mps = 0.0
    if mover.speed_mps == 0.0:
        mover.acceleration_mps2 = max(mover.acceleration_mps2, 0.0)
    mover.body.parameters[m.BRAKING] = float(mover.acceleration_mps2 < -0.4 or mover.speed_mps < 0.2)
    step_m = 0.5 * (v + mover.speed_mps) * dt_s
    lane = mover.lane_d_m if mover.lane_d_m is not None else mover.d_m
    w = 4.0 / CHANGE_S  # towards the lane's centre like a critically damped spring, proportional to speed
    mover.drift_mps += (w * w * (lane - mover.d_m) - 2.0 * w * mover.drift_mps) * dt_s
    limit = 0.2 * mover.speed_mps
    mover.drift_mps = min(max(mover.drift_mps, -limit), limit)
    mover.d_m += mover.drift_mps * dt_s
    base = 0.0 if mover.direction > 0 else math.pi
    if mover.speed_mps > 0.05:
        mover.turn_rad = base + mover.direction * math.atan2(mover.drift_mps, mover.speed_mps)
    mover.s_m += step_m * mover.direction / max(1.0 - street.curvature(mover.s_m) * mover.d_m, 0.2)
    mover.body.parameters[m.PHASE] += mover.phase_per_m * step_m


def _ahead(mover: Mover, everyone: list[Mover], t_s: float) -> tuple[float, float]:
    """Gap to the next obstacle in metres, and its closing speed."""
    gap, closing = 1e3, 0.0
    lane = mover.lane_d_m if mover.lane_d_m is not None else mover.d_m
    for other in everyone:
        ahead = (other.s_m - mover.s_m) * mover.direction
        if other is mover or not 0.0 < ahead < 150.0:
            continue
        room = 0.5 * (other.width_m + mover.width_m) + 0.2
        if abs(other.d_m - mover.d_m) < room or abs(other.d_m - lane) < room:
            free = ahead - 0.5 * (other.length_m + mover.length_m)
            if free < gap:
                gap, closing = free, mover.speed_mps - other.velocity[0] * mover.direction
    for stop_s_m, until_s in mover.stops:
        free = (stop_s_m - mover.s_m) * mover.direction - 0.5 * mover.length_m
        if t_s < until_s and -1.0 < free < gap:
            gap, closing = free, mover.speed_mps
    return gap, closing
