"""Buffer and integral of the readings of the car's own speed.

Readings may be late, repeated, out of order or implausible; only plausible ones are kept. scale.py compares them with
the images and estimates their scale factor and delay.
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
_BUFFER_S = 3.5  # length of the buffer, longer than any integrated interval
_MIN_BEFORE_COUNT, _MIN_CHANGING_RATIO = (
    10,
    0.5,
)  # readings before the repeated ones; fraction that changed
_FIT_S = 0.4  # window of the fit of acceleration and speed
_SIGNIFICANT_SIGMAS = 4.0  # minimum significance of an acceleration


class CarSpeedConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Error model of a car's own speed. The sigmas are typical of cars and tyres, not tuned on data."""

    sigma_factor_rel: Positive = 0.04  # prior, of the scale factor: tyre size, wear, dials that read high
    factor_walk_rel_per_sqrt_m: Positive = 1e-4  # of the factor: 1 % in 10 km, as tyres warm up
    sigma_delay_s: Positive = 0.1  # prior, of the delay: filters and time stamps of the sensor
    max_delay_s: Positive = 0.4  # of the delay, with either sign
    sigma_floor_mps: Positive = 0.03  # minimum of a reading: wheel slip, quantization
    sigma_yaw_rate_floor_radps: Positive = 0.003  # minimum of a yaw rate: its bias
    sigma_acceleration_mps2: Positive = 3.0  # of the car, between readings and after the last one
    max_speed_mps: Positive = 70.0  # maximum plausible speed
    max_yaw_rate_radps: Positive = 2.0  # maximum plausible yaw rate
    acceleration_mps2: Positive = 15.0  # maximum plausible change of the speed
    change_mps: Positive = 1.0  # added to acceleration_mps2 between two readings
    sigmas: Positive = 4.0  # of the two readings' noise, added to both
    steady_s: Positive = 0.5  # after a jump, until consistent readings are used again
    future_s: Positive = 0.2  # maximum time of a reading after its frame: clocks, exposure
    late_s: Positive = 0.25  # age of the newest reading: late
    missing_s: Positive = 0.6  # age of the newest reading: missing
    frozen_s: Positive = 1.0  # of constant readings after changing ones, or against the images: stuck sensor
    # Fusion with the scale from the road
    sigma_step_rel: Positive = 0.012  # of a distance by images over a metre, without its scale
    sigma_step_m: Positive = 0.01  # of any distance by images
    least_way_m: Positive = 0.3  # minimum distance of a comparison
    longest_s: Positive = 1.5  # maximum waiting time for late readings
    # A new window has few landmarks, so its scale drifts until the road confirms it
    start_walk_rel_per_sqrt_m: Positive = 0.1
    sigma_start_m: Positive = 0.1  # in place of sigma_step_m
    max_innovation_sigma: Positive = 4.0  # outlier gate of a distance
    doubt_s: Positive = 1.5  # of rejections with a constant ratio and no road: the images' scale is wrong
    sigma_road_rel: Positive = 0.012  # systematic scale error of the road: camera height, crown of the road
    road_error_m: Positive = 100.0  # its correlation length


@dataclass(frozen=True)
class IntegratedSpeed:
    """Distance and turn from the readings, without correction for the scale factor."""

    distance_m: float  # forwards
    var_m2: float  # from noise and gaps of the readings; without factor and delay
    by_delay_mps: float  # d distance_m / d delay: the change of speed over the interval
    yaw_rad: float | None  # None without yaw rates
    yaw_var: float


