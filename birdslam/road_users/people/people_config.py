"""Priors of people: sizes, motion, lasting errors of their boxes and of the road under them."""

from __future__ import annotations

import msgspec

from birdslam.road_users.models.user_priors import Motion, Rates, UserPriors
from birdslam.road_users.people.people_boxes import PEDESTRIAN

STANDING_RATIO = 0.2  # initial probability of standing
STANDS_FOR_S = 10.0  # mean duration
MOVES_FOR_S = 10.0  # mean duration
CROSSING_RATIO = 0.3  # fraction of moving people in any direction
TURNS_AFTER_S = 10.0  # mean time between changes of direction
STOP_MPS = 0.08  # 1-sigma of the velocity of a standing person
CHILD_RATIO = 0.06  # fraction of children
HIDDEN_SHARE = 0.3  # mean hidden fraction of the height with hidden feet
SIGMA_HIDDEN_SHARE = 0.35  # 1-sigma of it

_MOVING_RATIO, _ALONG_RATIO = 1.0 - STANDING_RATIO, (1.0 - CROSSING_RATIO) / 2.0


def _by_motion(stationary: float, moving: float) -> Rates:
    """Values of the motions, with `moving` shared by those that move."""
    return stationary, moving * _ALONG_RATIO, moving * _ALONG_RATIO, moving * CROSSING_RATIO


_TURNS = _by_motion(1.0 / MOVES_FOR_S, 1.0 / TURNS_AFTER_S)


def person_motions(
    along_mps: float, sigma_along_mps: float, beside_mps: float, crossing_mps: float, change_mps: float
) -> tuple[Motion, Motion, Motion, Motion]:
    """Standing, towards the ego or away from it along the road, or in any direction.

    `along_mps` is the mean speed along the road, the others are 1-sigmas.
    """
    changes = change_mps, change_mps
    return (
        Motion(0.0, STOP_MPS, STOP_MPS),
        Motion(-along_mps, sigma_along_mps, beside_mps, *changes),
        Motion(along_mps, sigma_along_mps, beside_mps, *changes),
        Motion(0.0, crossing_mps, crossing_mps, *changes),
    )


class PersonPriors(UserPriors, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Sizes of a class of people; children are the odd size."""

    height_m: float  # mean of adults
    sigma_height_rel: float  # 1-sigma of it, beyond the common part of all people
    child_m: float  # mean of children
    sigma_child_rel: float  # 1-sigma of it
    length_m: float  # of the footprint
    footprint_m: float  # its width
    reach_m: float  # from the centre to the nearest foot or wheel, along the line of sight
    ratios: Rates = _by_motion((1.0 - CHILD_RATIO) * STANDING_RATIO, (1.0 - CHILD_RATIO) * _MOVING_RATIO)
    odd_ratios: Rates = _by_motion(CHILD_RATIO * STANDING_RATIO, CHILD_RATIO * _MOVING_RATIO)
    changes_per_s: tuple[Rates, Rates, Rates, Rates] = (
        _by_motion(0.0, 1.0 / STANDS_FOR_S),
        *(_TURNS, _TURNS, _TURNS),
    )
    sigma_tilt_rad: float = 0.009
    tilt_drift_rad: float = 0.003
    sigma_offset_m: float = 0.1
    sigma_outline_rel: float = 0.06
    outline_memory_s: float = 2.0
    box_memory_s: float = 0.4

    @property
    def heights(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Mean and relative 1-sigma of the heights of adults and of children."""
        return (self.height_m, self.sigma_height_rel), (self.child_m, self.sigma_child_rel)


class PeopleConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Priors of each class."""

    pedestrian: PersonPriors = PersonPriors(
        height_m=1.72,
        sigma_height_rel=0.051,
        child_m=1.2,
        sigma_child_rel=0.14,
        length_m=0.7,
        footprint_m=0.6,
        reach_m=0.25,
        motions=person_motions(1.3, 0.4, 0.25, 1.1, 0.5),
        foot_rel=0.005,
        head_rel=0.02,
    )
    cyclist: PersonPriors = PersonPriors(  # with the rider
        height_m=1.74,
        sigma_height_rel=0.043,
        child_m=1.45,
        sigma_child_rel=0.107,
        length_m=1.75,
        footprint_m=0.6,
        reach_m=0.6,
        motions=person_motions(4.5, 2.0, 0.5, 4.0, 1.2),
    )

    @property
    def kinds(self) -> tuple[PersonPriors, PersonPriors]:
        """In the order of `kind`."""
        return self.pedestrian, self.cyclist

    def kind(self, label: str) -> int:
        """The row of a label in `kinds`."""
        return 0 if label == PEDESTRIAN else 1

    def priors(self, label: str) -> PersonPriors:
        """The parameters of a label."""
        return self.kinds[self.kind(label)]
