"""The car's own speed as a measurement of the metric scale, with the scale factor and the delay of its readings.

    v_read(t) = k v(t - delay),    way by readings / way by images = k lambda

lambda, log k and the delay are states of the road's filter, so that each knows of the others: where the road is well
seen it teaches the factor, and where it is not the readings carry the metres by the factor learned. The delay shows
itself where the car brakes or accelerates, and nowhere else.

A way by images is wrong by itself too, from pose to pose, most by night. That share of its misfit changes the
newest motion alone (`motion_factor`), the landmarks and the unit of length stay as they are.

A way that contradicts what was expected is refused, and the readings are then not trusted until one agrees again. So
the road stays in the right while it is seen. Where it is not and the contradiction stays one and the same ratio, it is
the images whose metres are in doubt, and the car's count.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from birdslam.odometry.road.kalman_filter import CAR_DELAY, CAR_FACTOR, RoadFilter, RoadScaleConfig
from birdslam.odometry.speed.readings import CarSpeed, CarSpeedConfig
from birdslam.types import NS_PER_S, SpeedReading, Status

_ONE_RATIO = 0.04  # spread of the log ratios of a contradiction that is a wrong unit of length and no wrong reading
_SURE_SIGMAS = 4.0
_LATELY_S = 2.0
_TICK_S = 0.02  # by which the newest reading may be older than the image that it is held against
_MISFIT_SHARE, _MAX_MISFIT2 = 0.1, 9.0  # of the newest way in the mean; and no more than that
_PROVEN = 10  # ways that agreed, before the readings may say which of the road's lengths are none
_STRIKES = 3  # of the road in a row, with one ratio, against the readings that the metres rest on
_ROAD_RATIO = 0.15  # spread of those log ratios
_FEWEST_WAYS = 4  # that make a spread


@dataclass(frozen=True)
class CarStep:
    """The car's motion by its own readings; the scale factor is taken out."""

    forward_m: float
    sigma_m: float  # of the readings, and by the delay
    sigma_rel: float  # of the scale factor
    yaw_rad: float | None  # counter-clockwise; None: the car does not say
    yaw_sigma_rad: float
    agreed: bool = False  # a way by them has agreed with the images lately
    proven: bool = False  # and many did before

    def drives(self, least_m: float) -> bool:
        """Whether the car surely moved."""
        return abs(self.forward_m) > least_m + _SURE_SIGMAS * self.sigma_m


@dataclass
class _Seen:
    t_ns: int
    way: float  # forwards by images, in the odometry's unit, since any moment


