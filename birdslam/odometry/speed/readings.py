"""The car's own speed: which of its readings can be used, and how far they say that the car has come.

A reading may come late, twice, out of order, or wrong; only what is plausible by itself is kept here. Whether it fits
what the images show is judged in `speed/scale.py`, where the scale factor and the delay are estimated too.
"""

from __future__ import annotations

import itertools
import math
from bisect import bisect_left, insort
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.types import SpeedReading, Status

Floats = NDArray[np.float64]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]

_NS_PER_S = 1e9
_KEPT_S = 3.5  # of readings: longer than any way that is asked for
_FEWEST_BEFORE, _CHANGING = 10, 0.5  # readings before those that are alike, and the share of them that differed
_FIT_S = 0.4  # before a moment, for the acceleration and the speed there
_CERTAIN_SIGMAS = 4.0  # an acceleration that stands out of the readings' noise by less counts as none


class CarSpeedConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a car's own speed is known to. The sigmas were chosen by judgement of cars and tyres; no data chose them."""

    sigma_factor_rel: Positive = (
        0.04  # of the scale factor, beforehand: tyres wear and differ in size, speedometers read high
    )
    factor_walk_rel_per_sqrt_m: Positive = 1e-4  # by which the factor changes: 1 % in 10 km, as tyres get warm
    sigma_delay_s: Positive = 0.1  # of the delay, beforehand: filters in the sensor, and its time stamps
    max_delay_s: Positive = 0.4  # it is not estimated beyond this, on either side
    sigma_floor_mps: Positive = 0.03  # no reading is better, whatever it says of itself: wheels slip, counts end
    sigma_yaw_rate_floor_radps: Positive = 0.003  # nor does one know the turn better: this much of it lasts
    sigma_acceleration_mps2: Positive = 3.0  # of what the car does between readings and after the last one
    max_speed_mps: Positive = 70.0  # a faster one is no car's
    max_yaw_rate_radps: Positive = 2.0  # nor does a car turn faster
    acceleration_mps2: Positive = 15.0  # no car changes its speed faster
    change_mps: Positive = 1.0  # beside it, between two readings
    sigmas: Positive = 4.0  # beside both: of the two readings' own noise
    steady_s: Positive = 0.5  # after a jump, readings are used again when they agree with each other for so long
    future_s: Positive = 0.2  # a reading may be ahead of its frame by so much: the two clocks, the exposure
    late_s: Positive = 0.25  # the newest reading is older than this: late
    missing_s: Positive = 0.6  # ... older than this: missing
    # The same number for so long, after numbers that changed or against what the images show: the sensor hangs
    frozen_s: Positive = 1.0
    # Joined with the metres by the road
    sigma_step_rel: Positive = 0.012  # of a way by images over a metre, beside its scale (as motion.sigma_path_rel)
    sigma_step_m: Positive = 0.01  # and of any way by images
    least_way_m: Positive = 0.3  # that is compared with the readings; shorter says too little
    longest_s: Positive = 1.5  # images wait so long for readings that come late
    # A window that has just begun has few landmarks to hand its unit on by, until the road confirms it (by KITTI raw)
    start_walk_rel_per_sqrt_m: Positive = 0.1
    sigma_start_m: Positive = 0.1  # in place of sigma_step_m
    # A way that is farther from what was expected is refused, and the readings with it
    max_innovation_sigma: Positive = 4.0
    doubt_s: Positive = 1.5  # refused for so long with one ratio, no road in sight: the images' metres are in doubt
    # Errors of the road's metres that last, by the camera's height and the road's crown: on KITTI 00, 01, 06 and a
    # motorway clip they are 1 % in the mean of a drive
    sigma_road_rel: Positive = 0.012
    road_error_m: Positive = 100.0  # the way over which they last


@dataclass(frozen=True)
class CarWay:
    """How far the car has come by its readings, their scale factor not yet taken out."""

    way_m: float  # forwards
    var_m2: float  # by the readings' noise and by what they do not cover; without factor and delay
    by_delay_mps: float  # d way_m / d delay: how much faster the car is at the end than at the beginning
    yaw_rad: float | None  # None: no yaw rates
    yaw_var: float


