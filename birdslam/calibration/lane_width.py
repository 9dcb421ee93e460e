"""Camera height from the width of painted lanes.

The image shows the ratio of lane width to camera height, without focal length or motion. Lanes are 2.75 to 3.75 m wide.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from birdslam.calibration.height_check import LANES, HeightCheck
from birdslam.lanes.topology import AT_M
from birdslam.types import Bound, Lanes

WIDTH_M, WIDTH_SIGMA_M = 3.4, 0.4  # of lanes with paint on both sides
MIN_DISTANCE_M = 20.0  # min. distance under painted lanes: a shorter one may be a turning lane
_KNOWN_SIGMA_REL = 0.02  # of a stated width: by the side of the paint that it is measured to
_CORRELATION_M = 30.0  # correlation length of lane widths


class LaneWidth(NamedTuple):
    """Width of the ego's lane in one frame (m, at the assumed height) and the distance travelled (m)."""

    width_m: float
    distance_m: float


def painted_width_m(lanes: Lanes | None) -> float | None:
    """Width of the ego's lane `AT_M` ahead if paint bounds it on both sides, else None."""
    if lanes is None or lanes.ego_index is None:
        return None
    lane = lanes.lanes[lanes.ego_index]
    if lane.left_bound is not Bound.PAINT or lane.right_bound is not Bound.PAINT:
        return None
    return lane.left_m(AT_M) - lane.right_m(AT_M)


def checks_by_lanes(
    seen: Sequence[LaneWidth], camera_height_m: float, sigma_pitch_rad: float, known_width_m: float | None = None
) -> list[HeightCheck]:
    """One check, or none with too few painted lanes. The widths were measured at `camera_height_m`.

    `known_width_m` is the stated width of the lanes, in place of the usual one.
    """
    width_m, width_sigma_m = WIDTH_M, WIDTH_SIGMA_M
    if known_width_m is not None:
        width_m, width_sigma_m = known_width_m, _KNOWN_SIGMA_REL * known_width_m
    widths_m, distances_m = (np.array(part) for part in zip(*seen, strict=True)) if seen else (np.zeros(0), np.zeros(0))
    distance_m = float(distances_m.sum())
    if distance_m < MIN_DISTANCE_M:
        return []
    order = np.argsort(widths_m)
    cumulated = np.cumsum(distances_m[order])
    low, middle, high = widths_m[order][np.searchsorted(cumulated, np.array([0.16, 0.5, 0.84]) * distance_m)]
    height_m = camera_height_m * width_m / float(middle)
    scatter_rel = 0.5 * float(high - low) / float(middle) / math.sqrt(max(1.0, distance_m / _CORRELATION_M))
    pitch_rel = sigma_pitch_rad * AT_M / camera_height_m  # AT_M ahead the road is H / AT_M below the horizon
    sigma_rel = math.hypot(width_sigma_m / width_m, scatter_rel, pitch_rel)
    return [HeightCheck(cue=LANES, height_m=height_m, sigma_m=height_m * sigma_rel, samples=len(seen))]
