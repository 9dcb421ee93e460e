"""Priors of `parallax.Parallax`: how vehicles move and stop, and how long the errors of boxes last."""

from __future__ import annotations

from typing import Annotated

import msgspec


class ParallaxConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How vehicles move and stop, and how long the errors of a detector last; docs/constants.md has the data."""

    standing: float = 0.3  # of the vehicles, when first seen; those that drive are the rest
    unusual: float = 0.03  # that stand and are of no usual size
    creeping: float = 0.3  # of the vehicles, when first seen: slowly, along their heading
    crossing: float = 0.05  # of the vehicles, when first seen: they drive in any direction
    sigma_unusual_rel: float = 0.3  # of their height
    sigma_creep_mps: float = 2.0  # 1-sigma of a creeping vehicle's velocity
    sigma_drive_mps: float = 10.0  # 1-sigma of a driving vehicle's velocity
    road_half_width_m: float = 10.0  # what moves farther aside than that may do so in any direction
    sigma_across_rel: float = 0.1  # of it across the vehicle's heading, as a fraction
    sigma_across_mps: float = 0.3  # and beside it
    stands_for_s: float = 60.0  # on average, until it starts to creep
    creeps_for_s: float = 10.0  # until it stops, or drives
    drives_for_s: float = 20.0  # until it creeps
    change_mps: float = 2.0  # 1-sigma by which the velocity of a vehicle that moves changes within a second
    change_across_mps: float = 0.5  # the same across its heading
    outline_drift_rel: float = 0.03  # of the outline's width, in a second: the yaw is not known as well
    box_memory_s: float = 0.5  # for so long a box has the same error: this time counts as one box
    view_memory_s: float = 1.5  # the same of the face that its edges lie at
    sigma_scale_rel: float = 0.02  # of the odometry's metres
    sigma_tilt_rad: float = 0.004  # of the road at a vehicle against the ego's
    tilt_memory_s: float = 5.0  # how long that lasts
    sigma_kerb_m: float = 0.06  # how far the road under a vehicle in the ego's lane lies off the ego's plane
    sigma_crown_rad: float = 0.007  # and the more the farther it stands to the side
    sigma_bank_per_m: float = 0.001  # and more, by the square of that: what stands far aside is on another road
    sigma_face_m: float = 1.0  # edges of a box lie not all at its nearest face, and on others as it turns
    path_half_width_m: float = 1.75  # of the ego's path, half a lane: there growth is the closing gap's, of any size
    # Of the left sides of boxes, and of the right: hidden, or a neighbour's (side_outliers.py)
    side_outlier: Annotated[float, msgspec.Meta(ge=0.0, le=0.3)] = 0.03
    side_outlier_memory_s: Annotated[float, msgspec.Meta(gt=0.0)] = 0.15  # how long one lasts
    sigma_side_outlier_rel: float = 0.3  # of the box's width
    gate_sigma: float = 3.0  # past it of all filters a measurement is an outlier: its noise is raised
    own_for_s: float = 5.0  # on average, until boxes are those of a neighbour of the track's vehicle
    another_for_s: float = 0.5  # until that neighbour is the track's vehicle
    sigma_another_rel: float = 0.15  # how far off it stands along the line of sight: a row of parked vehicles
    sigma_another_m: float = 1.0  # and across it
    sigma_another_size_rel: float = 0.1  # how much its size differs