class CarSpeed:
    """State, measurements and readers:

    - State: the readings of the last seconds that are plausible, by time; after a jump those that wait to be believed.
    - Measurements: `hear`, each frame's readings in any order; the same one may come again and again.
    - Readers: `car_scale.CarScale`, for ways (`way`) and for what is wrong with the readings (`status`).
    """

    def __init__(self, config: CarSpeedConfig) -> None:
        self.config = config
        self.heard = False  # ever
        self.jumps = 0  # how often the readings began anew after a jump
        self._used: list[tuple[int, SpeedReading]] = []  # by time
        self._waiting: list[SpeedReading] = []  # after a jump
        self._hung_mps: float | None = None  # the number at which the sensor hangs
        self._status: list[Status] = []
        self._table = np.zeros((5, 0))  # of those used: s since `_origin_ns`, m/s, its variance, rad/s, its variance
        self._origin_ns = 0
        self._noise_mps = 0.0  # by how they differ from each other

    @property
    def status(self) -> list[Status]:
        """What is wrong with the readings by themselves."""
        return list(self._status)

    @property
    def jumping(self) -> bool:
        """Whether several readings in a row are none that could follow those before."""
        return len(self._waiting) > 2

    @property
    def newest_ns(self) -> int | None:
        """When the newest usable reading held; None where there is none."""
        return self._used[-1][0] if self._used else None

    def hear(self, readings: Iterable[SpeedReading], t_source_ns: int) -> None:
        """The readings that had come by the frame of this time."""
        cfg, implausible = self.config, False
        known = {t_ns for t_ns, _ in self._used} | {reading.t_ns for reading in self._waiting}
        oldest_ns = t_source_ns - _KEPT_S * _NS_PER_S
        fresh: dict[int, SpeedReading] = {}
        for reading in readings:
            self.heard = True
            if reading.t_ns in known:
                continue
            ahead_s = (reading.t_ns - t_source_ns) / _NS_PER_S
            if ahead_s > cfg.future_s or not _possible(cfg, reading):
                implausible = True
            elif reading.t_ns > oldest_ns:
                fresh.setdefault(reading.t_ns, reading)
        for t_ns in sorted(fresh):
            if fresh[t_ns].speed_mps != self._hung_mps:
                self._hung_mps = None
                self._judge(fresh[t_ns])
        if fresh and self._hangs():
            self._hang()
        self._used = [entry for entry in self._used if oldest_ns < entry[0] <= t_source_ns + cfg.future_s * _NS_PER_S]
        self._waiting = [reading for reading in self._waiting if reading.t_ns > oldest_ns]
        self._status = self._judged(t_source_ns, implausible or bool(self._waiting)) if self.heard else []
        self._tabulate(t_source_ns)

    def _judged(self, t_source_ns: int, implausible: bool) -> list[Status]:
        cfg, newest_ns = self.config, self.newest_ns
        age_s = math.inf if newest_ns is None else (t_source_ns - newest_ns) / _NS_PER_S
        out = [Status.CAR_SPEED_IMPLAUSIBLE] if implausible else []
        if self._hung_mps is not None:
            out.append(Status.CAR_SPEED_FROZEN)
        if age_s > cfg.missing_s:
            return [*out, Status.CAR_SPEED_MISSING]
        return [*out, Status.CAR_SPEED_LATE] if age_s > cfg.late_s else out

    def _judge(self, reading: SpeedReading) -> None:
        """Takes it, or lets it wait where it jumps away from those before; such that agree for long begin anew."""
        cfg = self.config
        if not self._used or self._follows(self._neighbour(reading.t_ns), reading):
            insort(self._used, (reading.t_ns, reading), key=lambda entry: entry[0])
            self._waiting = []
            return
        if self._waiting and not self._follows(self._waiting[-1], reading):
            self._waiting = []
        self._waiting.append(reading)
        if (reading.t_ns - self._waiting[0].t_ns) / _NS_PER_S >= cfg.steady_s:
            self._used = [(waited.t_ns, waited) for waited in self._waiting]
            self._waiting = []
            self.jumps += 1

    def _neighbour(self, t_ns: int) -> SpeedReading:
        at = bisect_left(self._used, t_ns, key=lambda entry: entry[0])
        return self._used[max(at - 1, 0)][1]

    def _follows(self, one: SpeedReading, other: SpeedReading) -> bool:
        """Whether a car can have had both speeds, each at its time."""
        cfg, passed_s = self.config, abs(other.t_ns - one.t_ns) / _NS_PER_S
        noise = cfg.sigmas * max(math.hypot(one.sigma_mps, other.sigma_mps), math.sqrt(2.0) * self._noise_mps)
        return abs(other.speed_mps - one.speed_mps) <= cfg.change_mps + cfg.acceleration_mps2 * passed_s + noise

    def frozen(self) -> bool:
        """Whether the last readings are the same number for longer than frozen_s."""
        newest = self._used[-1] if self._used else None
        if newest is None:
            return False
        for t_ns, reading in reversed(self._used):
            if reading.speed_mps != newest[1].speed_mps:
                return False
            if (newest[0] - t_ns) / _NS_PER_S >= self.config.frozen_s:
                return True
        return False

    def _hangs(self) -> bool:
        """Whether numbers that changed have become one and the same; a car that stands says 0 and does not hang."""
        if not self._used or self._used[-1][1].speed_mps == 0.0 or not self.frozen():
            return False
        values = [reading.speed_mps for _, reading in self._used]
        before = values[: len(values) - self._alike()]
        changes = sum(one != other for one, other in itertools.pairwise(before))
        return len(before) >= _FEWEST_BEFORE and changes >= _CHANGING * (len(before) - 1)

    def _alike(self) -> int:
        """How many of the last readings are the same number."""
        last = self._used[-1][1].speed_mps
        return sum(1 for _ in itertools.takewhile(lambda entry: entry[1].speed_mps == last, reversed(self._used)))

    def _hang(self) -> None:
        """Of a number that hangs the first reading alone is one."""
        self._hung_mps = self._used[-1][1].speed_mps
        self._used = self._used[: len(self._used) - self._alike() + 1]

    # --- ways ---

    def _tabulate(self, origin_ns: int) -> None:
        floor, rows = self.config.sigma_floor_mps**2, []
        for t_ns, r in self._used:
            rate = math.nan if r.yaw_rate_radps is None else r.yaw_rate_radps
            at_s = (t_ns - origin_ns) / _NS_PER_S
            rows.append((at_s, r.speed_mps, r.sigma_mps**2 + floor, rate, r.yaw_rate_sigma_radps**2))
        self._origin_ns = origin_ns
        self._table = np.array(rows, dtype=np.float64).reshape(-1, 5).T
        _, v, var, _, _ = self._table
        if len(v) >= _FEWEST_BEFORE:  # what a reading says of itself may be too good
            uneven = v[1:-1] - 0.5 * (v[:-2] + v[2:])
            self._noise_mps = float(np.median(np.abs(uneven))) / 0.6745 / math.sqrt(1.5)
            np.maximum(var, self._noise_mps**2 + floor, out=var)

    def covers_s(self, t_ns: int, delay_s: float) -> float:
        """By how much the newest reading is past a moment, of which they tell `delay_s` later."""
        return -math.inf if self.newest_ns is None else (self.newest_ns - t_ns) / _NS_PER_S - delay_s

    def way(self, from_ns: int, to_ns: int, delay_s: float) -> CarWay | None:
        """The way between two moments, of which readings tell `delay_s` later; None where there is none near them.

        Straight lines join the readings; past the last one the speed goes on, its uncertainty growing.
        """
        cfg, (t_s, v, var, rate, rate_var) = self.config, self._table
        a, b = ((moment - self._origin_ns) / _NS_PER_S + delay_s for moment in (from_ns, to_ns))
        if not len(t_s) or a < t_s[0] - cfg.late_s or b > t_s[-1] + cfg.missing_s + cfg.max_delay_s or b <= a:
            return None
        weights, unread = _weights(t_s, a, b)
        # By readings before the way alone: the noise of its own would teach a delay where there is none
        slope, slope_sigma = _slope(t_s, v, var, a - _FIT_S, a)
        after_s = max(b - max(t_s[-1], a), 0.0)
        drift_s = max(0.5 * (b + max(t_s[-1], a)) - t_s[-1], 0.0)  # of the middle of what no reading covers
        last, last_var = _latest(t_s, v, var)
        read = weights.copy()
        read[-1] -= after_s
        way_m = float(read @ v) + after_s * last
        # Between readings an acceleration may have been another, after the last one it goes on unseen
        spread_m = cfg.sigma_acceleration_mps2 * after_s * drift_s
        var_m2 = float(read**2 @ var) + after_s**2 * last_var + spread_m**2
        var_m2 += float(np.sum((0.25 * cfg.sigma_acceleration_mps2 * unread**2) ** 2))
        yaw_rad, yaw_var = None, 0.0
        if np.isfinite(rate[weights > 0.0]).all():
            yaw_rad = float(weights @ np.nan_to_num(rate))
            yaw_var = float(weights**2 @ rate_var) + (cfg.sigma_yaw_rate_floor_radps * (b - a)) ** 2
            yaw_var += (0.5 * after_s * drift_s) ** 2  # rad/s^2
        certain = abs(slope) > _CERTAIN_SIGMAS * slope_sigma
        by_delay_mps = slope * (b - a) if certain else 0.0
        return CarWay(way_m, var_m2, by_delay_mps, yaw_rad, yaw_var)


