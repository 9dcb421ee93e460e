"""A road user as the lanes see it: where it is in ego, and which way it goes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.se2 import SE2
from birdslam.types import FollowedPerson

SLOW_MPS = 1.0  # below it a road user may stand, and a time gap is no number
DRIVES_MPS = 3.0  # slower vehicles park, turn or cross
STANDS = 0.9  # so probably it stands, as graph/standing.py decides
KNOWN_YAW_RAD = 0.6  # 1-sigma of a direction
MOVES_SIGMAS = 2.0  # so surely it drives


@dataclass(frozen=True)
class UserInEgo:
    """A road user in ego: its pose, covariance (3, 3), length, speed along its heading, probability that it stands."""

    vehicle: int
    T_ego_vehicle: SE2
    cov: Floats
    length_m: float
    speed_mps: float
    speed_sigma_mps: float = 0.0
    standing: float = 0.0
    walks: bool = False  # a pedestrian, who keeps to no direction of traffic and leads nobody

    @property
    def drives(self) -> float:
        """The probability that it moves."""
        return 1.0 if abs(self.speed_mps) > SLOW_MPS else 1.0 - self.standing

    @property
    def surely_drives(self) -> bool | None:
        """Whether it drives; None while this is undecided."""
        if abs(self.speed_mps) >= max(DRIVES_MPS, MOVES_SIGMAS * self.speed_sigma_mps):
            return True
        return False if self.standing >= STANDS else None

    @property
    def cos_along(self) -> float | None:
        """Cosine of the angle between its direction and the ego's; None where it is not known.

        A box looks the same from behind, so only a vehicle driving forward along its yaw has a known direction: a new
        vehicle that seems to drive fast backwards has the wrong yaw or the wrong speed.
        """
        least_mps = max(DRIVES_MPS, MOVES_SIGMAS * self.speed_sigma_mps)
        if self.speed_mps < least_mps or self.cov[2, 2] > KNOWN_YAW_RAD**2:
            return None
        return math.cos(self.T_ego_vehicle.yaw_rad)


def person_in_ego(person: FollowedPerson) -> UserInEgo:
    """Somebody on foot or on a bicycle, who heads where they move."""
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
    walks = person.label != "cyclist"
    return UserInEgo(person.person, pose, cov, person.length_m, speed_mps, sigma_mps, person.standing, walks)
