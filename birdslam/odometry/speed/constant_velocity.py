"""A prior on the motion of a car, for images that show no translation: its speed is held, along the road.

Landmarks that are all far away, or hidden but for a few, determine the rotation and not the translation: the
information of the resected pose says so. A car's speed changes only as fast as its brakes and engine allow, and goes on
changing for seconds (Singer's model, 1970: an acceleration with a memory), so that the sigma of a held speed grows with
the time and not with its root. The way lies in the road and, but for the turn, along the car's axis (nonholonomic
constraint): a direction that was taken from the last step would wander, and with it the length by the road's image.
"""

from __future__ import annotations

import math
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import GroundPlane
from birdslam.geometry.pose import Pose
from birdslam.geometry.se2 import SE2
from birdslam.odometry.motion import on_plane, planar

Floats = NDArray[np.float64]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]

_SIDESTEP_M = 0.002
_WEAK_PRIOR = np.diag([1e-2] * 3 + [1e2] * 3)  # 10 m and 0.1 rad: a direction that the images do not see
_STEEPEST = 0.2  # of a way's direction beside the camera's axis, as far as it is learnt
_MIN_STEP_M = 0.1  # of a motion whose direction is learnt


class ConstantVelocityConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """When the prior is used. By judgement; no data chose these: on the real clips it is never used.

    In KITTI 06, with all but the end of the street blackened for 3 s, the speed stays within 6 %.
    """

    acceleration_mps2: Positive = 3.0  # 1-sigma of a car's acceleration
    acceleration_memory_s: Positive = 1.0  # over which it lasts
    # The ratio of a step's sigma by the images to that by the prior, from which it is used
    on_threshold: Positive = 2.0
    # ... until a step is known to the larger of these, which shows translation, however little the speed changes
    # between images at 33 Hz
    least_sigma_m: Positive = 0.04  # (the shipped drive has 0.01, KITTI 06 at its night 0.1 and more)
    least_sigma_rel: Positive = 0.1  # of its length
    sigma_direction_rad: Positive = 0.02  # of the direction of travel
    heading_memory_m: Positive = 20.0  # over which the camera's heading against the car's way is learnt
    inflation: Positive = 9.0  # of the images' variances meanwhile: far corners err together


