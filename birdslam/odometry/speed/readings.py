"""The readings of the car's own speed: a buffer of the plausible ones, and their integral.

A reading may come late, twice, out of order, or wrong; only what is plausible by itself is kept. Whether it agrees with
the images is judged in scale.py, where the scale factor and the delay are estimated too.
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
_BUFFER_S = 3.5  # of readings: longer than any interval that is integrated
_MIN_BEFORE, _CHANGING = 10, 0.5  # readings before the repeated ones, and the share of them that changed
_FIT_S = 0.4  # over which acceleration and speed are fitted
_SIGNIFICANT_SIGMAS = 4.0  # an acceleration of less counts as none


class CarSpeedConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The errors of a car's own speed. The sigmas are by judgement of cars and tyres; no data chose them."""

    sigma_factor_rel: Positive = 0.04  # prior, of the scale factor: tyres wear and differ in size, dials read high
    factor_walk_rel_per_sqrt_m: Positive = 1e-4  # of the factor: 1 % in 10 km, as tyres get warm
    sigma_delay_s: Positive = 0.1  # prior, of the delay: filters in the sensor, and its time stamps
    max_delay_s: Positive = 0.4  # of the delay, either sign
    sigma_floor_mps: Positive = 0.03  # of a reading, whatever it states: wheels slip, counts are quantised
    sigma_yaw_rate_floor_radps: Positive = 0.003  # of a yaw rate, at the least: its bias
    sigma_acceleration_mps2: Positive = 3.0  # of the car between readings and after the last one
    max_speed_mps: Positive = 70.0  # a faster one is no car's
    max_yaw_rate_radps: Positive = 2.0  # a larger one is no car's
    acceleration_mps2: Positive = 15.0  # no car changes its speed faster
    change_mps: Positive = 1.0  # beside acceleration_mps2, between two readings
    sigmas: Positive = 4.0  # beside both, of the two readings' noise
    steady_s: Positive = 0.5  # after a jump, until readings that agree with each other are used again
    future_s: Positive = 0.2  # of a reading's time after its frame's: the two clocks, the exposure
    late_s: Positive = 0.25  # age of the newest reading: late
    missing_s: Positive = 0.6  # age of the newest reading: missing
    # The same number for this long, after numbers that changed or against the images: the sensor is stuck
    frozen_s: Positive = 1.0
    # Fusion with the metres by the road
    sigma_step_rel: Positive = 0.012  # of a distance by images over a metre, beside its scale
    sigma_step_m: Positive = 0.01  # of any distance by images
    least_way_m: Positive = 0.3  # the shortest distance that is compared
    longest_s: Positive = 1.5  # images wait this long for late readings
    # The unit of a window that has just begun drifts, having few landmarks, until the road confirms it (by KITTI raw)
    start_walk_rel_per_sqrt_m: Positive = 0.1
    sigma_start_m: Positive = 0.1  # in place of sigma_step_m
    # A distance farther from its prediction is rejected, and the readings with it
    max_innovation_sigma: Positive = 4.0
    doubt_s: Positive = 1.5  # of rejections with one ratio, no road in sight: the images' scale is wrong
    # Systematic scale error of the road, by the camera's height and the road's crown: on KITTI 00, 01, 06 and a
    # motorway clip it is 1 % in the mean of a drive
    sigma_road_rel: Positive = 0.012
    road_error_m: Positive = 100.0  # its correlation length


@dataclass(frozen=True)
class IntegratedSpeed:
    """The distance and turn by the readings, without correction for the scale factor."""

    distance_m: float  # forwards
    var_m2: float  # by the readings' noise and gaps; without factor and delay
    by_delay_mps: float  # d distance_m / d delay: the change of speed over the interval
    yaw_rad: float | None  # None: no yaw rates
    yaw_var: float


