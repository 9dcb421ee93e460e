"""The record of each motion: measured, stationary, predicted, or by wheel odometry alone; with what is wrong."""

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

_VAGUE_MPS = 1.0  # of a speed, 1-sigma: a car that creeps may know its steps to a half


@dataclass(frozen=True)
class MotionRecords:
    """Reads the metric scale and the motion model, and changes neither."""

    config: MotionConfig
    camera_ahead_m: float  # of the rear axle
    scale: MetricScale
    model: MotionModel
    invalid_sigma_rel: float  # of a length: no better known, it is not to be driven by

    def measured(
        self, frames: tuple[int, int], step: Pose, cov6: Floats, obstructed: bool, dt_s: float, earlier_m: float
    ) -> Motion:
        """Of a step T_prev_curr in metres over `dt_s` with covariance (6, 6); `obstructed`: corners were left out.

        So much as `earlier_m` of it may be of the images before, in which nothing was seen to move.
        """
        T_prev_curr = planar(step, self.scale.ground)
        cov = measured_cov(self.config, cov6, T_prev_curr, self.scale.ground, self.scale.sigma_rel)
        cov[0, 0] += earlier_m**2
        status = self.scale.status()
        if obstructed and Status.VIEW_OBSTRUCTED not in status:
            status.append(Status.VIEW_OBSTRUCTED)
        by_images = SpeedSource.CAR not in self.scale.sources
        if by_images and self._is_vague(step, cov6, dt_s) and Status.SCALE_INVALID not in status:
            status.append(Status.SCALE_INVALID)
        return self._record(frames, step, T_prev_curr, cov, status)

    def _is_vague(self, step: Pose, cov6: Floats, dt_s: float) -> bool:
        """Whether the corners leave the step's own length unknown, however well the scale is known."""
        length_m = float(np.linalg.norm(step.p))
        along = step.p / max(length_m, 1e-9)
        sigma_m = math.sqrt(float(along @ cov6[:3, :3] @ along))
        return sigma_m > max(self.invalid_sigma_rel * length_m, _VAGUE_MPS * dt_s)

    def standing(self, frames: tuple[int, int], unseen_m: float) -> Motion:
        """Of a zero-velocity update; no standstill with `unseen_m`, 1-sigma of a motion that was not seen."""
        cov = stationary_cov(self.config)
        cov[0, 0] += unseen_m**2
        return self._record(frames, NO_MOTION, SE2(), cov, [] if unseen_m else [Status.STANDSTILL])

    def coasted(self, frames: tuple[int, int], dt_s: float, status: list[Status], car: CarMotion | None) -> Motion:
        """The motion model's prediction, or wheel odometry where the car reports its speed."""
        if car is not None:
            return self._by_wheels(frames, dt_s, status, car)
        step = self.model.predict(dt_s)
        T_prev_curr = planar(step, self.scale.ground)
        cov = coasting_cov(self.config, T_prev_curr, dt_s, self.model.known, self.scale.sigma_rel)
        return self._record(frames, step, T_prev_curr, cov, [*status, Status.ODOMETRY_COASTING])

    def _by_wheels(self, frames: tuple[int, int], dt_s: float, status: list[Status], car: CarMotion) -> Motion:
        """The motion by the car's own speed; without its yaw rate the last turn decays."""
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
        """`car_sigma_rel`: 1-sigma of the metres where they are the car's alone."""
        scale, sources = self.scale, self.scale.sources
        if car_sigma_rel is not None:
            sources = (SpeedSource.CAR,)
        elif Status.ODOMETRY_COASTING in status:
            sources = (SpeedSource.CARRIED,)
        if car_sigma_rel is None and scale.unknown and Status.SCALE_INVALID not in status:
            status = [*status, Status.SCALE_INVALID]  # stationary or coasting, in an unknown scale
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
    """T_prev_curr of the camera over `dt_s` and its covariance (3, 3), of a car that rolls on its rear axle.

    Without the car's yaw rate the last one decays. The camera is `camera_ahead_m` in front of the rear axle.
    """
    yaw_rad, yaw_sigma_rad = car.yaw_rad, car.yaw_sigma_rad
    if yaw_rad is None:
        yaw_rad = last_yaw_rate_radps * config.yaw_rate_decay_s * (1.0 - math.exp(-dt_s / config.yaw_rate_decay_s))
        yaw_sigma_rad = 0.5 * config.coast_yaw_acceleration_radps2 * dt_s**2 + config.coast_yaw_rate_radps * dt_s
    T_prev_curr = SE2.exp(np.array([car.forward_m, camera_ahead_m * yaw_rad, yaw_rad]))
    return T_prev_curr, car_cov(config, T_prev_curr, car.sigma_m, car.sigma_rel, yaw_sigma_rad)
