"""Measurements of the boxes of vehicles for `models.user_filter`, and the motion of vehicles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import msgspec
import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.road_users.models.user_boxes import BEARING, WIDE, Boxes, Cases, edge_covariance
from birdslam.road_users.models.user_priors import Motion, UserPriors
from birdslam.road_users.placement.localisation import MIN_DISTANCE_M, Observation

SIDE_OUTLIER_RATIO = 0.03  # probability that the left side of a box is an outlier, and the right
SIGMA_SIDE_OUTLIER_REL = 0.3  # of the width of the box
NEIGHBOUR_RATIO = 0.02  # probability that a box is that of the next vehicle along the road
SIGMA_NEIGHBOUR_M = 5.0  # from a vehicle to it
SIGMA_FACE_M = 1.0  # of the depth of the faces at a box's edges
SIGMA_ODD_REL = 0.3  # of the height of a vehicle of an odd size
ITERATIONS = 2  # of an update, since the first depth of an unusual vehicle may be wrong by half
ROAD_HALF_WIDTH_M = 10.0  # lateral distance beyond which vehicles move in any direction

CROSSING_RATIO = 0.05  # initial probability of a motion in any direction
STANDING_RATIO = 0.3  # and of none
ODD_RATIO = 0.03  # and of none, with an odd size
SIGMA_DRIVE_MPS = 10.0  # 1-sigma of a vehicle's velocity
SIGMA_SLOW_MPS = 2.0  # the same of a vehicle that starts
SIGMA_ACROSS_MPS = 1.04  # the same across the heading
CHANGE_MPS = 2.0  # 1-sigma of the change of velocity within a second
CHANGE_ACROSS_MPS = 0.5  # the same across the heading
STANDS_FOR_S = 60.0  # mean duration
MOVES_FOR_S = 20.0  # mean duration

_CROSSING = Motion(0.0, SIGMA_DRIVE_MPS, SIGMA_DRIVE_MPS, CHANGE_MPS, CHANGE_MPS)
_STOPS = 1.0 / MOVES_FOR_S, 0.0, 0.0, 0.0

VEHICLE = UserPriors(
    motions=(
        Motion(),
        Motion(0.0, SIGMA_SLOW_MPS, SIGMA_SLOW_MPS, CHANGE_MPS, CHANGE_ACROSS_MPS),
        Motion(0.0, SIGMA_DRIVE_MPS, SIGMA_ACROSS_MPS, CHANGE_MPS, CHANGE_ACROSS_MPS),
        _CROSSING,
    ),
    ratios=(STANDING_RATIO, 0.0, 1.0 - STANDING_RATIO - ODD_RATIO - CROSSING_RATIO, CROSSING_RATIO),
    odd_ratios=(ODD_RATIO, 0.0, 0.0, 0.0),
    changes_per_s=((0.0, 1.0 / STANDS_FOR_S, 0.0, 0.0), _STOPS, _STOPS, _STOPS),
    sigma_tilt_rad=0.004,
    sigma_offset_m=0.06,
    sigma_crown_rad=0.007,
    box_memory_s=0.4,
    view_memory_s=1.5,
    outline_drift_rel=0.03,
)
BESIDE_ROAD = msgspec.structs.replace(
    VEHICLE,
    motions=(Motion(), Motion(0.0, SIGMA_SLOW_MPS, SIGMA_SLOW_MPS, CHANGE_MPS, CHANGE_MPS), _CROSSING, _CROSSING),
)
KINDS = VEHICLE, BESIDE_ROAD
_JUMPS = np.array([[0.0], [0.0], [0.0], [SIGMA_NEIGHBOUR_M]])  # of the cases


def vehicle_kinds(centres_m: Floats) -> list[int]:
    """The rows in `KINDS` of vehicles with these centres (N, 2) in ego."""
    return [int(abs(y_m) >= ROAD_HALF_WIDTH_M) for y_m in centres_m[:, 1].tolist()]


def measure_boxes(
    seen: Sequence[Observation],
    centres_m: Floats,
    extents_m: Floats,
    turned_rad: Floats,
    direction_rad: Floats,
    top_m: Floats,
) -> Boxes:
    """Measurements of observations (N,), with approximate centres (N, 2) in ego and extents (N, 2) of `extent_m`.

    `top_m` (N,) is the distance from the nearest face to the visible edge of the roof, along the line of sight.
    """
    n, reach = len(seen), extents_m[:, 0] / 2.0
    depth = np.maximum(centres_m[:, 0] - reach, MIN_DISTANCE_M)
    tall, wide = (np.array(values) for values in ([max(o.tan_height, 1e-3) for o in seen], [o.tan_width for o in seen]))
    sides = np.array([math.hypot(o.sigma_left, o.sigma_right) for o in seen])
    slopes = np.array([(o.slope_bottom, o.sigma_bottom, o.sigma_top) for o in seen]).reshape(-1, 3)
    z = np.column_stack(
        [centres_m[:, 1] / centres_m[:, 0], slopes[:, 0], np.log(tall), np.log(wide) - np.log(extents_m[:, 1])]
    )
    sigma = np.zeros((n, 4, 4))
    sigma[:, 1:3, WIDE] = SIGMA_SIDE_OUTLIER_REL
    sigma[:, 1:3, BEARING] = SIGMA_SIDE_OUTLIER_REL * wide[:, None] / 2.0 * [1.0, -1.0]
    prior = [1.0 - 2.0 * SIDE_OUTLIER_RATIO - NEIGHBOUR_RATIO, SIDE_OUTLIER_RATIO, SIDE_OUTLIER_RATIO, NEIGHBOUR_RATIO]
    return Boxes(
        z=z,
        R=edge_covariance(tall, np.column_stack([sides / 2.0, slopes[:, 1:], sides / wide])),
        reach_m=reach,
        top_m=top_m,
        cases=Cases(np.tile(prior, (n, 1)), np.zeros((n, 4, 4)), sigma, _JUMPS),
        direction_rad=direction_rad,
        outline_var=np.square(turned_rad),
        face_var=np.square(SIGMA_FACE_M / depth),
    )


def association_boxes(seen: Sequence[Observation]) -> Boxes:
    """Measurements of observations (N,) whose vehicles, and so the yaws, are not known yet."""
    extents = np.array([(o.dimensions.length_m, o.dimensions.width_m) for o in seen])
    depth = np.array([o.depth_by_height_m for o in seen]) + extents[:, 0] / 2.0
    bearing = np.array([o.bearing for o in seen])
    zero = np.zeros(len(seen))
    boxes = measure_boxes(seen, np.column_stack([depth, bearing * depth]), extents, zero, zero, zero)
    turned = np.array([0.5 if o.is_cut_at_side else 0.05 for o in seen])
    boxes.R[:, BEARING, BEARING] += np.square(turned * extents[:, 0] / depth)
    nothing = np.zeros((len(seen), 1, 4))
    return replace(boxes, cases=Cases(np.ones((len(seen), 1)), nothing, nothing, np.zeros((1, 1))))
