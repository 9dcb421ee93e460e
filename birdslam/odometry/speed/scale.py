"""The car's own speed as a measurement of the metric scale, with the scale factor and the delay of its readings:

    v_read(t) = k v(t - delay),    distance by readings / distance by images = k lambda

lambda, log k and the delay are states of the road's filter: the road calibrates k, and without it the readings carry
the scale. After an outlier the readings are not used until a distance agrees again.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from birdslam.odometry.road.kalman_filter import CAR_DELAY, CAR_FACTOR, RoadFilter
from birdslam.odometry.scale_config import RoadScaleConfig
from birdslam.odometry.speed.readings import CarSpeedConfig, SpeedReadings
from birdslam.types import NS_PER_S, SpeedReading, Status

MIN_MOVING_M = 0.05  # between two images, below which the car may be stationary
_MAX_RATIO_STD_LOG = 0.04  # of rejected ratios; below it the scale is wrong, not the readings
_MOVING_SIGMAS = 4.0
_RECENT_S = 2.0
_CLOCK_TOLERANCE_S = 0.02  # maximum age of the newest reading at its image
_NIS_GAIN, _MAX_NIS = 0.1, 9.0  # of the running mean of the normalised innovation squared
_MIN_AGREEMENTS = 10  # accepted distances, before the readings may overrule the road
_MIN_CONTRADICTIONS = 3  # consecutive ones by the road, which overrule the readings
_MAX_CONTRADICTION_SPREAD_LOG = 0.15  # of those log ratios
_MIN_REJECTED = 4  # distances with a standard deviation


@dataclass(frozen=True)
class CarMotion:
    """The car's motion by its own speed, corrected for the scale factor."""

    forward_m: float
    sigma_m: float  # from readings and delay
    sigma_rel: float  # of the scale factor
    yaw_rad: float | None  # counter-clockwise; None without a yaw rate
    yaw_sigma_rad: float
    has_agreed: bool = False  # a distance agreed with the images recently
    is_proven: bool = False  # at least _MIN_AGREEMENTS distances agreed with images and road

    def is_moving(self, least_m: float) -> bool:
        """Whether the car has moved significantly."""
        return abs(self.forward_m) > least_m + _MOVING_SIGMAS * self.sigma_m


@dataclass
class _PathSample:
    t_ns: int
    distance: float  # forwards by images, in the scale of the window, from an arbitrary start


