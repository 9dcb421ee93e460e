"""Velocity prior for images that do not show the translation: constant velocity along the road.

Far landmarks determine the rotation but not the translation. The acceleration follows Singer's model (1970), an
exponentially correlated process, so that the sigma of the speed grows linearly with time. The motion lies in the road
and along the car's axis (nonholonomic constraint).
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

_MIN_LATERAL_SIGMA_M = 0.002
_WEAK_PRIOR = np.diag([1e-2] * 3 + [1e2] * 3)  # 10 m and 0.1 rad, for unobserved directions
_MAX_HEADING_SLOPE = 0.2  # of the estimated heading of the camera
_MIN_STEP_M = 0.1  # of a motion that updates the heading


class ConstantVelocityConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Parameters of the velocity prior and of its use. They are not tuned on data."""

    acceleration_mps2: Positive = 3.0  # 1-sigma of a car's acceleration
    acceleration_memory_s: Positive = 1.0  # its correlation time
    on_threshold: Positive = 2.0  # ratio of a step's sigma by images to that of the prior, above which it is used
    # It is used until the sigma of a step falls below the larger of these two
    least_sigma_m: Positive = 0.04
    least_sigma_rel: Positive = 0.1  # as a fraction of the step
    sigma_direction_rad: Positive = 0.02  # of the direction of travel
    heading_memory_m: Positive = 20.0  # of the estimate of the camera's heading against the car's axis
    inflation: Positive = 9.0  # of the images' variances while the prior is used: errors of far corners are correlated


class ConstantVelocityPrior:
    """State, measurements and readers:

    - State: the car's speed (m/s) and acceleration (m/s^2), with their covariance (2, 2); the camera's heading against
      the car's axis (rad).
    - Prediction: the acceleration decays exponentially.
    - Measurements: each step and its sigma along the direction of travel.
    - Reader: `Odometry`, for the pose of an image that does not show the translation.
    """

    def __init__(self, config: ConstantVelocityConfig, camera_ahead_m: float = 0.0) -> None:
        """`camera_ahead_m` is the distance of the camera ahead of the rear axle, about which the car turns."""
        self.config, self._ahead_m = config, camera_ahead_m
        self._x, self._cov = np.zeros(2), np.diag([np.inf, config.acceleration_mps2**2])
        self._heading_rad = 0.0
        self.is_active = False  # the newest pose includes the prior
        # Newest step along the direction of travel by the images alone if the prior was fused, and its 1-sigma
        self._measured_m: float | None = None
        self._sigma_m = np.inf

    @property
    def sigma_rel(self) -> float:
        """Relative 1-sigma of the speed while the prior is used, else 0."""
        return math.sqrt(self._cov[0, 0]) / max(abs(float(self._x[0])), 1e-3) if self.is_active else 0.0

    def stop(self) -> None:
        """Sets the speed of a stationary car."""
        self._x, self._cov = np.zeros(2), np.diag([0.0, self.config.acceleration_mps2**2])
        self.is_active, self._measured_m = False, None

    def rescale(self, factor: float) -> None:
        """Multiplies all lengths."""
        self._x = factor * self._x
        if self._measured_m is not None:
            self._measured_m *= factor

    def update(self, step: SE2, dt_s: float) -> None:
        """Updates with the newest step on the road over `dt_s`, that of the last pose given to `fuse`."""
        x, cov = self._predicted(dt_s)
        speed, var = (step.x_m if self._measured_m is None else self._measured_m) / dt_s, (self._sigma_m / dt_s) ** 2
        if not np.isfinite(cov[0, 0]):
            self._x, self._cov = np.array([speed, 0.0]), np.diag([var, cov[1, 1]])
        elif np.isfinite(var):
            gain = cov[:, 0] / (cov[0, 0] + var)
            self._x, self._cov = x + gain * (speed - x[0]), cov - np.outer(gain, cov[0])
        if not self.is_active and step.x_m > _MIN_STEP_M:
            lateral = (step.y_m - self._ahead_m * step.yaw_rad) / step.x_m
            weight = -math.expm1(-step.x_m / self.config.heading_memory_m)
            self._heading_rad += weight * (
                min(max(lateral, -_MAX_HEADING_SLOPE), _MAX_HEADING_SLOPE) - self._heading_rad
            )

    def _predicted(self, dt_s: float) -> tuple[Floats, Floats]:
        """Predicted speed and acceleration after `dt_s` (2,), and their covariance (2, 2)."""
        decay = math.exp(-dt_s / self.config.acceleration_memory_s)
        F = np.array([[1.0, dt_s], [0.0, decay]])
        if not np.isfinite(self._cov[0, 0]):
            return F @ self._x, self._cov
        noise = (1.0 - decay**2) * self.config.acceleration_mps2**2
        return F @ self._x, F @ self._cov @ F.T + np.diag([0.0, noise])

    def fuse(
        self, base: Pose, measured: Pose, info: Floats, dt_s: float, ground: GroundPlane
    ) -> tuple[Pose, float] | None:  # fmt: skip
        """Returns the pose by images and prior, and the 1-sigma of its position; None if the prior is not needed.

        `measured` is the pose by images `dt_s` after `base`, with information (6, 6) of (translation, rotation) in
        camera axes, over `ground`.
        """
        cfg = self.config
        (speed, _), cov = self._predicted(dt_s)
        turned_rad = planar(base.between(measured), ground).yaw_rad
        length_m = speed * dt_s
        aside_m = self._heading_rad * length_m + self._ahead_m * turned_rad
        predicted = base @ on_plane(SE2.exp(np.array([length_m, aside_m, turned_rad])), ground)
        predicted_sigma_m, known = math.sqrt(cov[0, 0]) * dt_s, info + _WEAK_PRIOR
        limit = 0.0 if self.is_active else cfg.on_threshold
        least_m = max(cfg.least_sigma_m, cfg.least_sigma_rel * abs(length_m))
        self.is_active = math.isfinite(predicted_sigma_m) and (
            largest_sigma_m(known) > max(limit * predicted_sigma_m, least_m)
        )
        # By the car's axis, since the direction of a short step is noisy
        direction = measured.R.T @ base.R @ on_plane(SE2(1.0, self._heading_rad, 0.0), ground).p
        along = direction / float(np.linalg.norm(direction))
        self._measured_m = None
        if not self.is_active:
            self._sigma_m = math.sqrt(float(along @ np.linalg.inv(known)[:3, :3] @ along))
            return None
        known, across = known / cfg.inflation, np.zeros((6, 6))
        across_m = min(cfg.sigma_direction_rad * abs(length_m) + _MIN_LATERAL_SIGMA_M, predicted_sigma_m)
        across[:3, :3] = (np.eye(3) - np.outer(along, along)) / across_m**2
        off = np.concatenate([measured.R.T @ (predicted.p - measured.p), np.zeros(3)])
        by_images = measured.moved(np.linalg.solve(known + across, across @ off))
        self._measured_m = float(along @ measured.R.T @ (by_images.p - base.p))
        self._sigma_m = math.sqrt(float(along @ np.linalg.inv(known + across)[:3, :3] @ along))
        prior = across.copy()
        prior[:3, :3] += np.outer(along, along) / predicted_sigma_m**2
        both = known + prior
        return measured.moved(np.linalg.solve(both, prior @ off)), largest_sigma_m(both)


def largest_sigma_m(info: Floats) -> float:
    """1-sigma of the translation in its least certain direction, from the information (6, 6)."""
    return float(np.sqrt(np.linalg.eigvalsh(np.linalg.inv(info)[:3, :3])[-1]))
