"""The car's own speed as a measurement of the metric scale, with the scale factor and the delay of its readings:

    v_read(t) = k v(t - delay),    distance by readings / distance by images = k lambda

lambda, log k and the delay are states of the road's filter: where the road is seen it calibrates k, and where it is not
the readings carry the metres. A distance that is off by several sigma is rejected, and the readings are not used until
one agrees again. docs/method.md has which of road, images and readings is believed when.
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

MOVING_M = 0.05  # from one image to the next: below it the car may stand
_SAME_RATIO_STD = 0.04  # of log ratios in contradiction: below it the scale is wrong, not the readings
_MOVING_SIGMAS = 4.0
_RECENT_S = 2.0
_CLOCK_TOLERANCE_S = 0.02  # by which the newest reading may be older than its image
_NIS_GAIN, _MAX_NIS = 0.1, 9.0  # of the running mean of the normalised innovation squared
_MIN_AGREEMENTS = 10  # distances that agreed, before the readings may rule out lengths by the road
_MIN_CONTRADICTIONS = 3  # of the road in a row, with one ratio, until the readings are overruled
_CONTRADICTION_SPREAD = 0.15  # of those log ratios
_MIN_REJECTED = 4  # distances that have a spread


@dataclass(frozen=True)
class CarMotion:
    """The car's motion by its own speed, corrected for the scale factor."""

    forward_m: float
    sigma_m: float  # of the readings, and by the delay
    sigma_rel: float  # of the scale factor
    yaw_rad: float | None  # counter-clockwise; None: no yaw rate
    yaw_sigma_rad: float
    agreed: bool = False  # a distance by the readings has agreed with the images lately
    proven: bool = False  # and at least _MIN_AGREEMENTS did, with the road too

    def is_moving(self, least_m: float) -> bool:
        """Whether the car has moved significantly."""
        return abs(self.forward_m) > least_m + _MOVING_SIGMAS * self.sigma_m


@dataclass
class _PathSample:
    t_ns: int
    distance: float  # forwards by images, in the odometry's unit, since an arbitrary start


