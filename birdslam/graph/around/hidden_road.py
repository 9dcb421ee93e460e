"""The parts of the road that vehicles hide from the camera.

The camera is above the origin of the ego. A vehicle of height h at a distance d along a ray hides the road behind it up
to the ray over its roof: d H / (H - h) for a camera height H, without limit if h >= H.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from operator import itemgetter

from birdslam.geometry.se2 import SE2
from birdslam.types import HiddenFan, RoadUser

MAX_DISTANCE_M = 40.0  # end of a fan
MIN_DISTANCE_M = 1.0  # of the nearest corner of a vehicle; nearer ones are beside the camera
USUAL_HEIGHT_M = 1.5  # of a vehicle of unknown height
MIN_M = 0.3  # minimum length of a fan


def hidden_fans(vehicles: Sequence[RoadUser], world: SE2, camera_m: float) -> tuple[HiddenFan, ...]:
    """Returns the fans of the vehicles ahead, nearest first; `world` is T_world_ego, `camera_m` the camera height."""
    back, origin = cmath.rect(1.0, -world.yaw_rad), complex(world.x_m, world.y_m)
    fans: list[tuple[float, HiddenFan]] = []
    for vehicle in vehicles:
        T = vehicle.T_world_vehicle
        at = (complex(T.x_m, T.y_m) - origin) * back
        away_m = abs(at)
        if at.real <= MIN_DISTANCE_M or away_m > MAX_DISTANCE_M or not vehicle.in_sight:
            continue
        ahead = cmath.rect(0.5 * vehicle.length_m, T.yaw_rad - world.yaw_rad)
        left = 1j * ahead * (vehicle.width_m / max(vehicle.length_m, MIN_M))
        if at.real - abs(ahead.real) - abs(left.real) <= MIN_DISTANCE_M:  # its nearest corner
            continue
        corners = at + ahead + left, at - ahead + left, at - ahead - left, at + ahead - left
        slopes = [c.imag / c.real for c in corners]  # in the order of the angles, since all lie ahead
        right, left = corners[slopes.index(min(slopes))], corners[slopes.index(max(slopes))]  # its outline
        right_m, left_m = abs(right), abs(left)
        over_m = camera_m - (vehicle.height_m or USUAL_HEIGHT_M)
        reach = camera_m / over_m if over_m > 0.0 else math.inf
        to_right, to_left = min(reach, MAX_DISTANCE_M / right_m), min(reach, MAX_DISTANCE_M / left_m)
        if (to_right - 1.0) * right_m > MIN_M and (to_left - 1.0) * left_m > MIN_M:
            beyond_right, beyond_left = right * to_right, left * to_left
            x_m = right.real, beyond_right.real, beyond_left.real, left.real
            y_m = right.imag, beyond_right.imag, beyond_left.imag, left.imag
            fans.append((away_m, HiddenFan(vehicle=vehicle.vehicle, x_m=x_m, y_m=y_m)))
    fans.sort(key=itemgetter(0))
    return tuple(fan for _, fan in fans)
