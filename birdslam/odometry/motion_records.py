"""The record of each motion: measured, standing, coasting, or by the car's own readings alone; with what is wrong."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.pose import Pose
from birdslam.geometry.se2 import SE2
from birdslam.odometry.metric_scale import MetricScale
from birdslam.odometry.motion import (
    Motion,
    MotionConfig,
    coasting_cov,
    measured_cov,
    on_plane,
    planar,
    standing_cov,
)
from birdslam.odometry.motion_model import STILL, LastMotion
from birdslam.odometry.speed.dead_reckoning import reckoned
from birdslam.odometry.speed.scale import CarStep
from birdslam.types import SpeedSource, Status

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class MotionRecords:
    """Reads the metric scale and the last motion, and changes neither."""

    config: MotionConfig
    camera_ahead_m: float  # of the rear axle
    scale: MetricScale
    last: LastMotion

    def measured(self, frames: tuple[int, int], step: Pose, cov6: Floats, obstructed: bool) -> Motion:
        """Of a step T_prev_curr in metres with covariance (6, 6); `obstructed`: corners on the glass were left out."""
        T_prev_curr = planar(step, self.scale.ground)
        cov = measured_cov(self.config, cov6, T_prev_curr, self.scale.ground, self.scale.sigma_rel)
        status = self.scale.status()
        if obstructed and Status.VIEW_OBSTRUCTED not in status:
            status.append(Status.VIEW_OBSTRUCTED)
        return self._record(frames, step, T_prev_curr, cov, status)

    def standing(self, frames: tuple[int, int]) -> Motion:
        """Of a pose that is held."""
        return self._record(frames, STILL, SE2(), standing_cov(self.config), [Status.STANDSTILL])

    def coasted(self, frames: tuple[int, int], dt_s: float, status: list[Status], car: CarStep | None) -> Motion:
        """The last velocity goes on, or what the car itself says of its motion."""
        if car is not None:
            return self._reckoned(frames, dt_s, status, car)
        step = self.last.over(dt_s)
        T_prev_curr = planar(step, self.scale.ground)
        cov = coasting_cov(self.config, T_prev_curr, dt_s, self.last.known, self.scale.sigma_rel)
        return self._record(frames, step, T_prev_curr, cov, [*status, Status.ODOMETRY_COASTING])

    def _reckoned(self, frames: tuple[int, int], dt_s: float, status: list[Status], car: CarStep) -> Motion:
        """The motion by the car's own readings; without its yaw rate the last turn fades out."""
        if car.yaw_rad is None:
            status = [*status, Status.ODOMETRY_COASTING]
        last_radps = planar(self.last.over(1.0), self.scale.ground).yaw_rad
        T_prev_curr, cov = reckoned(self.config, car, last_radps, dt_s, self.camera_ahead_m)
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
        """`car_sigma_rel` is of the metres where they are the car's alone."""
        scale, sources = self.scale, self.scale.sources
        if car_sigma_rel is not None:
            sources = (SpeedSource.CAR,)
        elif Status.ODOMETRY_COASTING in status:
            sources = (SpeedSource.CARRIED,)
        if car_sigma_rel is None and scale.unknown and Status.SCALE_INVALID not in status:
            status = [*status, Status.SCALE_INVALID]  # standing or coasting, in metres that nobody knows
        return Motion(
            from_frame=frames[0],
            to_frame=frames[1],
            R_prev_curr=step.R,
            t_prev_curr_m=step.p,
            T_prev_curr=T_prev_curr,
            cov=cov,
            scale_sigma_rel=scale.sigma_rel if car_sigma_rel is None else car_sigma_rel,
            ground=scale.ground,
            pitch_sigma_rad=scale.pitch_sigma_rad,
            standstill=Status.STANDSTILL in status,
            status=(*status, *scale.car_status()),
            speed_sources=sources,
        )