class SpeedScale:
    """State, measurements and readers:

    - State: the distance by images since the last comparison, image by image; whether the readings are trusted.
    - Measurements: `add_readings`, the car's readings; `update`, each motion by images.
    - Readers: `road.scale.RoadScale` for the factor on all lengths, its statuses and sources; `Odometry` through it for
      `motion_factor`, and for `motion`, where images show none.
    """

    def __init__(self, config: RoadScaleConfig, filter_: RoadFilter) -> None:
        self._road, self._filter = config, filter_
        self._speed = SpeedReadings(config.car)
        self._path: list[_PathSample] = []
        self._road_confirmed = False  # the scale, by the road
        self._settled = False  # the scale drifts slowly
        self._rejected: list[tuple[int, float]] = []  # (time, log ratio) since a distance agreed
        self._agreed_ns: int | None = None  # the end of the last distance that agreed
        self._mean_nis = 1.0  # running mean of the normalised innovation squared
        self._contradictions: list[float] = []  # log ratios of the road's metres to those by the readings
        self._rejected_m = 0.0  # travelled since the first of those rejected
        self._agreements = 0  # with images in the road's metres, since the readings last jumped
        self._overruled = False  # the road has contradicted the readings
        self._window_m = 0.0  # travelled since the window began
        self._jumps = 0
        self.since_m = math.inf  # travelled since a distance agreed
        self.motion_factor = 1.0  # on the newest motion alone, beside that on all lengths

    @property
    def config(self) -> CarSpeedConfig:
        return self._road.car

    @property
    def trusted(self) -> bool:
        """Whether the last distance by the readings agreed with the images, or none has been compared yet."""
        return not self._rejected and not self._overruled

    @property
    def measures(self) -> bool:
        """Whether the metres come from the readings now."""
        return self.trusted and self.since_m < self._road.carried_after_m

    @property
    def scale_factor(self) -> float | None:
        """The factor on all lengths by the readings' last distance; None where too few have agreed before."""
        if self._agreements < _MIN_AGREEMENTS or self._speed.status:
            return None
        if not self._rejected:
            return 1.0
        return math.exp(self._rejected[-1][1] - float(self._filter.x[CAR_FACTOR]))

    def add_readings(self, readings: Iterable[SpeedReading], t_source_ns: int) -> None:
        """A frame's readings."""
        self._speed.add_readings(readings, t_source_ns)
        if self._speed.received and not self._filter.has_car_states:
            self._filter.add_car_states()
        if self._speed.jumps != self._jumps:
            self._jumps = self._speed.jumps
            self._path = self._path[-1:]
        if self._speed.is_jumping:
            self._agreements = 0

    def restart(self) -> None:
        """The window restarts, with a new scale."""
        self._path = []
        self.since_m = math.inf
        self._window_m = 0.0

    def road_contradicts(self, log_ratio: float) -> None:
        """An alignment was accepted at a scale that differs by this factor; repeated, it overrules the readings."""
        if not self.measures:
            return
        self._contradictions = [*self._contradictions[1 - _MIN_CONTRADICTIONS :], log_ratio]
        if len(self._contradictions) == _MIN_CONTRADICTIONS and np.ptp(self._contradictions) < _CONTRADICTION_SPREAD:
            self._overruled, self._contradictions, self.since_m, self._agreements = True, [], math.inf, 0

    def rescale(self, factor: float) -> None:
        """Multiplies all lengths."""
        for sample in self._path:
            sample.distance *= factor

    def update(self, from_ns: int, to_ns: int, forward: float, travelled: float, confirmed: bool) -> float:
        """The factor on all lengths, after a motion by images of `forward` along the car and `travelled` in all.

        `confirmed`: the scale is known by the road.
        """
        self.since_m += travelled
        self._window_m += travelled
        self._rejected_m += travelled
        self.motion_factor = 1.0
        if not self._speed.received:
            return 1.0
        self._road_confirmed = confirmed
        self._settled = confirmed or self._window_m > self._road.carried_after_m
        if not self._settled:
            walk = self.config.start_walk_rel_per_sqrt_m**2 * travelled
            self._filter.cov[0, 0] = min(self._filter.cov[0, 0] + walk, 1.0)
        if not self._path or self._path[-1].t_ns > from_ns:
            self._path = [_PathSample(from_ns, 0.0)]
        elif self._path[-1].t_ns < from_ns:
            self._path.append(_PathSample(from_ns, self._path[-1].distance))  # the car stood
        self._path.append(_PathSample(to_ns, self._path[-1].distance + forward))
        factor = self._compare()
        self._path = [sample for sample in self._path if to_ns - sample.t_ns <= self.config.longest_s * NS_PER_S]
        return factor

    def _compare(self) -> float:
        """Compares the distance by images that the readings cover; 1 where it is too short or rejected."""
        cfg, filter_ = self.config, self._filter
        delay_s = float(filter_.x[CAR_DELAY])
        # Readings are awaited; but where the metres are not known at all the last one is extrapolated for a moment
        known = filter_.cov[0, 0] < self._road.doubt_sigma_rel**2
        least_s = -_CLOCK_TOLERANCE_S if known else -cfg.late_s
        first = self._path[0]
        covered = [s for s in self._path[1:] if self._speed.covers_s(s.t_ns, delay_s) >= least_s]
        if not covered or abs(covered[-1].distance - first.distance) < cfg.least_way_m:
            return 1.0
        last, visual = covered[-1], covered[-1].distance - first.distance
        lag = self._path[-1].distance - last.distance
        self._path = [sample for sample in self._path if sample.t_ns >= last.t_ns]
        way = self._speed.integrate(first.t_ns, last.t_ns, delay_s)
        if way is None:
            return 1.0
        ratio = way.distance_m / visual
        own = cfg.sigma_step_rel**2 / max(abs(visual), 1.0) + (cfg.sigma_step_m / visual) ** 2  # the images'
        var = way.var_m2 / max(visual**2, way.distance_m**2) + own
        walk = self._road.scale_walk_rel_per_sqrt_m if self._settled else cfg.start_walk_rel_per_sqrt_m
        var += walk**2 * abs(lag)
        if ratio <= 0.05:
            return self._reject(last.t_ns, math.log(0.05))
        log_ratio, by_delay = math.log(ratio), way.by_delay_mps / way.distance_m
        # By night a distance by images may be five times as noisy as by day, which the last innovations show
        _, _, sigmas = filter_.car_innovation(log_ratio, by_delay, var * self._mean_nis)
        nis = self._mean_nis * min(sigmas, cfg.max_innovation_sigma) ** 2
        self._mean_nis += _NIS_GAIN * (nis - self._mean_nis)
        self._mean_nis = min(max(self._mean_nis, 1.0), _MAX_NIS)
        if self._overruled:  # only a distance that any car's factor explains is accepted again
            sigmas = max(sigmas, abs(log_ratio) / math.sqrt(2.0 * cfg.sigma_factor_rel**2 + var))
        if sigmas > cfg.max_innovation_sigma:
            return self._reject(last.t_ns, log_ratio)
        self._rejected, self._agreed_ns, self.since_m, self._overruled = [], last.t_ns, 0.0, False
        if self._road_confirmed and filter_.carried_m < self._road.carried_after_m:
            self._agreements += 1
        if not self._settled:
            start = (cfg.sigma_start_m / visual) ** 2
            own, var = own + start, var + start
        if lag == 0.0:
            H, innovation, sigmas = filter_.car_innovation(log_ratio, by_delay, var)
            if sigmas < cfg.max_innovation_sigma:  # else the wheels may slip
                self.motion_factor = math.exp(own / (float((H @ filter_.cov @ H.T)[0, 0]) + var) * innovation)
        return filter_.update_car_speed(log_ratio, by_delay, var)

    def _reject(self, t_ns: int, log_ratio: float) -> float:
        """Keeps a distance that disagrees, and decides whether the readings or the scale are wrong."""
        cfg = self.config
        if not self._rejected:
            self._rejected_m = 0.0
        self._rejected = [*self._rejected[-200:], (t_ns, log_ratio)]
        recent = [ratio for then_ns, ratio in self._rejected if t_ns - then_ns <= cfg.doubt_s * NS_PER_S]
        persists = (t_ns - self._rejected[0][0]) / NS_PER_S >= cfg.doubt_s and len(recent) >= _MIN_REJECTED
        road_hidden = self._filter.carried_m > self._road.carried_after_m and not self._overruled
        one_ratio = persists and road_hidden and float(np.std(recent)) < _SAME_RATIO_STD
        # Proven readings are preferred to images that have lost the road since: by night their scale diverges
        road_silent = self._filter.carried_m >= self._rejected_m and len(self._rejected) >= _MIN_CONTRADICTIONS
        if (one_ratio or (road_silent and self._agreements >= _MIN_AGREEMENTS)) and not self._speed.frozen():
            self._filter.reset_scale(1.0)
            self._rejected = []
        return 1.0

    def motion(self, from_ns: int, to_ns: int) -> CarMotion | None:
        """The motion between two times; None where readings are missing or not trusted."""
        cfg, newest_ns = self.config, self._speed.newest_ns
        if newest_ns is None or not self.trusted or to_ns - newest_ns > cfg.missing_s * NS_PER_S:
            return None
        cov = self._filter.cov
        way = self._speed.integrate(from_ns, to_ns, float(self._filter.x[CAR_DELAY]))
        if way is None:
            return None
        by_factor = math.exp(-float(self._filter.x[CAR_FACTOR]))
        return CarMotion(
            forward_m=way.distance_m * by_factor,
            sigma_m=math.sqrt(way.var_m2 + way.by_delay_mps**2 * float(cov[CAR_DELAY, CAR_DELAY])) * by_factor,
            sigma_rel=math.sqrt(float(cov[CAR_FACTOR, CAR_FACTOR])),
            yaw_rad=way.yaw_rad,
            yaw_sigma_rad=math.sqrt(way.yaw_var),
            proven=self._agreements >= _MIN_AGREEMENTS,
            agreed=self._agreed_ns is not None and to_ns - self._agreed_ns < _RECENT_S * NS_PER_S,
        )

    def status(self) -> list[Status]:
        """What is wrong with the readings."""
        out = self._speed.status
        if self.trusted or Status.CAR_SPEED_MISSING in out:
            return out
        frozen = self._speed.frozen() and not self._overruled
        fault = Status.CAR_SPEED_FROZEN if frozen else Status.CAR_SPEED_IMPLAUSIBLE
        return out if fault in out else [fault, *out]
