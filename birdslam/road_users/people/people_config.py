"""Priors of people and of the road under them: sizes, motion, correlated errors."""

from __future__ import annotations

import msgspec

from birdslam.road_users.people.people_boxes import PEDESTRIAN

STANDING_RATIO = 0.2  # initial probability of standing
STANDS_FOR_S = 10.0  # mean duration
MOVES_FOR_S = 10.0  # mean duration
CROSSING_RATIO = 0.3  # fraction of moving people in any direction
TURNS_AFTER_S = 10.0  # mean time between changes of direction
STOP_MPS = 0.08  # 1-sigma of the velocity of a standing person
SIGMA_TILT_RAD = 0.009  # of the road at a person relative to the ego, beyond the front end's sigma
TILT_DRIFT_RAD = 0.003  # and its change within a second as people walk
SIGMA_KERB_M = 0.1  # 1-sigma of the ground offset under a person
HIDDEN_SHARE = 0.3  # mean hidden fraction of the height with hidden feet
SIGMA_HIDDEN_SHARE = 0.35  # 1-sigma of it
BOX_MEMORY_S = 0.4  # correlation time of the errors of a box
WIDTH_MEMORY_S = 5.0  # correlation time of its width
OUTLINE_MEMORY_S = 2.0  # correlation time of its systematic vertical errors
SIGMA_OUTLINE_REL = 0.06  # 1-sigma of them, of the height


class Sizes(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Dimensions and motion of a class of people."""

    height_m: float  # mean of adults
    sigma_height_rel: float  # 1-sigma of it, beyond the common part of all people
    child_m: float  # mean of children
    sigma_child_rel: float  # 1-sigma of it
    child: float  # fraction of children
    width_m: float  # mean width of boxes
    sigma_width_rel: float  # 1-sigma of it
    length_m: float  # of the footprint
    footprint_m: float  # its width
    reach_m: float  # from the centre to the nearest foot or wheel, along the line of sight
    along_mps: float  # mean speed along the road
    sigma_along_mps: float  # 1-sigma of it
    sigma_beside_mps: float  # 1-sigma of the velocity across the road
    crossing_mps: float  # 1-sigma of the velocity in any direction
    change_mps: float  # 1-sigma of the change of velocity within a second
    foot_rel: float = 0.0  # mean margin of boxes below the feet, of the height
    head_rel: float = 0.0  # and above the head


class PeopleConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Priors of each class."""

    pedestrian: Sizes = Sizes(
        height_m=1.72,
        sigma_height_rel=0.051,
        child_m=1.2,
        sigma_child_rel=0.14,
        child=0.06,
        width_m=0.68,
        sigma_width_rel=0.3,
        length_m=0.7,
        footprint_m=0.6,
        reach_m=0.25,
        along_mps=1.3,
        sigma_along_mps=0.4,
        sigma_beside_mps=0.25,
        crossing_mps=1.1,
        change_mps=0.5,
        foot_rel=0.005,
        head_rel=0.02,
    )
    cyclist: Sizes = Sizes(  # with the rider
        height_m=1.74,
        sigma_height_rel=0.043,
        child_m=1.45,
        sigma_child_rel=0.107,
        child=0.06,
        width_m=0.9,
        sigma_width_rel=0.5,
        length_m=1.75,
        footprint_m=0.6,
        reach_m=0.6,
        along_mps=4.5,
        sigma_along_mps=2.0,
        sigma_beside_mps=0.5,
        crossing_mps=4.0,
        change_mps=1.2,
    )

    def sizes(self, label: str) -> Sizes:
        """The parameters of a label."""
        return self.pedestrian if label == PEDESTRIAN else self.cyclist
