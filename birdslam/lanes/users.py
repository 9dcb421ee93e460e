"""A road user as the lanes use it: its pose in ego, speed and direction of travel."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.se2 import SE2
from birdslam.types import FollowedPerson

SLOW_MPS = 1.0  # a slower road user may be stationary, and its time gap is undefined
MIN_MOVING_MPS = 3.0  # slower vehicles park, turn or cross
MIN_STATIONARY = 0.9  # min. probability of a stationary user, as in graph/standing.py
MAX_YAW_SIGMA_RAD = 0.6  # max. 1-sigma of a known direction
MIN_MOVING_SIGMAS = 2.0  # min. ratio of speed to its sigma for a moving user


@dataclass(frozen=True)
class UserInEgo:
    """A road user in ego: pose, covariance (3, 3), length, speed along its heading, probability of being stationary."""

    vehicle: int
    T_ego_vehicle: SE2
    cov: Floats
    length_m: float
    speed_mps: float
    speed_sigma_mps: float = 0.0
    standing: float = 0.0
    is_pedestrian: bool = False  # a pedestrian: has no direction of traffic and is never the leader

    @property
    def moving(self) -> float:
        """The probability that it moves."""
        return 1.0 if abs(self.speed_mps) > SLOW_MPS else 1.0 - self.standing

    @property
    def is_moving(self) -> bool | None:
        """Whether it moves; None if undecided."""
        if abs(self.speed_mps) >= max(MIN_MOVING_MPS, MIN_MOVING_SIGMAS * self.speed_sigma_mps):
            return True
        return False if self.standing >= MIN_STATIONARY else None

    @property
    def cos_along(self) -> float | None:
        """Cosine of the angle between its direction and the ego's; None if unknown.

        Front and back of a vehicle look alike, so the direction is known only of a vehicle that moves forward along
        its yaw: a new vehicle with a large negative speed has the wrong yaw or the wrong speed.
        """
        min_mps = max(MIN_MOVING_MPS, MIN_MOVING_SIGMAS * self.speed_sigma_mps)
        if self.speed_mps < min_mps or self.cov[2, 2] > MAX_YAW_SIGMA_RAD**2:
            return None
        return math.cos(self.T_ego_vehicle.yaw_rad)


def person_in_ego(person: FollowedPerson) -> UserInEgo:
    """A pedestrian or cyclist; the heading is the direction of motion."""
    vx, vy = person.vx_mps, person.vy_mps
    speed_mps = math.hypot(vx, vy)
    xx, xy, yx, yy = person.velocity_cov
    unit_mps = max(speed_mps, SLOW_MPS)
    across_x, across_y = -vy / unit_mps, vx / unit_mps
    across = across_x * (xx * across_x + xy * across_y) + across_y * (yx * across_x + yy * across_y)
    cov = np.zeros((3, 3))
    cov[0, 0], cov[0, 1], cov[1, 0], cov[1, 1] = person.cov
    cov[2, 2] = across / max(speed_mps, 1e-3) ** 2
    pose = SE2(person.x_m, person.y_m, math.atan2(vy, vx))
    sigma_mps = math.sqrt(max(xx, yy, 0.0))
    is_pedestrian = person.label != "cyclist"
    return UserInEgo(person.person, pose, cov, person.length_m, speed_mps, sigma_mps, person.standing, is_pedestrian)
