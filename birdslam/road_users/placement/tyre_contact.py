"""Correction of the lower edge of a box from the tyres to the nearest face.

Eq. 1 on the edge gives the depth of the nearest tyre, an overhang behind the bumper. Cuboid labels, and detectors
trained on them, end at the road under the bumper instead.
"""

from __future__ import annotations

import math

import msgspec

from birdslam.road_users.placement.localisation import LocalisationConfig, Observation


def bottom_at_face(seen: Observation, yaw_rad: float, height_m: float, config: LocalisationConfig) -> Observation:
    """Moves the bottom of a box that ends at the tyres to its nearest face on the road.

    `yaw_rad` is the vehicle's in ego, `height_m` the camera height H. At the slope s of the lower edge, the tyre is at
    H / s and the face an overhang nearer. At short range the lower edge of the bumper, at clearance c, is the lowest
    visible point, and the face is at (H - c) / s.
    """
    slope = seen.slope_bottom
    if not seen.is_bottom_at_tyres or slope <= 0.0:
        return seen
    overhang_m = config.overhang_rel * seen.dimensions.length_m * abs(math.cos(yaw_rad))
    clearance_m = min(config.clearance_m, height_m / 2.0)  # limited for very low cameras
    under_bumper = overhang_m * slope < clearance_m
    lower = 1.0 / (1.0 - min(overhang_m * slope, clearance_m) / height_m)
    by_slope = lower**2 if under_bumper else lower  # derivative of the face's slope by that of the edge
    return msgspec.structs.replace(
        seen,
        slope_bottom=slope * lower,
        sigma_bottom=seen.sigma_bottom * by_slope,
        sigma_cut=None if seen.sigma_cut is None else seen.sigma_cut * by_slope,
        is_bottom_at_tyres=False,
    )
