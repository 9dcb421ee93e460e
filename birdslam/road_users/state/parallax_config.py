"""Parameters of `parallax.Parallax`: motion modes of vehicles, and correlation of the errors of boxes."""

from __future__ import annotations

from typing import Annotated

import msgspec

STANDING_RATIO = 0.3  # initial probability: stationary
UNUSUAL_RATIO = 0.03  # initial probability: stationary, with an unusual size
CREEPING_RATIO = 0.3  # initial probability: slow, along the heading
CROSSING_RATIO = 0.05  # initial probability: in any direction
SIGMA_UNUSUAL_REL = 0.3  # of the height
SIGMA_CREEP_MPS = 2.0  # 1-sigma of a creeping vehicle's velocity
SIGMA_DRIVE_MPS = 10.0  # 1-sigma of a driving vehicle's velocity
ROAD_HALF_WIDTH_M = 10.0  # lateral distance beyond which vehicles move in any direction
SIGMA_ACROSS_REL = 0.1  # 1-sigma of the lateral velocity, of that along the heading
SIGMA_ACROSS_MPS = 0.3  # and a constant part
STANDS_FOR_S = 60.0  # mean duration
CREEPS_FOR_S = 10.0  # mean duration
DRIVES_FOR_S = 20.0  # mean duration
CHANGE_MPS = 2.0  # 1-sigma of the change of velocity within a second
CHANGE_ACROSS_MPS = 0.5  # the same across the heading
OUTLINE_DRIFT_REL = 0.03  # of the width of the outline, within a second
SIGMA_TILT_RAD = 0.004  # of the road at a vehicle relative to the ego
SIGMA_KERB_M = 0.06  # ground offset under a vehicle from the ego's plane
SIGMA_CROWN_RAD = 0.007  # and its growth with the lateral distance
SIGMA_BANK_PER_M = 0.001  # and with the square of it
PATH_HALF_WIDTH_M = 1.75  # of the ego's path, in which growth is ambiguous
SIDE_OUTLIER_MEMORY_S = 0.15  # correlation time of outlying sides of boxes
SIGMA_SIDE_OUTLIER_REL = 0.3  # of the width of the box
GATE_SIGMA = 3.0  # beyond it in all filters, the noise of a measurement is raised
ANOTHER_FOR_S = 0.5  # mean time until that neighbour is the track's vehicle
SIGMA_ANOTHER_REL = 0.15  # of its position along the line of sight
SIGMA_ANOTHER_M = 1.0  # and across it
SIGMA_ANOTHER_SIZE_REL = 0.1  # of its size


class ParallaxConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Correlated errors of boxes; docs/constants.md lists the tuned ones."""

    box_memory_s: float = 0.5  # correlation time of the errors of a box
    view_memory_s: float = 1.5  # correlation time of the depth of the faces at its edges
    sigma_scale_rel: float = 0.02  # of the odometry's scale
    sigma_face_m: float = 1.0  # of the depth of the faces at a box's edges
    # Probability that the left side of a box is an outlier, and the right (side_outliers.py)
    side_outlier: Annotated[float, msgspec.Meta(ge=0.0, le=0.3)] = 0.03
    own_for_s: float = 5.0  # mean time until the boxes are those of a neighbour
