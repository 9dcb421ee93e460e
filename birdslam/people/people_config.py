"""What is known of people and of the road under them before a box is seen: sizes, ways of moving, errors that last."""

from __future__ import annotations

import msgspec

from birdslam.people.people_boxes import PEDESTRIAN

MIN_VARIANCE = 1e-6  # of a height that all share


class Sizes(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a kind of road user measures, and how it moves."""

    height_m: float  # mean of grown-ups
    sigma_height_rel: float  # 1-sigma of it
    child_m: float  # mean height of children
    sigma_child_rel: float  # 1-sigma of it
    child: float  # of them, are children
    width_m: float  # mean of boxes
    sigma_width_rel: float  # 1-sigma of it
    length_m: float  # of the footprint
    footprint_m: float  # its width
    reach_m: float  # from the centre to the nearest foot or wheel, along the line of sight
    along_mps: float  # speed of who moves along the road
    sigma_along_mps: float  # 1-sigma of it
    sigma_beside_mps: float  # 1-sigma of the velocity across it
    crossing_mps: float  # 1-sigma of the velocity of who moves anyhow
    change_mps: float  # 1-sigma by which a velocity changes within a second


class PeopleConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Priors of people and of the road under them, and how long the errors of a box last."""

    # Heights by KITTI tracking's labels, widths of boxes, how people walk; docs/constants.md has the data
    pedestrian: Sizes = Sizes(
        height_m=1.72,
        sigma_height_rel=0.075,
        child_m=1.2,
        sigma_child_rel=0.15,
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
    )
    cyclist: Sizes = Sizes(  # with the rider
        height_m=1.74,
        sigma_height_rel=0.07,
        child_m=1.45,
        sigma_child_rel=0.12,
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
    standing: float = 0.2  # of them stand when first seen
    stands_for_s: float = 10.0  # on average
    moves_for_s: float = 10.0  # until a stop
    crossing: float = 0.3  # of those who move
    turns_after_s: float = 10.0  # from one way of moving to another
    stop_mps: float = 0.08  # 1-sigma of the velocity of a standing person, who sways
    sigma_tilt_rad: float = 0.008  # of the road at somebody against the ego's, beside the front end's own sigma
    sigma_common_tilt_rad: float = 0.004  # of the road under all people against the front end's, beside its own sigma
    tilt_memory_s: float = 5.0  # of driving: how long that lasts
    tilt_drift_rad: float = 0.003  # and by how much it changes within a second as people walk on
    driving_mps: float = 1.0  # as `GroundSizeConfig.driving_mps`
    sigma_roll_rad: float = 0.01  # of the front end's roll, which tilts what is aside
    kerb_m: float = -0.03  # people are on pavements too
    sigma_kerb_m: float = 0.1  # 1-sigma of it
    sigma_pavement_rel: float = 0.036  # the part of it that all share, in heights of the camera: 0.06 m
    hidden_share: float = 0.3  # of a person's height, that is hidden where the feet are
    sigma_hidden_share: float = 0.35  # 1-sigma of it
    box_memory_s: float = 0.4  # for so long a box has the same error: this time counts as one box
    width_memory_s: float = 5.0  # and its width, by clothes and by what is carried: it counts once in so long
    outline_memory_s: float = 2.0  # errors that last: a box that is drawn too low or too high, by
    sigma_outline_rel: float = 0.06  # of its height
    sure_feet: float = 0.01  # a box whose feet are hidden with less probability tells of the road
    sigma_common_rel: float = 0.055  # of what the heights of all who are there have in common

    def sizes(self, label: str) -> Sizes:
        """Of a kind."""
        return self.pedestrian if label == PEDESTRIAN else self.cyclist

    def own_height_var(self, sigma_height_rel: float) -> float:
        """Of somebody's log height beside what all share."""
        return float(max(sigma_height_rel**2 - self.sigma_common_rel**2, MIN_VARIANCE))
