"""What is known of how vehicles move, and of how a detector errs about them, before any was seen."""

from __future__ import annotations

from typing import Annotated

import msgspec


class ParallaxConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How vehicles move and stop, and how long a detector errs alike.

    What is said of their road (tilt, kerb, bank, its width) and of moving across was chosen among two to four values
    each on KITTI tracking 0001, 0005 and 0020 by RRC's boxes, and on 0005's images by YOLOX-nano's.
    """

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
    box_memory_s: float = 0.5  # a box errs in the next frame as in this: this time counts as one box
    view_memory_s: float = 1.5  # and so does, for longer, what is taken for the nearest face
    sigma_scale_rel: float = 0.02  # of the odometry's metres
    sigma_tilt_rad: float = 0.004  # of the road at a vehicle against the ego's
    tilt_memory_s: float = 5.0  # how long that lasts
    sigma_kerb_m: float = 0.06  # how far the road under a vehicle in the ego's lane lies off the ego's plane
    sigma_crown_rad: float = 0.007  # and the more the farther it stands to the side
    sigma_bank_per_m: float = 0.001  # and more, by the square of that: what stands far aside is on another road
    sigma_face_m: float = 1.0  # edges of a box lie not all at its nearest face, and on others as it turns
    path_half_width_m: float = 1.75  # of the ego's path: half a lane
    # Of the left sides of boxes, and of the right: hidden, or a neighbour's (side_outliers.py). Of the sides of KITTI
    # tracking 0005's cars by YOLOX-nano, vehicle-detection-adas-0002 and the shipped network 0.031, 0.025 and 0.055 lie
    # 15 % of the width or more inside of the label's hull; by RRC 0.002 of those of 0000 to 0020
    side_outlier: Annotated[float, msgspec.Meta(ge=0.0, le=0.3)] = 0.03
    # How long one lasts: of those of YOLOX-nano, vehicle-detection-adas-0002 and the shipped network on KITTI tracking
    # 0005's images 0.46, 0.53 and 0.69 are there 0.1 s later
    side_outlier_memory_s: Annotated[float, msgspec.Meta(gt=0.0)] = 0.15
    sigma_side_outlier_rel: float = 0.3  # of the box's width; those that lie so far off: 0.31, 0.21, 0.25 (RMS)
    gate_sigma: float = 3.0  # past it of all filters a measurement is an outlier: its noise is raised
