"""Priors of people and of the road under them: sizes, motion, correlated errors."""

from __future__ import annotations

import msgspec

from birdslam.road_users.people.people_boxes import PEDESTRIAN


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
    """Priors of people and of the road under them, and correlation of the errors of boxes."""

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
    standing: float = 0.2  # initial probability of standing
    stands_for_s: float = 10.0  # mean duration
    moves_for_s: float = 10.0  # mean duration
    crossing: float = 0.3  # fraction of moving people in any direction
    turns_after_s: float = 10.0  # mean time between changes of direction
    stop_mps: float = 0.08  # 1-sigma of the velocity of a standing person
    sigma_tilt_rad: float = 0.009  # of the road at a person relative to the ego, beyond the front end's sigma
    tilt_drift_rad: float = 0.003  # and its change within a second as people walk
    sigma_roll_rad: float = 0.01  # of the front end's roll, per unit of y/x
    sigma_kerb_m: float = 0.1  # 1-sigma of the ground offset under a person
    hidden_share: float = 0.3  # mean hidden fraction of the height with hidden feet
    sigma_hidden_share: float = 0.35  # 1-sigma of it
    box_memory_s: float = 0.4  # correlation time of the errors of a box
    width_memory_s: float = 5.0  # correlation time of its width
    outline_memory_s: float = 2.0  # correlation time of its systematic vertical errors
    sigma_outline_rel: float = 0.06  # 1-sigma of them, of the height

    def sizes(self, label: str) -> Sizes:
        """The parameters of a label."""
        return self.pedestrian if label == PEDESTRIAN else self.cyclist