def _possible(config: CarSpeedConfig, reading: SpeedReading) -> bool:
    rate = reading.yaw_rate_radps if reading.yaw_rate_radps is not None else 0.0
    if not math.isfinite(reading.speed_mps + reading.sigma_mps + rate + reading.yaw_rate_sigma_radps):
        return False
    if min(reading.sigma_mps, reading.yaw_rate_sigma_radps) < 0.0 or abs(rate) > config.max_yaw_rate_radps:
        return False
    return abs(reading.speed_mps) <= config.max_speed_mps


def _weights(t_s: Floats, a: float, b: float) -> tuple[Floats, Floats]:
    """(N,) s: the integral from a to b is their sum of speeds, which are joined by lines and level before and after.

    And (N - 1,) s: the parts of the gaps between readings that lie within.
    """
    weights = np.zeros(len(t_s))
    low, high = np.clip(t_s[:-1], a, b), np.clip(t_s[1:], a, b)
    within, gap = high - low, np.diff(t_s)
    share = (0.5 * (low + high) - t_s[:-1]) / gap
    weights[:-1] += within * (1.0 - share)
    weights[1:] += within * share
    weights[0] += max(min(t_s[0], b) - a, 0.0)
    weights[-1] += max(b - max(t_s[-1], a), 0.0)
    return weights, np.where(within > 0.0, gap, 0.0)


def _slope(t_s: Floats, v: Floats, var: Floats, a: float, b: float) -> tuple[float, float]:
    """Acceleration by the readings from a to b, and its 1-sigma."""
    near = (t_s >= a) & (t_s <= b)
    if near.sum() < 3:
        return 0.0, math.inf
    t, w = t_s[near], 1.0 / var[near]
    t = t - float(w @ t) / float(w.sum())
    spread = float(w @ t**2)
    return float((w * t) @ v[near]) / spread, 1.0 / math.sqrt(spread)


def _latest(t_s: Floats, v: Floats, var: Floats) -> tuple[float, float]:
    """The speed at the last reading by the line through those of the last _FIT_S, and its variance."""
    near = t_s >= t_s[-1] - _FIT_S
    if near.sum() < 4:
        return float(v[-1]), float(var[-1])
    w = 1.0 / var[near]
    A = np.column_stack([np.ones(len(w)), t_s[near] - t_s[-1]])
    cov = np.linalg.inv(A.T @ (A * w[:, None]))
    return float((cov @ (A.T @ (w * v[near])))[0]), float(cov[0, 0])
