"""Yaw of a vehicle from the widths of its boxes, while neither motion nor body has measured it.

With residuals r of variance w and a correlated error of the outline of variance s2 (dimensions, depth),

    -2 log L(yaw) = sum(r^2 / w) - s2 sum(r / w)^2 / (1 + s2 sum(1 / w)).

By the prior, vehicles are along the ego's road or across it; it is narrower if the road to them is straight.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.se2 import SE2, wrap
from birdslam.road_users.placement.uncertain_yaw import HeadingConfig

Floats = NDArray[np.float64]

_MIN_DT_S = 1e-3
_INITIAL_SIGMA_RAD = math.pi  # 1-sigma of the road's heading before the first observation
MODE_HALF_WIDTH = 2  # bins on both sides of a peak that belong to its mode
MIN_MODE_RATIO = 2.0  # minimum ratio of probabilities for a change of the mode


class YawByOutline:
    """Calls per frame: predict(), then weigh(). Readers: `placing.Placing` and `yaw_filter.YawFilter`.

    State of each vehicle: sums (N, F) of residuals over a fan of yaws in the odometry world, modulo half a turn, and
    the heading of the road at it (rad) with its 1-sigma.
    """

    def __init__(self, config: HeadingConfig) -> None:
        self.config = config
        self.grid_rad: Floats = np.arange(config.fan, dtype=np.float64) * (
            math.pi / config.fan
        )  # in the odometry's world
        self._squares = np.zeros((0, config.fan))  # sum of r^2 / w
        self._sums = np.zeros((0, config.fan))  # sum of r / w
        self._information = np.zeros(0)  # sum of 1 / w
        self._road_rad, self._sigma_road_rad = np.zeros(0), np.zeros(0)
        self._weight = np.zeros((0, config.fan))  # posterior of the last observation
        self._modes = np.zeros((0, config.fan))  # summed over MODE_HALF_WIDTH on both sides
        self._curvature_per_m = 0.0  # of the ego's path
        self._last = SE2()
        self._dt_s = _MIN_DT_S

    def __len__(self) -> int:
        return len(self._information)

    def add_vehicle(self) -> None:
        """Adds a new vehicle in the next row."""
        blank = np.zeros((1, self.config.fan))
        self._squares, self._sums = np.concatenate([self._squares, blank]), np.concatenate([self._sums, blank])
        self._weight = np.concatenate([self._weight, blank + 1.0 / self.config.fan])
        self._modes = np.concatenate([self._modes, blank])
        self._information, self._road_rad = np.append(self._information, 0.0), np.append(self._road_rad, 0.0)
        self._sigma_road_rad = np.append(self._sigma_road_rad, _INITIAL_SIGMA_RAD)

    def keep_rows(self, rows: Sequence[int]) -> None:
        """Removes the vehicles of all other rows."""
        for name in ("_squares", "_sums", "_information", "_road_rad", "_sigma_road_rad", "_weight", "_modes"):
            setattr(self, name, getattr(self, name)[rows])

    def predict(self, dt_s: float, T_world_ego: SE2) -> None:
        """Predicts to the ego pose of the next frame, and updates the curvature of the path."""
        step = self._last.between(T_world_ego)
        distance_m = math.hypot(step.x_m, step.y_m)
        decay = math.exp(-distance_m / self.config.bend_m)
        if distance_m > 0.0:
            self._curvature_per_m = decay * self._curvature_per_m + (1.0 - decay) * step.yaw_rad / distance_m
        self._last, self._dt_s = T_world_ego, max(dt_s, _MIN_DT_S)

    def weigh(
        self, rows: Sequence[int], residual: Floats, box_variance: Floats, variance: Floats, depth_m: Floats
    ) -> Floats:
        """(N, F) probability of each yaw of `grid_rad`, from all observations.

        `residual` (N, F) and `box_variance` (N,) as in `uncertain_yaw.YawFan`; `variance` (N,) is of the log depths,
        `depth_m` (N,) the depths.
        """
        config, at = self.config, np.array(rows, dtype=np.intp)
        white = box_variance + config.least_width_rel**2
        white *= max(1.0, config.box_memory_s / self._dt_s)
        self._squares[at] += residual**2 / white[:, None]
        self._sums[at] += residual / white[:, None]
        self._information[at] += 1.0 / white
        correlated = (config.sigma_width_rel**2 + variance)[:, None]
        shared = correlated / (1.0 + correlated * self._information[at, None])
        likelihood = -0.5 * (self._squares[at] - shared * self._sums[at] ** 2)

        sigma = np.hypot(config.sigma_along_road_rad, self._curvature_per_m * depth_m)
        is_straighter = at[sigma < self._sigma_road_rad[at]]
        self._road_rad[is_straighter] = self._last.yaw_rad
        self._sigma_road_rad[at] = np.minimum(sigma, self._sigma_road_rad[at])
        log_weight = likelihood + np.log(self._prior(at))
        weight: Floats = np.exp(log_weight - log_weight.max(axis=1, keepdims=True))
        self._weight[at] = weight / weight.sum(axis=1, keepdims=True)
        self._modes[at] = sum(
            np.roll(self._weight[at], k, axis=1) for k in range(-MODE_HALF_WIDTH, MODE_HALF_WIDTH + 1)
        )
        return self._weight[at]

    def _prior(self, at: NDArray[np.intp]) -> Floats:
        """(N, F) prior: along the ego's road, across it, or uniform."""
        config = self.config
        off = self.grid_rad - self._road_rad[at, None]
        along = _density(off, self._sigma_road_rad[at, None])
        across = _density(off - math.pi / 2.0, np.hypot(self._sigma_road_rad[at, None], config.sigma_across_rad))
        return (
            (1.0 - config.across - config.oblique) * along
            + config.across * across
            + config.oblique / len(self.grid_rad)
        )

    def estimate(self, row: int, yaw_rad: float) -> tuple[float, float]:
        """(yaw in world, its 1-sigma), with the front as of `yaw_rad`.

        The mean of the mode at `yaw_rad`, or of the best mode if that is far more probable. The sigma is over all
        modes.
        """
        weight = self._weight[row]
        span = np.arange(-MODE_HALF_WIDTH, MODE_HALF_WIDTH + 1)
        modes = self._modes[row]
        here = round(yaw_rad / math.pi * len(weight)) % len(weight)
        best = int(np.argmax(modes))
        near = max(
            range(here - MODE_HALF_WIDTH, here + MODE_HALF_WIDTH + 1), key=lambda k: float(modes[k % len(weight)])
        )
        if modes[best] < MIN_MODE_RATIO * modes[near % len(weight)]:
            best = near % len(weight)
        share = weight[(best + span) % len(weight)]
        mean = self.grid_rad[best] + float(share @ span) / max(float(share.sum()), 1e-12) * math.pi / len(weight)
        mean = yaw_rad + _half_turn(mean - yaw_rad)
        away = np.remainder(self.grid_rad - mean + math.pi / 2.0, math.pi) - math.pi / 2.0
        return wrap(mean), math.sqrt(float(weight @ away**2))


def _density(off_rad: Floats, sigma_rad: Floats) -> Floats:
    """(N, F) normalized normal density, modulo half a turn, of yaws with offset `off_rad` from the mean."""
    off = np.remainder(off_rad + math.pi / 2.0, math.pi) - math.pi / 2.0
    density: Floats = np.exp(-0.5 * np.square(off / sigma_rad)) + 1e-12
    return density / density.sum(axis=1, keepdims=True)


def _half_turn(angle_rad: float) -> float:
    """Angle modulo half a turn, in a quarter turn to both sides."""
    return math.remainder(angle_rad, math.pi)