class SpeedReadings:
    """State, measurements and readers:

    - State: the plausible readings of the last seconds, by time; after a jump those not yet believed.
    - Measurements: `add_readings`, each frame's readings in any order; repeated ones are ignored.
    - Readers: `scale.SpeedScale`, for distances (`integrate`) and for what is wrong with the readings (`status`).
    """

    def __init__(self, config: CarSpeedConfig) -> None:
        self.config = config
        self.received = False  # ever
        self.jumps = 0  # how often readings after a jump were accepted
        self._used: list[tuple[int, SpeedReading]] = []  # by time
        self._pending: list[SpeedReading] = []  # after a jump, not yet believed
        self._stuck_mps: float | None = None  # the number at which the sensor is stuck
        self._status: list[Status] = []
        self._table = np.zeros((5, 0))  # of those used: s since `_origin_ns`, m/s, its variance, rad/s, its variance
        self._origin_ns = 0
        self._noise_mps = 0.0  # by their second differences

    @property
    def status(self) -> list[Status]:
        """What is wrong with the readings by themselves."""
        return list(self._status)

    @property
    def is_jumping(self) -> bool:
        """Whether several readings in a row are inconsistent with those before."""
        return len(self._pending) > 2

    @property
    def newest_ns(self) -> int | None:
        """The time of the newest usable reading; None where there is none."""
        return self._used[-1][0] if self._used else None

    def add_readings(self, readings: Iterable[SpeedReading], t_source_ns: int) -> None:
        """The readings that had come by the frame of this time."""
        cfg, implausible = self.config, False
        known = {t_ns for t_ns, _ in self._used} | {reading.t_ns for reading in self._pending}
        oldest_ns = t_source_ns - _BUFFER_S * _NS_PER_S
        fresh: dict[int, SpeedReading] = {}
        for reading in readings:
            self.received = True
            if reading.t_ns in known:
                continue
            ahead_s = (reading.t_ns - t_source_ns) / _NS_PER_S
            if ahead_s > cfg.future_s or not _plausible(cfg, reading):
                implausible = True
            elif reading.t_ns > oldest_ns:
                fresh.setdefault(reading.t_ns, reading)
        for t_ns in sorted(fresh):
            if fresh[t_ns].speed_mps != self._stuck_mps:
                self._stuck_mps = None
                self._insert(fresh[t_ns])
        if fresh and self._is_stuck():
            self._drop_stuck()
        self._used = [entry for entry in self._used if oldest_ns < entry[0] <= t_source_ns + cfg.future_s * _NS_PER_S]
        self._pending = [reading for reading in self._pending if reading.t_ns > oldest_ns]
        self._status = self._find_faults(t_source_ns, implausible or bool(self._pending)) if self.received else []
        self._tabulate(t_source_ns)

    def _find_faults(self, t_source_ns: int, implausible: bool) -> list[Status]:
        cfg, newest_ns = self.config, self.newest_ns
        age_s = math.inf if newest_ns is None else (t_source_ns - newest_ns) / _NS_PER_S
        out = [Status.CAR_SPEED_IMPLAUSIBLE] if implausible else []
        if self._stuck_mps is not None:
            out.append(Status.CAR_SPEED_FROZEN)
        if age_s > cfg.missing_s:
            return [*out, Status.CAR_SPEED_MISSING]
        return [*out, Status.CAR_SPEED_LATE] if age_s > cfg.late_s else out

    def _insert(self, reading: SpeedReading) -> None:
        """Adds a reading. One that jumps is held back; those held back replace the buffer once they agree for long."""
        cfg = self.config
        if not self._used or self._is_consistent(self._previous(reading.t_ns), reading):
            insort(self._used, (reading.t_ns, reading), key=lambda entry: entry[0])
            self._pending = []
            return
        if self._pending and not self._is_consistent(self._pending[-1], reading):
            self._pending = []
        self._pending.append(reading)
        if (reading.t_ns - self._pending[0].t_ns) / _NS_PER_S >= cfg.steady_s:
            self._used = [(waited.t_ns, waited) for waited in self._pending]
            self._pending = []
            self.jumps += 1

    def _previous(self, t_ns: int) -> SpeedReading:
        at = bisect_left(self._used, t_ns, key=lambda entry: entry[0])
        return self._used[max(at - 1, 0)][1]

    def _is_consistent(self, one: SpeedReading, other: SpeedReading) -> bool:
        """Whether a car can have had both speeds at their times."""
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

    def _is_stuck(self) -> bool:
        """Whether changing numbers have become constant; 0 is a stationary car and not a stuck sensor."""
        if not self._used or self._used[-1][1].speed_mps == 0.0 or not self.frozen():
            return False
        values = [reading.speed_mps for _, reading in self._used]
        before = values[: len(values) - self._repeats()]
        changes = sum(one != other for one, other in itertools.pairwise(before))
        return len(before) >= _MIN_BEFORE and changes >= _CHANGING * (len(before) - 1)

    def _repeats(self) -> int:
        """How many of the last readings are the same number."""
        last = self._used[-1][1].speed_mps
        return sum(1 for _ in itertools.takewhile(lambda entry: entry[1].speed_mps == last, reversed(self._used)))

    def _drop_stuck(self) -> None:
        """Drops all but the first of the stuck readings."""
        self._stuck_mps = self._used[-1][1].speed_mps
        self._used = self._used[: len(self._used) - self._repeats() + 1]

    # --- integration ---

    def _tabulate(self, origin_ns: int) -> None:
        floor, rows = self.config.sigma_floor_mps**2, []
        for t_ns, r in self._used:
            rate = math.nan if r.yaw_rate_radps is None else r.yaw_rate_radps
            at_s = (t_ns - origin_ns) / _NS_PER_S
            rows.append((at_s, r.speed_mps, r.sigma_mps**2 + floor, rate, r.yaw_rate_sigma_radps**2))
        self._origin_ns = origin_ns
        self._table = np.array(rows, dtype=np.float64).reshape(-1, 5).T
        _, v, var, _, _ = self._table
        if len(v) >= _MIN_BEFORE:  # a reading's stated noise may be too small
            curvature = v[1:-1] - 0.5 * (v[:-2] + v[2:])
            self._noise_mps = float(np.median(np.abs(curvature))) / 0.6745 / math.sqrt(1.5)
            np.maximum(var, self._noise_mps**2 + floor, out=var)

    def covers_s(self, t_ns: int, delay_s: float) -> float:
        """Time of the newest reading after `t_ns`, at a delay of the readings of `delay_s`."""
        return -math.inf if self.newest_ns is None else (self.newest_ns - t_ns) / _NS_PER_S - delay_s

    def integrate(self, from_ns: int, to_ns: int, delay_s: float) -> IntegratedSpeed | None:
        """The distance between two times, at a delay of the readings of `delay_s`; None without readings near them.

        Speeds are interpolated linearly; after the last reading the speed is held, with growing uncertainty.
        """
        cfg, (t_s, v, var, rate, rate_var) = self.config, self._table
        a, b = ((moment - self._origin_ns) / _NS_PER_S + delay_s for moment in (from_ns, to_ns))
        if not len(t_s) or a < t_s[0] - cfg.late_s or b > t_s[-1] + cfg.missing_s + cfg.max_delay_s or b <= a:
            return None
        weights, unread = _trapezoid_weights(t_s, a, b)
        # By readings before the interval alone: their noise must not correlate with the distance's
        slope, slope_sigma = _acceleration(t_s, v, var, a - _FIT_S, a)
        after_s = max(b - max(t_s[-1], a), 0.0)
        drift_s = max(
            0.5 * (b + max(t_s[-1], a)) - t_s[-1], 0.0
        )  # age of the last reading, in the mean of what it is extrapolated over
        last, last_var = _last_speed(t_s, v, var)
        read = weights.copy()
        read[-1] -= after_s
        distance_m = float(read @ v) + after_s * last
        # Unknown accelerations between readings and after the last one
        spread_m = cfg.sigma_acceleration_mps2 * after_s * drift_s
        var_m2 = float(read**2 @ var) + after_s**2 * last_var + spread_m**2
        var_m2 += float(np.sum((0.25 * cfg.sigma_acceleration_mps2 * unread**2) ** 2))
        yaw_rad, yaw_var = None, 0.0
        if np.isfinite(rate[weights > 0.0]).all():
            yaw_rad = float(weights @ np.nan_to_num(rate))
            yaw_var = float(weights**2 @ rate_var) + (cfg.sigma_yaw_rate_floor_radps * (b - a)) ** 2
            yaw_var += (0.5 * after_s * drift_s) ** 2  # rad/s^2
        certain = abs(slope) > _SIGNIFICANT_SIGMAS * slope_sigma
        by_delay_mps = slope * (b - a) if certain else 0.0
        return IntegratedSpeed(distance_m, var_m2, by_delay_mps, yaw_rad, yaw_var)


