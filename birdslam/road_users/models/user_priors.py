"""Priors of a class of road users: motion, and the lasting errors of its road and of its boxes, as data."""

from __future__ import annotations

from typing import NamedTuple

import msgspec


class Motion(NamedTuple):
    """A way to move: initial velocity along and across the direction of travel, and its change within a second."""

    speed_mps: float = 0.0  # mean, along
    along_mps: float = 0.0  # 1-sigma of it
    across_mps: float = 0.0  # the same across
    change_along_mps: float = 0.0  # 1-sigma of the change within a second
    change_across_mps: float = 0.0


Rates = tuple[float, float, float, float]


class UserPriors(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Priors of the motions (`user_state.MOTIONS`, stationary first) and of the errors."""

    motions: tuple[Motion, Motion, Motion, Motion]  # stationary, two along the direction of travel, any direction
    ratios: Rates  # initial probabilities of the motions, with a usual size
    changes_per_s: tuple[Rates, Rates, Rates, Rates]  # rates of change of the motion, from and to
    odd_ratios: Rates  # the same of road users of an odd size
    sigma_tilt_rad: float  # of the road at a road user relative to the ego
    tilt_drift_rad: float = 0.0  # its change within a second as the road user moves
    sigma_offset_m: float  # 1-sigma of the ground offset from the ego's plane
    sigma_crown_rad: float = 0.0  # and its growth with the lateral distance
    foot_rel: float = 0.0  # mean margin of boxes below the feet, of the height
    head_rel: float = 0.0  # and above the head
    sigma_outline_rel: float = 0.0  # 1-sigma of lasting errors of both edges
    outline_memory_s: float = 1.0  # their correlation time
    box_memory_s: float  # correlation time of the other errors of a box
    outline_drift_rel: float = 0.0  # of the width of the outline, within a second
    view_memory_s: float = 1.0  # correlation time of the depth of the edges of a box
