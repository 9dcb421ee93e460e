"""Parameters of `parallax.Parallax`: motion modes of vehicles, and correlation of the errors of boxes."""

from __future__ import annotations

from typing import Annotated

import msgspec


class ParallaxConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Motion modes of vehicles and errors of boxes; docs/constants.md lists the tuned ones."""

    standing: float = 0.3  # initial probability: stationary
    unusual: float = 0.03  # initial probability: stationary, with an unusual size
    creeping: float = 0.3  # initial probability: slow, along the heading
    crossing: float = 0.05  # initial probability: in any direction
    sigma_unusual_rel: float = 0.3  # of the height
    sigma_creep_mps: float = 2.0  # 1-sigma of a creeping vehicle's velocity
    sigma_drive_mps: float = 10.0  # 1-sigma of a driving vehicle's velocity
    road_half_width_m: float = 10.0  # lateral distance beyond which vehicles move in any direction
    sigma_across_rel: float = 0.1  # 1-sigma of the lateral velocity, of that along the heading
    sigma_across_mps: float = 0.3  # and a constant part
    stands_for_s: float = 60.0  # mean duration
    creeps_for_s: float = 10.0  # mean duration
    drives_for_s: float = 20.0  # mean duration
    change_mps: float = 2.0  # 1-sigma of the change of velocity within a second
    change_across_mps: float = 0.5  # the same across the heading
    outline_drift_rel: float = 0.03  # of the width of the outline, within a second
    box_memory_s: float = 0.5  # correlation time of the errors of a box
    view_memory_s: float = 1.5  # correlation time of the depth of the faces at its edges
    sigma_scale_rel: float = 0.02  # of the odometry's scale
    sigma_tilt_rad: float = 0.004  # of the road at a vehicle relative to the ego
    tilt_memory_s: float = 5.0  # correlation time of it
    sigma_kerb_m: float = 0.06  # ground offset under a vehicle from the ego's plane
    sigma_crown_rad: float = 0.007  # and its growth with the lateral distance
    sigma_bank_per_m: float = 0.001  # and with the square of it
    sigma_face_m: float = 1.0  # of the depth of the faces at a box's edges
    path_half_width_m: float = 1.75  # of the ego's path, in which growth is ambiguous
    # Probability that the left side of a box is an outlier, and the right (side_outliers.py)
    side_outlier: Annotated[float, msgspec.Meta(ge=0.0, le=0.3)] = 0.03
    side_outlier_memory_s: Annotated[float, msgspec.Meta(gt=0.0)] = 0.15  # correlation time
    sigma_side_outlier_rel: float = 0.3  # of the width of the box
    gate_sigma: float = 3.0  # beyond it in all filters, the noise of a measurement is raised
    own_for_s: float = 5.0  # mean time until the boxes are those of a neighbour
    another_for_s: float = 0.5  # mean time until that neighbour is the track's vehicle
    sigma_another_rel: float = 0.15  # of its position along the line of sight
    sigma_another_m: float = 1.0  # and across it
    sigma_another_size_rel: float = 0.1  # of its size