def _plausible(config: CarSpeedConfig, reading: SpeedReading) -> bool:
    rate = reading.yaw_rate_radps if reading.yaw_rate_radps is not None else 0.0
    if not math.isfinite(reading.speed_mps + reading.sigma_mps + rate + reading.yaw_rate_sigma_radps):
        return False
    if min(reading.sigma_mps, reading.yaw_rate_sigma_radps) < 0.0 or abs(rate) > config.max_yaw_rate_radps:
        return False
    return abs(reading.speed_mps) <= config.max_speed_mps


def _trapezoid_weights(t_s: Floats, a: float, b: float) -> tuple[Floats, Floats]:
    """(N,) s: weights of the speeds in the integral from a to b, linear between readings and constant outside them.

    And (N - 1,) s: the gaps between readings that overlap with it.
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


def _acceleration(t_s: Floats, v: Floats, var: Floats, a: float, b: float) -> tuple[float, float]:
    """Acceleration by the readings from a to b, and its 1-sigma."""
    near = (t_s >= a) & (t_s <= b)
    if near.sum() < 3:
        return 0.0, math.inf
    t, w = t_s[near], 1.0 / var[near]
    t = t - float(w @ t) / float(w.sum())
    spread = float(w @ t**2)
    return float((w * t) @ v[near]) / spread, 1.0 / math.sqrt(spread)


def _last_speed(t_s: Floats, v: Floats, var: Floats) -> tuple[float, float]:
    """The speed at the last reading by the line through those of the last _FIT_S, and its variance."""
    near = t_s >= t_s[-1] - _FIT_S
    if near.sum() < 4:
        return float(v[-1]), float(var[-1])
    w = 1.0 / var[near]
    A = np.column_stack([np.ones(len(w)), t_s[near] - t_s[-1]])
    cov = np.linalg.inv(A.T @ (A * w[:, None]))
    return float((cov @ (A.T @ (w * v[near])))[0]), float(cov[0, 0])
