"""The yaw of a vehicle that neither motion nor body has given yet, by how wide its boxes are from all around.

One width has several yaws that fit, but as the ego drives by, only the true yaw fits all widths. With residuals r of
variance w each and an error of the outline of variance s2 that lasts for the whole track (a longer car, a wrong depth),

    -2 log L(yaw) = sum(r^2 / w) - s2 sum(r / w)^2 / (1 + s2 sum(1 / w)).

The prior has vehicles along the ego's way or across it, and is narrower where the road to them is straight.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.se2 import SE2, wrap
from birdslam.vehicles.placement.uncertain_yaw import HeadingConfig

Floats = NDArray[np.float64]

_MIN_DT_S = 1e-3
_UNSEEN_RAD = math.pi  # 1-sigma of the way's heading before a vehicle is seen
NEIGHBOURS = 2  # bins on both sides of the likeliest that are one mode with it
SURER = 2.0  # ratio of probabilities at which the yaw changes to another mode


class YawByOutline:
    """predict() once a frame, then weigh() its vehicles; `placing.Placing` and `yaw_filter.YawFilter` read it.

    State, of each vehicle: sums (N, F) of residuals over a fan of yaws in the odometry's world, modulo half a turn, and
    the heading of the ego's way by it (rad) with its 1-sigma.
    """

    def __init__(self, config: HeadingConfig) -> None:
        self.config = config
        self.grid_rad: Floats = np.arange(config.fan, dtype=np.float64) * (
            math.pi / config.fan
        )  # in the odometry's world
        self._squares = np.zeros((0, config.fan))  # sum of r^2 / w
        self._sums = np.zeros((0, config.fan))  # of r / w
        self._information = np.zeros(0)  # of 1 / w
        self._way_rad, self._sigma_way_rad = np.zeros(0), np.zeros(0)
        self._weight = np.zeros((0, config.fan))  # of the last sight
        self._modes = np.zeros((0, config.fan))  # summed over NEIGHBOURS on both sides
        self._bend_per_m = 0.0  # of the ego's way
        self._last = SE2()
        self._dt_s = _MIN_DT_S

    def __len__(self) -> int:
        return len(self._information)

    def begin(self) -> None:
        """A vehicle seen for the first time, in the next row."""
        blank = np.zeros((1, self.config.fan))
        self._squares, self._sums = np.concatenate([self._squares, blank]), np.concatenate([self._sums, blank])
        self._weight = np.concatenate([self._weight, blank + 1.0 / self.config.fan])
        self._modes = np.concatenate([self._modes, blank])
        self._information, self._way_rad = np.append(self._information, 0.0), np.append(self._way_rad, 0.0)
        self._sigma_way_rad = np.append(self._sigma_way_rad, _UNSEEN_RAD)

    def keep_rows(self, rows: Sequence[int]) -> None:
        """Forget the vehicles of all other rows."""
        for name in ("_squares", "_sums", "_information", "_way_rad", "_sigma_way_rad", "_weight", "_modes"):
            setattr(self, name, getattr(self, name)[rows])

    def predict(self, dt_s: float, T_world_ego: SE2) -> None:
        """To the next frame's ego pose: how much its way bends now."""
        step = self._last.between(T_world_ego)
        way_m = math.hypot(step.x_m, step.y_m)
        keep = math.exp(-way_m / self.config.bend_m)
        if way_m > 0.0:
            self._bend_per_m = keep * self._bend_per_m + (1.0 - keep) * step.yaw_rad / way_m
        self._last, self._dt_s = T_world_ego, max(dt_s, _MIN_DT_S)

    def weigh(
        self, rows: Sequence[int], residual: Floats, box_variance: Floats, variance: Floats, depth_m: Floats
    ) -> Floats:
        """(N, F): the probability of each yaw of `grid_rad`, by this frame's and all earlier sights.

        `residual` (N, F) and `box_variance` (N,) as in `uncertain_yaw.YawFan`; `variance` (N,) of the logs of the
        depths, `depth_m` (N,) themselves.
        """
        config, at = self.config, np.array(rows, dtype=np.intp)
        white = box_variance + config.least_width_rel**2
        white *= max(1.0, config.box_memory_s / self._dt_s)
        self._squares[at] += residual**2 / white[:, None]
        self._sums[at] += residual / white[:, None]
        self._information[at] += 1.0 / white
        lasting = (config.sigma_width_rel**2 + variance)[:, None]
        shared = lasting / (1.0 + lasting * self._information[at, None])
        likelihood = -0.5 * (self._squares[at] - shared * self._sums[at] ** 2)

        sigma = np.hypot(config.sigma_along_road_rad, self._bend_per_m * depth_m)
        straighter = at[sigma < self._sigma_way_rad[at]]
        self._way_rad[straighter] = self._last.yaw_rad
        self._sigma_way_rad[at] = np.minimum(sigma, self._sigma_way_rad[at])
        log_weight = likelihood + np.log(self._prior(at))
        weight: Floats = np.exp(log_weight - log_weight.max(axis=1, keepdims=True))
        self._weight[at] = weight / weight.sum(axis=1, keepdims=True)
        self._modes[at] = sum(np.roll(self._weight[at], k, axis=1) for k in range(-NEIGHBOURS, NEIGHBOURS + 1))
        return self._weight[at]

    def _prior(self, at: NDArray[np.intp]) -> Floats:
        """(N, F): along the ego's way, across it, or anywhere."""
        config = self.config
        off = self.grid_rad - self._way_rad[at, None]
        along = _density(off, self._sigma_way_rad[at, None])
        across = _density(off - math.pi / 2.0, np.hypot(self._sigma_way_rad[at, None], config.sigma_across_rad))
        return (
            (1.0 - config.across - config.oblique) * along
            + config.across * across
            + config.oblique / len(self.grid_rad)
        )

    def estimate(self, row: int, yaw_rad: float) -> tuple[float, float]:
        """(yaw in world, its 1-sigma) of a vehicle that is thought to be headed `yaw_rad`, and faces as it does.

        The mean of the likeliest mode; that of `yaw_rad` unless another one is far more probable. The sigma is of all.
        """
        weight = self._weight[row]
        span = np.arange(-NEIGHBOURS, NEIGHBOURS + 1)
        modes = self._modes[row]
        here = round(yaw_rad / math.pi * len(weight)) % len(weight)
        best = int(np.argmax(modes))
        near = max(range(here - NEIGHBOURS, here + NEIGHBOURS + 1), key=lambda k: float(modes[k % len(weight)]))
        if modes[best] < SURER * modes[near % len(weight)]:
            best = near % len(weight)
        share = weight[(best + span) % len(weight)]
        mean = self.grid_rad[best] + float(share @ span) / max(float(share.sum()), 1e-12) * math.pi / len(weight)
        mean = yaw_rad + _half_turn(mean - yaw_rad)
        away = np.remainder(self.grid_rad - mean + math.pi / 2.0, math.pi) - math.pi / 2.0
        return wrap(mean), math.sqrt(float(weight @ away**2))


def _density(off_rad: Floats, sigma_rad: Floats) -> Floats:
    """(N, F), sums of 1: normal, modulo half a turn, of yaws that are `off_rad` from its mean."""
    off = np.remainder(off_rad + math.pi / 2.0, math.pi) - math.pi / 2.0
    density: Floats = np.exp(-0.5 * np.square(off / sigma_rad)) + 1e-12
    return density / density.sum(axis=1, keepdims=True)


def _half_turn(angle_rad: float) -> float:
    """Within a quarter of a turn to both sides: a heading and its opposite are one."""
    return math.remainder(angle_rad, math.pi)
