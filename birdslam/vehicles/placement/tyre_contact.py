"""The lower edge of a box that ends at a vehicle's tyres, moved to where the nearest face stands on the road.

Eq. 1 on the edge gives the depth of the nearest tyre, an overhang behind the bumper: 0.8 m behind the nearest face of a
car that is seen from its end, nothing of one from its side; 8 % at 10 m. Cuboid labels, and detectors that learned from
them, end at the road under the bumper.
"""

from __future__ import annotations

import math

import msgspec

from birdslam.vehicles.placement.localisation import LocalisationConfig, Observation


def bottom_at_face(seen: Observation, yaw_rad: float, height_m: float, config: LocalisationConfig) -> Observation:
    """The observation with the bottom that its nearest face has on the road, where its box ends at the tyres.

    `yaw_rad` is the vehicle's in ego, `height_m` the camera's (H) over the road. With the slope s of the lower edge the
    tyre is at H / s, the face an overhang nearer. Close by the camera no longer looks under the bumper: its lower edge,
    at the clearance c over the road, is then the lowest that is seen, and the face is at (H - c) / s.
    """
    slope = seen.slope_bottom
    if not seen.on_tyres or slope <= 0.0:
        return seen
    overhang_m = config.overhang_rel * seen.dimensions.length_m * abs(math.cos(yaw_rad))
    clearance_m = min(config.clearance_m, height_m / 2.0)  # a camera lower than that is on no car
    under_bumper = overhang_m * slope < clearance_m
    lower = 1.0 / (1.0 - min(overhang_m * slope, clearance_m) / height_m)
    by_slope = lower**2 if under_bumper else lower  # derivative of the face's slope by that of the edge
    return msgspec.structs.replace(
        seen,
        slope_bottom=slope * lower,
        sigma_bottom=seen.sigma_bottom * by_slope,
        sigma_cut=None if seen.sigma_cut is None else seen.sigma_cut * by_slope,
        on_tyres=False,
    )