class SpeedReadings:
    """State, measurements and readers:

    - State: the plausible readings of the last seconds, by time; after a jump, those not yet accepted.
    - Measurements: `add_readings`, each frame's readings in any order; repeated ones are ignored.
    - Readers: `scale.SpeedScale`, for distances (`integrate`) and for faults of the readings (`status`).
    """

    def __init__(self, config: CarSpeedConfig) -> None:
        self.config = config
        self.has_received = False  # at least one reading
        self.jump_count = 0  # of jumps after which readings were accepted
        self._used: list[tuple[int, SpeedReading]] = []  # by time
        self._pending: list[SpeedReading] = []  # after a jump, not yet accepted
        self._stuck_mps: float | None = None  # value of a stuck sensor
        self._status: list[Status] = []
        self._table = np.zeros((5, 0))  # time since `_origin_ns` (s), speed, its variance, yaw rate, its variance
        self._origin_ns = 0
        self._noise_mps = 0.0  # 1-sigma from second differences

    @property
    def status(self) -> list[Status]:
        """Faults of the readings by themselves."""
        return list(self._status)

    @property
    def is_jumping(self) -> bool:
        """Whether several readings in a row are inconsistent with those before."""
        return len(self._pending) > 2

    @property
    def newest_ns(self) -> int | None:
        """Time of the newest usable reading; None if there is none."""
        return self._used[-1][0] if self._used else None

    def add_readings(self, readings: Iterable[SpeedReading], t_source_ns: int) -> None:
        """Adds the readings that arrived by the frame of this time."""
        cfg, implausible = self.config, False
        known = {t_ns for t_ns, _ in self._used} | {reading.t_ns for reading in self._pending}
        oldest_ns = t_source_ns - _BUFFER_S * _NS_PER_S
        fresh: dict[int, SpeedReading] = {}
        for reading in readings:
            self.has_received = True
            if reading.t_ns in known:
                continue
            ahead_s = (reading.t_ns - t_source_ns) / _NS_PER_S
            if ahead_s > cfg.future_s or not _is_plausible(cfg, reading):
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
        self._status = self._find_faults(t_source_ns, implausible or bool(self._pending)) if self.has_received else []
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
        """Adds a reading. Readings after a jump are pending and replace the buffer once they agree for steady_s."""
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
            self.jump_count += 1

    def _previous(self, t_ns: int) -> SpeedReading:
        at = bisect_left(self._used, t_ns, key=lambda entry: entry[0])
        return self._used[max(at - 1, 0)][1]

    def _is_consistent(self, one: SpeedReading, other: SpeedReading) -> bool:
        """Whether the change of speed between two readings is plausible for a car."""
        cfg, passed_s = self.config, abs(other.t_ns - one.t_ns) / _NS_PER_S
        noise = cfg.sigmas * max(math.hypot(one.sigma_mps, other.sigma_mps), math.sqrt(2.0) * self._noise_mps)
        return abs(other.speed_mps - one.speed_mps) <= cfg.change_mps + cfg.acceleration_mps2 * passed_s + noise

    def is_frozen(self) -> bool:
        """Whether the readings have been constant for frozen_s."""
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
        """Whether changing readings became constant; 0 is a stationary car, not a stuck sensor."""
        if not self._used or self._used[-1][1].speed_mps == 0.0 or not self.is_frozen():
            return False
        values = [reading.speed_mps for _, reading in self._used]
        before = values[: len(values) - self._repeat_count()]
        changes = sum(one != other for one, other in itertools.pairwise(before))
        return len(before) >= _MIN_BEFORE_COUNT and changes >= _MIN_CHANGING_RATIO * (len(before) - 1)

    def _repeat_count(self) -> int:
        """Number of last readings with the same value."""
        last = self._used[-1][1].speed_mps
        return sum(1 for _ in itertools.takewhile(lambda entry: entry[1].speed_mps == last, reversed(self._used)))

    def _drop_stuck(self) -> None:
        """Drops all but the first of the stuck readings."""
        self._stuck_mps = self._used[-1][1].speed_mps
        self._used = self._used[: len(self._used) - self._repeat_count() + 1]

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
        if len(v) >= _MIN_BEFORE_COUNT:  # the stated noise of a reading may be too small
            curvature = v[1:-1] - 0.5 * (v[:-2] + v[2:])
            self._noise_mps = float(np.median(np.abs(curvature))) / 0.6745 / math.sqrt(1.5)
            np.maximum(var, self._noise_mps**2 + floor, out=var)

    def covers_s(self, t_ns: int, delay_s: float) -> float:
        """Time (s) of the newest reading after `t_ns`, for a delay of the readings of `delay_s`."""
        return -math.inf if self.newest_ns is None else (self.newest_ns - t_ns) / _NS_PER_S - delay_s

    def integrate(self, from_ns: int, to_ns: int, delay_s: float) -> IntegratedSpeed | None:
        """Integrates the speed between two times, for a delay of `delay_s`; None without readings near them.

        Speeds are interpolated linearly; after the last reading the speed is constant, with growing uncertainty.
        """
        cfg, (t_s, v, var, rate, rate_var) = self.config, self._table
        a, b = ((moment - self._origin_ns) / _NS_PER_S + delay_s for moment in (from_ns, to_ns))
        if not len(t_s) or a < t_s[0] - cfg.late_s or b > t_s[-1] + cfg.missing_s + cfg.max_delay_s or b <= a:
            return None
        weights, unread = _trapezoid_weights(t_s, a, b)
        # From readings before the interval, so that their noise is not correlated with that of the distance
        slope, slope_sigma = _acceleration(t_s, v, var, a - _FIT_S, a)
        after_s = max(b - max(t_s[-1], a), 0.0)
        drift_s = max(0.5 * (b + max(t_s[-1], a)) - t_s[-1], 0.0)  # mean age of the last reading over the extrapolation
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


def _is_plausible(config: CarSpeedConfig, reading: SpeedReading) -> bool:
    rate = reading.yaw_rate_radps if reading.yaw_rate_radps is not None else 0.0
    if not math.isfinite(reading.speed_mps + reading.sigma_mps + rate + reading.yaw_rate_sigma_radps):
        return False
    if min(reading.sigma_mps, reading.yaw_rate_sigma_radps) < 0.0 or abs(rate) > config.max_yaw_rate_radps:
        return False
    return abs(reading.speed_mps) <= config.max_speed_mps


def _trapezoid_weights(t_s: Floats, a: float, b: float) -> tuple[Floats, Floats]:
    """Weights (N,) (s) of the speeds in the integral from a to b, and gaps (N - 1,) (s) that overlap with it.

    The speed is linear between readings and constant outside them.
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
    """Acceleration from the readings from a to b, and its 1-sigma."""
    near = (t_s >= a) & (t_s <= b)
    if near.sum() < 3:
        return 0.0, math.inf
    t, w = t_s[near], 1.0 / var[near]
    t = t - float(w @ t) / float(w.sum())
    spread = float(w @ t**2)
    return float((w * t) @ v[near]) / spread, 1.0 / math.sqrt(spread)


def _last_speed(t_s: Floats, v: Floats, var: Floats) -> tuple[float, float]:
    """Speed at the last reading from a linear fit over the last _FIT_S, and its variance."""
    near = t_s >= t_s[-1] - _FIT_S
    if near.sum() < 4:
        return float(v[-1]), float(var[-1])
    w = 1.0 / var[near]
    A = np.column_stack([np.ones(len(w)), t_s[near] - t_s[-1]])
    cov = np.linalg.inv(A.T @ (A * w[:, None]))
    return float((cov @ (A.T @ (w * v[near])))[0]), float(cov[0, 0])