class CarScale:
    """State, measurements and readers:

    - State: the way by images since the last comparison, image by image; whether the readings are trusted.
    - Measurements: `hear`, the car's readings; `follow`, each motion by images.
    - Readers: `road_scale.RoadScale` for the factor on all lengths, its statuses and sources; `Odometry` through it for
      `motion_factor`, and for `step`, the motion where images show none.
    """

    def __init__(self, config: RoadScaleConfig, filter_: RoadFilter) -> None:
        self._road, self._filter = config, filter_
        self._speed = CarSpeed(config.car)
        self._seen: list[_Seen] = []
        self._confirmed = False  # the unit of length is, by the road
        self._settled = False  # the unit of length drifts slowly by now
        self._refused: list[tuple[int, float]] = []  # (time, log ratio) since a way agreed
        self._agreed_ns: int | None = None  # when the last way that agreed ended
        self._misfit2 = 1.0  # of the last ways against their sigma, squared, in the mean
        self._strikes: list[float] = []  # log ratios by which the road's metres differed from those by the readings
        self._refused_m = 0.0  # travelled since the first of those refused
        self._agreements = 0  # of ways with the road's metres too, since the readings last jumped
        self._barred = False  # the road has spoken against the readings
        self._begun_m = 0.0  # travelled since the window began
        self._jumps = 0
        self.since_m = math.inf  # travelled since then
        self.motion_factor = 1.0  # on the newest motion alone, beside that on all lengths

    @property
    def config(self) -> CarSpeedConfig:
        return self._road.car

    @property
    def trusted(self) -> bool:
        """Whether the last way by the readings fits what the images show, or none has been compared yet."""
        return not self._refused and not self._barred

    @property
    def measures(self) -> bool:
        """Whether the metres rest on the readings now."""
        return self.trusted and self.since_m < self._road.carried_after_m

    @property
    def length(self) -> float | None:
        """The factor on all lengths by the readings' last way; None where too few ways have agreed to ask them."""
        if self._agreements < _PROVEN or self._speed.status:
            return None
        if not self._refused:
            return 1.0
        return math.exp(self._refused[-1][1] - float(self._filter.x[CAR_FACTOR]))

    def hear(self, readings: Iterable[SpeedReading], t_source_ns: int) -> None:
        """A frame's readings."""
        self._speed.hear(readings, t_source_ns)
        if self._speed.heard and not self._filter.hears_car:
            self._filter.begin_car()
        if self._speed.jumps != self._jumps:
            self._jumps = self._speed.jumps
            self._seen = self._seen[-1:]
        if self._speed.jumping:
            self._agreements = 0

    def restart(self) -> None:
        """The window begins anew: its unit of length is another."""
        self._seen = []
        self.since_m = math.inf
        self._begun_m = 0.0

    def contradict(self, log_ratio: float) -> None:
        """The road's image was found to fit other metres, by this factor: it decides where it does so again."""
        if not self.measures:
            return
        self._strikes = [*self._strikes[1 - _STRIKES :], log_ratio]
        if len(self._strikes) == _STRIKES and np.ptp(self._strikes) < _ROAD_RATIO:
            self._barred, self._strikes, self.since_m, self._agreements = True, [], math.inf, 0

    def rescale(self, factor: float) -> None:
        """All lengths are multiplied."""
        for seen in self._seen:
            seen.way *= factor

    def follow(self, from_ns: int, to_ns: int, forward: float, travelled: float, confirmed: bool) -> float:
        """The factor on all lengths, after a motion by images of `forward` along the car and `travelled` in all.

        `confirmed` by the road is the unit of length.
        """
        self.since_m += travelled
        self._begun_m += travelled
        self._refused_m += travelled
        self.motion_factor = 1.0
        if not self._speed.heard:
            return 1.0
        self._confirmed = confirmed
        self._settled = confirmed or self._begun_m > self._road.carried_after_m
        if not self._settled:
            walk = self.config.start_walk_rel_per_sqrt_m**2 * travelled
            self._filter.cov[0, 0] = min(self._filter.cov[0, 0] + walk, 1.0)
        if not self._seen or self._seen[-1].t_ns > from_ns:
            self._seen = [_Seen(from_ns, 0.0)]
        elif self._seen[-1].t_ns < from_ns:
            self._seen.append(_Seen(from_ns, self._seen[-1].way))  # it stood
        self._seen.append(_Seen(to_ns, self._seen[-1].way + forward))
        factor = self._compare()
        self._seen = [seen for seen in self._seen if to_ns - seen.t_ns <= self.config.longest_s * NS_PER_S]
        return factor

    def _compare(self) -> float:
        """Holds the way by images that the readings cover by now against them; 1 where it is too short or refused."""
        cfg, filter_ = self.config, self._filter
        delay_s = float(filter_.x[CAR_DELAY])
        # Readings are waited for; but where the metres are not known at all the last one is let go on for a moment
        known = filter_.cov[0, 0] < self._road.doubt_sigma_rel**2
        least_s = -_TICK_S if known else -cfg.late_s
        first = self._seen[0]
        covered = [s for s in self._seen[1:] if self._speed.covers_s(s.t_ns, delay_s) >= least_s]
        if not covered or abs(covered[-1].way - first.way) < cfg.least_way_m:
            return 1.0
        last, by_images = covered[-1], covered[-1].way - first.way
        lag = self._seen[-1].way - last.way
        self._seen = [seen for seen in self._seen if seen.t_ns >= last.t_ns]
        way = self._speed.way(first.t_ns, last.t_ns, delay_s)
        if way is None:
            return 1.0
        ratio = way.way_m / by_images
        own = cfg.sigma_step_rel**2 / max(abs(by_images), 1.0) + (cfg.sigma_step_m / by_images) ** 2  # the images'
        var = way.var_m2 / max(by_images**2, way.way_m**2) + own
        walk = self._road.scale_walk_rel_per_sqrt_m if self._settled else cfg.start_walk_rel_per_sqrt_m
        var += walk**2 * abs(lag)
        if ratio <= 0.05:
            return self._refuse(last.t_ns, math.log(0.05))
        log_ratio, by_delay = math.log(ratio), way.by_delay_mps / way.way_m
        # By night a way by images may be five times as rough as by day: the last ways' misfit says so
        _, _, sigmas = filter_.car_innovation(log_ratio, by_delay, var * self._misfit2)
        misfit2 = self._misfit2 * min(sigmas, cfg.max_innovation_sigma) ** 2
        self._misfit2 += _MISFIT_SHARE * (misfit2 - self._misfit2)
        self._misfit2 = min(max(self._misfit2, 1.0), _MAX_MISFIT2)
        if self._barred:  # by the road: only a way that any car's factor explains makes up for it
            sigmas = max(sigmas, abs(log_ratio) / math.sqrt(2.0 * cfg.sigma_factor_rel**2 + var))
        if sigmas > cfg.max_innovation_sigma:
            return self._refuse(last.t_ns, log_ratio)
        self._refused, self._agreed_ns, self.since_m, self._barred = [], last.t_ns, 0.0, False
        if self._confirmed and filter_.carried_m < self._road.carried_after_m:
            self._agreements += 1
        if not self._settled:
            start = (cfg.sigma_start_m / by_images) ** 2
            own, var = own + start, var + start
        if lag == 0.0:
            H, beyond, sigmas = filter_.car_innovation(log_ratio, by_delay, var)
            if sigmas < cfg.max_innovation_sigma:  # else, by night too, it may be the wheels that slip
                self.motion_factor = math.exp(own / (float((H @ filter_.cov @ H.T)[0, 0]) + var) * beyond)
        return filter_.measure_car(log_ratio, by_delay, var)

    def _refuse(self, t_ns: int, log_ratio: float) -> float:
        """Remembers a way that does not fit, and decides which of the two is in doubt."""
        cfg = self.config
        if not self._refused:
            self._refused_m = 0.0
        self._refused = [*self._refused[-200:], (t_ns, log_ratio)]
        lately = [ratio for then_ns, ratio in self._refused if t_ns - then_ns <= cfg.doubt_s * NS_PER_S]
        lasting = (t_ns - self._refused[0][0]) / NS_PER_S >= cfg.doubt_s and len(lately) >= _FEWEST_WAYS
        unseen = self._filter.carried_m > self._road.carried_after_m and not self._barred
        one_ratio = lasting and unseen and float(np.std(lately)) < _ONE_RATIO
        # Readings that have proved right go before images that have lost the road since: by night these run away
        silent = self._filter.carried_m >= self._refused_m and len(self._refused) >= _STRIKES
        if (one_ratio or (silent and self._agreements >= _PROVEN)) and not self._speed.frozen():
            self._filter.forget_scale(1.0)
            self._refused = []
        return 1.0

    def step(self, from_ns: int, to_ns: int) -> CarStep | None:
        """The motion between two moments; None where the readings are not there or not trusted."""
        cfg, newest_ns = self.config, self._speed.newest_ns
        if newest_ns is None or not self.trusted or to_ns - newest_ns > cfg.missing_s * NS_PER_S:
            return None
        cov = self._filter.cov
        way = self._speed.way(from_ns, to_ns, float(self._filter.x[CAR_DELAY]))
        if way is None:
            return None
        by_factor = math.exp(-float(self._filter.x[CAR_FACTOR]))
        return CarStep(
            forward_m=way.way_m * by_factor,
            sigma_m=math.sqrt(way.var_m2 + way.by_delay_mps**2 * float(cov[CAR_DELAY, CAR_DELAY])) * by_factor,
            sigma_rel=math.sqrt(float(cov[CAR_FACTOR, CAR_FACTOR])),
            yaw_rad=way.yaw_rad,
            yaw_sigma_rad=math.sqrt(way.yaw_var),
            proven=self._agreements >= _PROVEN,
            agreed=self._agreed_ns is not None and to_ns - self._agreed_ns < _LATELY_S * NS_PER_S,
        )

    def status(self) -> list[Status]:
        """What is wrong with the readings."""
        out = self._speed.status
        if self.trusted or Status.CAR_SPEED_MISSING in out:
            return out
        frozen = self._speed.frozen() and not self._barred
        told = Status.CAR_SPEED_FROZEN if frozen else Status.CAR_SPEED_IMPLAUSIBLE
        return out if told in out else [told, *out]
