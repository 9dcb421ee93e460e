"""Builds the record of a motion (measured, stationary, predicted or wheel odometry) with its statuses."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.pose import Pose
from birdslam.geometry.se2 import SE2
from birdslam.odometry.metric_scale import MetricScale
from birdslam.odometry.motion import (
    Motion,
    MotionConfig,
    car_cov,
    coasting_cov,
    measured_cov,
    on_plane,
    planar,
    stationary_cov,
)
from birdslam.odometry.motion_model import NO_MOTION, MotionModel
from birdslam.odometry.speed.scale import CarMotion
from birdslam.types import SpeedSource, Status

Floats = NDArray[np.float64]

_MIN_VAGUE_MPS = 1.0  # a motion with a smaller 1-sigma of its speed is valid, however slow the car


@dataclass(frozen=True)
class MotionRecords:
    """Builds motions from the metric scale and the motion model; changes neither."""

    config: MotionConfig
    camera_ahead_m: float  # distance from the rear axle to the camera
    scale: MetricScale
    model: MotionModel
    invalid_sigma_rel: float  # relative 1-sigma of a length above which it is invalid

    def measured(
        self, frames: tuple[int, int], step: Pose, cov6: Floats, obstructed: bool, dt_s: float, earlier_m: float
    ) -> Motion:
        """The record of a step T_prev_curr in metres over `dt_s` with covariance (6, 6).

        `obstructed`: fixed corners were excluded. Up to `earlier_m` of the step may belong to earlier images, in which
        no motion was visible.
        """
        T_prev_curr = planar(step, self.scale.ground)
        cov = measured_cov(self.config, cov6, T_prev_curr, self.scale.ground, self.scale.sigma_rel)
        cov[0, 0] += earlier_m**2
        status = self.scale.status()
        if obstructed and Status.VIEW_OBSTRUCTED not in status:
            status.append(Status.VIEW_OBSTRUCTED)
        by_images = SpeedSource.CAR not in self.scale.sources
        if by_images and self._is_length_uncertain(step, cov6, dt_s) and Status.SCALE_INVALID not in status:
            status.append(Status.SCALE_INVALID)
        return self._record(frames, step, T_prev_curr, cov, status)

    def _is_length_uncertain(self, step: Pose, cov6: Floats, dt_s: float) -> bool:
        """Whether the corners do not determine the length of the step, however certain the scale is."""
        length_m = float(np.linalg.norm(step.p))
        along = step.p / max(length_m, 1e-9)
        sigma_m = math.sqrt(float(along @ cov6[:3, :3] @ along))
        return sigma_m > max(self.invalid_sigma_rel * length_m, _MIN_VAGUE_MPS * dt_s)

    def stationary(self, frames: tuple[int, int], unseen_m: float) -> Motion:
        """The record of a zero-velocity update; no standstill if `unseen_m`, 1-sigma of invisible motion, is > 0."""
        cov = stationary_cov(self.config)
        cov[0, 0] += unseen_m**2
        return self._record(frames, NO_MOTION, SE2(), cov, [] if unseen_m else [Status.STANDSTILL])

    def coasted(self, frames: tuple[int, int], dt_s: float, status: list[Status], car: CarMotion | None) -> Motion:
        """The record of a prediction by the motion model, or by wheel odometry if `car` is given."""
        if car is not None:
            return self._by_wheel_odometry(frames, dt_s, status, car)
        step = self.model.predict(dt_s)
        T_prev_curr = planar(step, self.scale.ground)
        cov = coasting_cov(self.config, T_prev_curr, dt_s, self.model.known, self.scale.sigma_rel)
        return self._record(frames, step, T_prev_curr, cov, [*status, Status.ODOMETRY_COASTING])

    def _by_wheel_odometry(self, frames: tuple[int, int], dt_s: float, status: list[Status], car: CarMotion) -> Motion:
        """The record of a motion by the car's own speed."""
        if car.yaw_rad is None:
            status = [*status, Status.ODOMETRY_COASTING]
        last_radps = planar(self.model.predict(1.0), self.scale.ground).yaw_rad
        T_prev_curr, cov = wheel_odometry(self.config, car, last_radps, dt_s, self.camera_ahead_m)
        step = on_plane(T_prev_curr, self.scale.ground)
        return self._record(frames, step, T_prev_curr, cov, status, car.sigma_rel)

    def _record(
        self,
        frames: tuple[int, int],
        step: Pose,
        T_prev_curr: SE2,
        cov: Floats,
        status: list[Status],
        car_sigma_rel: float | None = None,
    ) -> Motion:
        """`car_sigma_rel` is the relative 1-sigma of the scale if the motion is by the car's own speed alone."""
        scale, sources = self.scale, self.scale.sources
        if car_sigma_rel is not None:
            sources = (SpeedSource.CAR,)
        elif Status.ODOMETRY_COASTING in status:
            sources = (SpeedSource.CARRIED,)
        if car_sigma_rel is None and scale.is_unknown and Status.SCALE_INVALID not in status:
            status = [*status, Status.SCALE_INVALID]  # stationary or coasting at an unknown scale
        return Motion(
            from_frame=frames[0],
            to_frame=frames[1],
            R_prev_curr=step.R,
            t_prev_curr_m=step.p,
            T_prev_curr=T_prev_curr,
            cov=cov,
            scale_sigma_rel=scale.sigma_rel if car_sigma_rel is None else car_sigma_rel,
            ground=scale.ground,
            tilt_cov=scale.tilt_cov,
            standstill=Status.STANDSTILL in status,
            status=(*status, *scale.car_status()),
            speed_sources=sources,
        )


def wheel_odometry(
    config: MotionConfig, car: CarMotion, last_yaw_rate_radps: float, dt_s: float, camera_ahead_m: float
) -> tuple[SE2, Floats]:
    """T_prev_curr of the camera over `dt_s` and its covariance (3, 3), by wheel odometry about the rear axle.

    Without a yaw rate of the car the last one decays. The camera is `camera_ahead_m` in front of the rear axle.
    """
    yaw_rad, yaw_sigma_rad = car.yaw_rad, car.yaw_sigma_rad
    if yaw_rad is None:
        yaw_rad = last_yaw_rate_radps * config.yaw_rate_decay_s * (1.0 - math.exp(-dt_s / config.yaw_rate_decay_s))
        yaw_sigma_rad = 0.5 * config.coast_yaw_acceleration_radps2 * dt_s**2 + config.coast_yaw_rate_radps * dt_s
    T_prev_curr = SE2.exp(np.array([car.forward_m, camera_ahead_m * yaw_rad, yaw_rad]))
    return T_prev_curr, car_cov(config, T_prev_curr, car.sigma_m, car.sigma_rel, yaw_sigma_rad)