class ConstantVelocityPrior:
    """State, measurements and readers:

    - State: the car's speed (m/s) and acceleration (m/s^2), with their covariance (2, 2); the camera's heading against
      the car's axis (rad).
    - Prediction: the acceleration fades with its memory.
    - Measurements: each step and its sigma along the way.
    - Reader: `Odometry`, for the pose of an image that shows no translation.
    """

    def __init__(self, config: ConstantVelocityConfig, camera_ahead_m: float = 0.0) -> None:
        """`camera_ahead_m`: of the rear axle, about which the car turns."""
        self.config, self._ahead_m = config, camera_ahead_m
        self._x, self._cov = np.zeros(2), np.diag([np.inf, config.acceleration_mps2**2])
        self._heading_rad = 0.0
        self.active = False  # the newest pose has the prior in it
        # The newest step along the way by the images alone, where the prior was fused, and its 1-sigma
        self._shown_m: float | None = None
        self._sigma_m = np.inf

    @property
    def sigma_rel(self) -> float:
        """1-sigma of the speed as a fraction, while the prior is used; else 0."""
        return math.sqrt(self._cov[0, 0]) / max(abs(float(self._x[0])), 1e-3) if self.active else 0.0

    def stop(self) -> None:
        """The car stands."""
        self._x, self._cov = np.zeros(2), np.diag([0.0, self.config.acceleration_mps2**2])
        self.active, self._shown_m = False, None

    def rescale(self, factor: float) -> None:
        """All lengths are multiplied by it."""
        self._x = factor * self._x
        if self._shown_m is not None:
            self._shown_m *= factor

    def update(self, step: SE2, dt_s: float) -> None:
        """The newest step of the car on the road, over `dt_s`: that of the last pose given to `fuse`."""
        x, cov = self._predicted(dt_s)
        speed, var = (step.x_m if self._shown_m is None else self._shown_m) / dt_s, (self._sigma_m / dt_s) ** 2
        if not np.isfinite(cov[0, 0]):
            self._x, self._cov = np.array([speed, 0.0]), np.diag([var, cov[1, 1]])
        elif np.isfinite(var):
            gain = cov[:, 0] / (cov[0, 0] + var)
            self._x, self._cov = x + gain * (speed - x[0]), cov - np.outer(gain, cov[0])
        if not self.active and step.x_m > _MIN_STEP_M:
            aside = (step.y_m - self._ahead_m * step.yaw_rad) / step.x_m
            share = -math.expm1(-step.x_m / self.config.heading_memory_m)
            self._heading_rad += share * (min(max(aside, -_STEEPEST), _STEEPEST) - self._heading_rad)

    def _predicted(self, dt_s: float) -> tuple[Floats, Floats]:
        """Speed and acceleration after `dt_s`, and their covariance."""
        lasts = math.exp(-dt_s / self.config.acceleration_memory_s)
        F = np.array([[1.0, dt_s], [0.0, lasts]])
        if not np.isfinite(self._cov[0, 0]):
            return F @ self._x, self._cov
        noise = (1.0 - lasts**2) * self.config.acceleration_mps2**2
        return F @ self._x, F @ self._cov @ F.T + np.diag([0.0, noise])

    def fuse(
        self, base: Pose, measured: Pose, info: Floats, dt_s: float, ground: GroundPlane
    ) -> tuple[Pose, float] | None:  # fmt: skip
        """The maximum-likelihood pose by the images and the prior, and 1-sigma of its position; None: prior not needed.

        `measured` is the pose by the images `dt_s` after that at `base`, with information (6, 6) of (translation,
        rotation) in the camera's own axes, over `ground`.
        """
        cfg = self.config
        (speed, _), cov = self._predicted(dt_s)
        turned_rad = planar(base.between(measured), ground).yaw_rad
        length_m = speed * dt_s
        aside_m = self._heading_rad * length_m + self._ahead_m * turned_rad
        predicted = base @ on_plane(SE2.exp(np.array([length_m, aside_m, turned_rad])), ground)
        predicted_sigma_m, known = math.sqrt(cov[0, 0]) * dt_s, info + _WEAK_PRIOR
        limit = 0.0 if self.active else cfg.on_threshold
        least_m = max(cfg.least_sigma_m, cfg.least_sigma_rel * abs(length_m))
        self.active = math.isfinite(predicted_sigma_m) and (
            largest_sigma_m(known) > max(limit * predicted_sigma_m, least_m)
        )
        # The car's axis and no step, which of a car that pulls away points anywhere
        way = measured.R.T @ base.R @ on_plane(SE2(1.0, self._heading_rad, 0.0), ground).p
        along = way / float(np.linalg.norm(way))
        self._shown_m = None
        if not self.active:
            self._sigma_m = math.sqrt(float(along @ np.linalg.inv(known)[:3, :3] @ along))
            return None
        known, across = known / cfg.inflation, np.zeros((6, 6))
        across_m = min(cfg.sigma_direction_rad * abs(length_m) + _SIDESTEP_M, predicted_sigma_m)
        across[:3, :3] = (np.eye(3) - np.outer(along, along)) / across_m**2
        off = np.concatenate([measured.R.T @ (predicted.p - measured.p), np.zeros(3)])
        shown = measured.moved(np.linalg.solve(known + across, across @ off))
        self._shown_m = float(along @ measured.R.T @ (shown.p - base.p))
        self._sigma_m = math.sqrt(float(along @ np.linalg.inv(known + across)[:3, :3] @ along))
        prior = across.copy()
        prior[:3, :3] += np.outer(along, along) / predicted_sigma_m**2
        both = known + prior
        return measured.moved(np.linalg.solve(both, prior @ off)), largest_sigma_m(both)


def largest_sigma_m(info: Floats) -> float:
    """1-sigma of the translation in its least certain direction, given the information (6, 6)."""
    return float(np.sqrt(np.linalg.eigvalsh(np.linalg.inv(info)[:3, :3])[-1]))
