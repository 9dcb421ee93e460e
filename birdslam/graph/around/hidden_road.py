"""What the camera can't see of the road: the fans behind vehicles, out of which somebody could step.

The camera stands over the ego's origin. A vehicle of height h, whose outline is d away along a ray, hides the road
behind it as far as the ray over its roof goes: d H / (H - h) for a camera at H, or without end where it is as tall.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence

from birdslam.geometry.se2 import SE2
from birdslam.types import HiddenFan, RoadUser

FARTHEST_M = 40.0  # a fan ends there
NEAREST_M = 1.0  # a vehicle that begins nearer stands beside the camera
USUAL_HEIGHT_M = 1.5  # of a vehicle of unknown height
LEAST_M = 0.3  # a fan that is shorter hides nobody


def hidden_fans(vehicles: Sequence[RoadUser], world: SE2, camera_m: float) -> tuple[HiddenFan, ...]:
    """Of the vehicles ahead, the nearest first; `world` is T_world_ego, `camera_m` the camera's height."""
    back, origin = cmath.rect(1.0, -world.yaw_rad), complex(world.x_m, world.y_m)
    fans = []
    for vehicle in vehicles:
        T = vehicle.T_world_vehicle
        at, heading = (complex(T.x_m, T.y_m) - origin) * back, cmath.rect(1.0, T.yaw_rad - world.yaw_rad)
        if at.real <= NEAREST_M or abs(at) > FARTHEST_M or not vehicle.in_sight:
            continue
        ahead, left = heading * vehicle.length_m / 2.0, heading * 1j * vehicle.width_m / 2.0
        corners = [at + ahead + left, at - ahead + left, at - ahead - left, at + ahead - left]
        if min(c.real for c in corners) <= NEAREST_M:
            continue
        first, last = (pick(corners, key=cmath.phase) for pick in (min, max))  # its right and its left outline
        over_m = camera_m - (vehicle.height_m or USUAL_HEIGHT_M)
        reach = math.inf if over_m <= 0.0 else camera_m / over_m
        ends = [c * min(reach, FARTHEST_M / abs(c)) for c in (first, last)]
        if all(abs(e) > abs(c) + LEAST_M for e, c in zip(ends, (first, last), strict=True)):
            polygon = (first, ends[0], ends[1], last)
            x_m, y_m = tuple(c.real for c in polygon), tuple(c.imag for c in polygon)
            fans.append((abs(at), HiddenFan(vehicle=vehicle.vehicle, x_m=x_m, y_m=y_m)))
    return tuple(fan for _, fan in sorted(fans, key=lambda fan: fan[0]))
