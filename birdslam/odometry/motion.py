"""One ego-motion: the camera's motion in space, the ego's motion on the road, and its covariance."""

from __future__ import annotations

import math
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import GroundPlane
from birdslam.geometry.pose import Pose
from birdslam.geometry.se2 import SE2
from birdslam.types import SpeedSource, Status

Floats = NDArray[np.float64]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]

_MAX_SLIP_RATIO = 0.25  # lateral over longitudinal: 5 degrees of camera yaw, and as much sideslip
_MAX_AHEAD_M = 2.5  # a bus's camera is farther in front of the rear axle than a passenger car's by up to this
_SLIP_NOISE_M = 0.05  # lateral noise of the visual motion
_UNEVEN_ROWS = 0.08  # distance of the corners from the middle row, over the image height


class MotionConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The uncertainty of a motion: measured, stationary, or coasting."""

    covariance_inflation: Positive = 4.0  # of variances: errors of neighbouring corners are correlated
    # At night, beside covariance_inflation: corners lie on the glow of lamps and move with the car's headlights
    night_inflation: Positive = 8.0
    sigma_direction_rad: Positive = 0.0035  # 1-sigma of the direction of travel
    sigma_floor_m: Positive = 0.001  # minimum 1-sigma of a motion
    sigma_floor_rad: Positive = 0.0001  # minimum 1-sigma of a turn
    sigma_turn_rel: Positive = 0.01  # 1-sigma proportional to the turn: focal lengths are known to a percent
    stationary_sigma_m: Positive = 0.0005  # 1-sigma of a zero-velocity update
    stationary_sigma_rad: Positive = 0.0001  # 1-sigma of a zero-velocity update
    coast_acceleration_mps2: Positive = 3.0  # 1-sigma while coasting
    coast_yaw_acceleration_radps2: Positive = 0.5  # 1-sigma while coasting
    coast_speed_mps: Positive = 0.3  # 1-sigma of the last measured speed
    coast_yaw_rate_radps: Positive = 0.01  # 1-sigma of the last measured yaw rate
    unknown_speed_mps: Positive = 10.0  # 1-sigma before a speed was measured
    yaw_rate_decay_s: Positive = 1.0  # decay of the last yaw rate while coasting on a speed without yaw rate


class Motion(msgspec.Struct, frozen=True):
    """The camera's motion between two images, in metres; `from_frame` is the last frame with a measured motion.

    R_prev_curr (3, 3) and t_prev_curr_m (3,) are in camera axes (x right, y down, z forward), p_prev = R p_curr + t.
    T_prev_curr is the same motion on the road plane (REP-103); `cov` (3, 3) is the covariance of its tangent (x_m, y_m,
    yaw_rad) and includes the scale uncertainty. `ground` is the current camera over the road; `tilt_cov` (2, 2) is the
    covariance of its pitch and roll.
    """

    from_frame: int
    to_frame: int
    R_prev_curr: Floats
    t_prev_curr_m: Floats
    T_prev_curr: SE2
    cov: Floats
    scale_sigma_rel: float
    ground: GroundPlane
    tilt_cov: Floats
    standstill: bool
    status: tuple[Status, ...]
    speed_sources: tuple[SpeedSource, ...] = ()

    @property
    def pitch_sigma_rad(self) -> float:
        """1-sigma of the ground's pitch."""
        return math.sqrt(float(self.tilt_cov[0, 0]))


def planar(step: Pose, ground: GroundPlane) -> SE2:
    """The ego's motion on the road, from T_prev_curr of the camera and the ground under the current camera."""
    to_ego = ground.R_ego_cam @ step.R.T  # previous camera axes to current ego axes
    forward_prev = to_ego[:, 2]
    yaw = -math.atan2(forward_prev[1], forward_prev[0])
    t = to_ego @ step.p
    c, s = math.cos(yaw), math.sin(yaw)
    return SE2(float(c * t[0] - s * t[1]), float(s * t[0] + c * t[1]), yaw)


def on_plane(motion: SE2, ground: GroundPlane) -> Pose:
    """T_prev_curr of the camera, from the ego's motion on the road; the inverse of `planar` at constant tilt."""
    R, (c, s) = ground.R_ego_cam, (math.cos(motion.yaw_rad), math.sin(motion.yaw_rad))
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return Pose(R.T @ turn @ R, R.T @ np.array([motion.x_m, motion.y_m, 0.0]))