class SpeedScale:
    """State, measurements and readers:

    - State: the distance by images since the last comparison, for each image; whether the readings are trusted.
    - Measurements: `add_readings`, the car's readings; `update`, each motion by images.
    - Readers: `road.scale.RoadScale` for the factor on all lengths, its statuses and sources; `Odometry` through it for
      `motion_factor`, and for `motion` if images show none.
    """

    def __init__(self, config: RoadScaleConfig, filter_: RoadFilter) -> None:
        self._road, self._filter = config, filter_
        self._speed = SpeedReadings(config.car)
        self._path: list[_PathSample] = []
        self._is_road_confirmed = False  # the road confirmed the scale
        self._is_settled = False  # the window is old enough for a slow scale drift
        self._rejected: list[tuple[int, float]] = []  # (time, log ratio) since the last accepted distance
        self._agreed_ns: int | None = None  # end of the last accepted distance
        self._mean_nis = 1.0  # running mean of the normalised innovation squared
        self._contradictions: list[float] = []  # log ratios of the scale from the road to that from the readings
        self._rejected_m = 0.0  # travelled since the first rejection
        self._agreements = 0  # accepted distances with the road in view, since the last jump
        self._is_overruled = False  # the road contradicted the readings
        self._window_m = 0.0  # travelled since the start of the window
        self._jumps = 0
        self.since_m = math.inf  # travelled since the last accepted distance
        self.motion_factor = 1.0  # on the newest motion only, beside that on all lengths

    @property
    def config(self) -> CarSpeedConfig:
        return self._road.car

    @property
    def is_trusted(self) -> bool:
        """Whether the last distance agreed with the images; true before the first comparison."""
        return not self._rejected and not self._is_overruled

    @property
    def is_measuring(self) -> bool:
        """Whether the scale currently comes from the readings."""
        return self.is_trusted and self.since_m < self._road.carried_after_m

    @property
    def scale_factor(self) -> float | None:
        """Factor on all lengths from the last distance; None if too few distances agreed."""
        if self._agreements < _MIN_AGREEMENTS or self._speed.status:
            return None
        if not self._rejected:
            return 1.0
        return math.exp(self._rejected[-1][1] - float(self._filter.x[CAR_FACTOR]))

    def add_readings(self, readings: Iterable[SpeedReading], t_source_ns: int) -> None:
        """Adds the readings of a frame."""
        self._speed.add_readings(readings, t_source_ns)
        if self._speed.has_received and not self._filter.has_car_states:
            self._filter.add_car_states()
        if self._speed.jump_count != self._jumps:
            self._jumps = self._speed.jump_count
            self._path = self._path[-1:]
        if self._speed.is_jumping:
            self._agreements = 0

    def restart(self) -> None:
        """Restarts with a new window, which has a new scale."""
        self._path = []
        self.since_m = math.inf
        self._window_m = 0.0

    def add_contradiction(self, log_ratio: float) -> None:
        """Adds an accepted alignment that contradicts the scale; repeated ones overrule the readings."""
        if not self.is_measuring:
            return
        self._contradictions = [*self._contradictions[1 - _MIN_CONTRADICTIONS :], log_ratio]
        if (
            len(self._contradictions) == _MIN_CONTRADICTIONS
            and np.ptp(self._contradictions) < _MAX_CONTRADICTION_SPREAD_LOG
        ):
            self._is_overruled, self._contradictions, self.since_m, self._agreements = True, [], math.inf, 0

    def rescale(self, factor: float) -> None:
        """Multiplies all lengths."""
        for sample in self._path:
            sample.distance *= factor

    def update(self, from_ns: int, to_ns: int, forward: float, travelled: float, confirmed: bool) -> float:
        """Returns the factor on all lengths, after a motion by images.

        `forward` is its length along the car, `travelled` in total. `confirmed`: the road confirms the scale.
        """
        self.since_m += travelled
        self._window_m += travelled
        self._rejected_m += travelled
        self.motion_factor = 1.0
        if not self._speed.has_received:
            return 1.0
        self._is_road_confirmed = confirmed
        self._is_settled = confirmed or self._window_m > self._road.carried_after_m
        if not self._is_settled:
            walk = self.config.start_walk_rel_per_sqrt_m**2 * travelled
            self._filter.cov[0, 0] = min(self._filter.cov[0, 0] + walk, 1.0)
        if not self._path or self._path[-1].t_ns > from_ns:
            self._path = [_PathSample(from_ns, 0.0)]
        elif self._path[-1].t_ns < from_ns:
            self._path.append(_PathSample(from_ns, self._path[-1].distance))  # the car was stationary
        self._path.append(_PathSample(to_ns, self._path[-1].distance + forward))
        factor = self._compare()
        self._path = [sample for sample in self._path if to_ns - sample.t_ns <= self.config.longest_s * NS_PER_S]
        return factor

    def _compare(self) -> float:
        """Compares the distances by images and readings; returns 1 if the distance is too short or rejected."""
        cfg, filter_ = self.config, self._filter
        delay_s = float(filter_.x[CAR_DELAY])
        # Wait for readings; if the scale is unknown, extrapolate the last one
        is_known = filter_.cov[0, 0] < self._road.doubt_sigma_rel**2
        min_covered_s = -_CLOCK_TOLERANCE_S if is_known else -cfg.late_s
        first = self._path[0]
        covered = [s for s in self._path[1:] if self._speed.covers_s(s.t_ns, delay_s) >= min_covered_s]
        if not covered or abs(covered[-1].distance - first.distance) < cfg.least_way_m:
            return 1.0
        last, visual = covered[-1], covered[-1].distance - first.distance
        lag = self._path[-1].distance - last.distance
        self._path = [sample for sample in self._path if sample.t_ns >= last.t_ns]
        integral = self._speed.integrate(first.t_ns, last.t_ns, delay_s)
        if integral is None:
            return 1.0
        ratio = integral.distance_m / visual
        own = cfg.sigma_step_rel**2 / max(abs(visual), 1.0) + (cfg.sigma_step_m / visual) ** 2  # variance of the images
        var = integral.var_m2 / max(visual**2, integral.distance_m**2) + own
        walk = self._road.scale_walk_rel_per_sqrt_m if self._is_settled else cfg.start_walk_rel_per_sqrt_m
        var += walk**2 * abs(lag)
        if ratio <= 0.05:
            return self._reject(last.t_ns, math.log(0.05))
        log_ratio, by_delay = math.log(ratio), integral.by_delay_mps / integral.distance_m
        # At night, distances by images are noisier, which the mean innovation shows
        _, _, sigmas = filter_.car_innovation(log_ratio, by_delay, var * self._mean_nis)
        nis = self._mean_nis * min(sigmas, cfg.max_innovation_sigma) ** 2
        self._mean_nis += _NIS_GAIN * (nis - self._mean_nis)
        self._mean_nis = min(max(self._mean_nis, 1.0), _MAX_NIS)
        if self._is_overruled:  # accept only a distance that a plausible scale factor explains
            sigmas = max(sigmas, abs(log_ratio) / math.sqrt(2.0 * cfg.sigma_factor_rel**2 + var))
        if sigmas > cfg.max_innovation_sigma:
            return self._reject(last.t_ns, log_ratio)
        self._rejected, self._agreed_ns, self.since_m, self._is_overruled = [], last.t_ns, 0.0, False
        if self._is_road_confirmed and filter_.carried_m < self._road.carried_after_m:
            self._agreements += 1
        if not self._is_settled:
            start = (cfg.sigma_start_m / visual) ** 2
            own, var = own + start, var + start
        if lag == 0.0:
            H, innovation, sigmas = filter_.car_innovation(log_ratio, by_delay, var)
            if sigmas < cfg.max_innovation_sigma:  # otherwise the wheels may slip
                self.motion_factor = math.exp(own / (float((H @ filter_.cov @ H.T)[0, 0]) + var) * innovation)
        return filter_.update_car_speed(log_ratio, by_delay, var)

    def _reject(self, t_ns: int, log_ratio: float) -> float:
        """Adds a rejected distance, and decides whether the readings or the scale are wrong."""
        cfg = self.config
        if not self._rejected:
            self._rejected_m = 0.0
        self._rejected = [*self._rejected[-200:], (t_ns, log_ratio)]
        recent = [ratio for then_ns, ratio in self._rejected if t_ns - then_ns <= cfg.doubt_s * NS_PER_S]
        is_persistent = (t_ns - self._rejected[0][0]) / NS_PER_S >= cfg.doubt_s and len(recent) >= _MIN_REJECTED
        is_road_hidden = self._filter.carried_m > self._road.carried_after_m and not self._is_overruled
        is_constant = is_persistent and is_road_hidden and float(np.std(recent)) < _MAX_RATIO_STD_LOG
        # Prefer proven readings to images without the road, whose scale diverges at night
        is_road_lost = self._filter.carried_m >= self._rejected_m and len(self._rejected) >= _MIN_CONTRADICTIONS
        if (is_constant or (is_road_lost and self._agreements >= _MIN_AGREEMENTS)) and not self._speed.is_frozen():
            self._filter.reset_scale(1.0)
            self._rejected = []
        return 1.0

    def motion(self, from_ns: int, to_ns: int) -> CarMotion | None:
        """Motion between two times; None if readings are missing or not trusted."""
        cfg, newest_ns = self.config, self._speed.newest_ns
        if newest_ns is None or not self.is_trusted or to_ns - newest_ns > cfg.missing_s * NS_PER_S:
            return None
        cov = self._filter.cov
        integral = self._speed.integrate(from_ns, to_ns, float(self._filter.x[CAR_DELAY]))
        if integral is None:
            return None
        by_factor = math.exp(-float(self._filter.x[CAR_FACTOR]))
        return CarMotion(
            forward_m=integral.distance_m * by_factor,
            sigma_m=math.sqrt(integral.var_m2 + integral.by_delay_mps**2 * float(cov[CAR_DELAY, CAR_DELAY]))
            * by_factor,
            sigma_rel=math.sqrt(float(cov[CAR_FACTOR, CAR_FACTOR])),
            yaw_rad=integral.yaw_rad,
            yaw_sigma_rad=math.sqrt(integral.yaw_var),
            is_proven=self._agreements >= _MIN_AGREEMENTS,
            has_agreed=self._agreed_ns is not None and to_ns - self._agreed_ns < _RECENT_S * NS_PER_S,
        )

    def status(self) -> list[Status]:
        """Faults of the readings."""
        out = self._speed.status
        if self.is_trusted or Status.CAR_SPEED_MISSING in out:
            return out
        frozen = self._speed.is_frozen() and not self._is_overruled
        fault = Status.CAR_SPEED_FROZEN if frozen else Status.CAR_SPEED_IMPLAUSIBLE
        return out if fault in out else [fault, *out]