def violates_nonholonomic(T_prev_curr: SE2, camera_ahead_m: float) -> bool:
    """Whether a motion of a moving car violates the nonholonomic constraint (no lateral slip).

    Corners on lights or noise at night, and on a dirty windscreen, give such motions.
    """
    forward_m, side_m, yaw_rad = T_prev_curr.log()
    limit_m = _MAX_SLIP_RATIO * abs(forward_m) + _MAX_AHEAD_M * abs(yaw_rad) + _SLIP_NOISE_M
    return bool(abs(side_m - camera_ahead_m * yaw_rad) > limit_m)


def step_cov(config: MotionConfig, info: Floats) -> Floats:
    """(6, 6) covariance of the camera's step from its information, of (translation, rotation) in camera axes."""
    return np.asarray(np.linalg.inv(info + np.eye(6) * 1e-3) * config.covariance_inflation, np.float64)


def uneven_cov(cov6: Floats, readout_s: float, change_radps: Floats) -> Floats:
    """Adds to a step's covariance (6, 6) the rotation error by a rolling shutter with readout time `readout_s`.

    `change_radps` (3,) is the change of the angular velocity since the last image. The correction of the rows assumes
    a constant angular velocity, which a vibrating mount violates.
    """
    out = cov6.copy()
    out[range(3, 6), range(3, 6)] += (_UNEVEN_ROWS * readout_s) ** 2 * float(change_radps @ change_radps)
    return out


def measured_cov(
    config: MotionConfig, cov6: Floats, motion: SE2, ground: GroundPlane, scale_sigma_rel: float
) -> Floats:
    """(3, 3) covariance of a measured motion, from that of the camera's step (`step_cov`)."""
    G = np.zeros((3, 6))
    G[:2, :3] = ground.R_ego_cam[:2]
    G[2, 3:] = ground.R_ego_cam[2]
    along, across = np.array([motion.x_m, motion.y_m, 0.0]), np.array([-motion.y_m, motion.x_m, 0.0])
    yaw = config.sigma_floor_rad**2 + (config.sigma_turn_rel * motion.yaw_rad) ** 2
    cov = G @ cov6 @ G.T + np.diag([config.sigma_floor_m**2, config.sigma_floor_m**2, yaw])
    cov += scale_sigma_rel**2 * np.outer(along, along) + config.sigma_direction_rad**2 * np.outer(across, across)
    out: Floats = 0.5 * (cov + cov.T)
    return out


def stationary_cov(config: MotionConfig) -> Floats:
    """(3, 3) covariance of a zero-velocity update; small, since all images of a stop share one reference image."""
    return np.diag([config.stationary_sigma_m**2, config.stationary_sigma_m**2, config.stationary_sigma_rad**2])


def car_cov(config: MotionConfig, motion: SE2, sigma_m: float, scale_sigma_rel: float, yaw_sigma_rad: float) -> Floats:
    """(3, 3) covariance of wheel odometry: errors of the distance, of the speed's scale factor and of the turn."""
    xy = np.array([motion.x_m, motion.y_m, 0.0])
    floor = config.sigma_floor_m**2
    sideways = floor + (config.sigma_direction_rad * math.hypot(motion.x_m, motion.y_m)) ** 2
    turn = np.array([-0.5 * motion.y_m, 0.5 * motion.x_m, 1.0])
    yaw = yaw_sigma_rad**2 + config.sigma_floor_rad**2
    out: Floats = np.diag([floor + sigma_m**2, sideways, 0.0]) + yaw * np.outer(turn, turn)
    return out + scale_sigma_rel**2 * np.outer(xy, xy)


def coasting_cov(
    config: MotionConfig, motion: SE2, dt_s: float, speed_known: bool, scale_sigma_rel: float
) -> Floats:  # fmt: skip
    """(3, 3) covariance of the motion model's prediction over `dt_s`, by unknown accelerations."""
    speed = config.coast_speed_mps if speed_known else config.unknown_speed_mps
    length = math.hypot(motion.x_m, motion.y_m)
    along = 0.5 * config.coast_acceleration_mps2 * dt_s**2 + speed * dt_s
    yaw = 0.5 * config.coast_yaw_acceleration_radps2 * dt_s**2 + config.coast_yaw_rate_radps * dt_s
    lateral = 0.2 * along + length * yaw
    xy = np.array([motion.x_m, motion.y_m, 0.0])
    out: Floats = np.diag([along**2, lateral**2, yaw**2 + config.sigma_floor_rad**2])
    return out + scale_sigma_rel**2 * np.outer(xy, xy)
