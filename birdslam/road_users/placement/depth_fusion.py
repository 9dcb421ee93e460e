"""Fusion of the two sources of a vehicle's place, depth and Eq. 1 (paper, Fig. 2).

By covariances, or by the paper's rule: depth for near vehicles, Eq. 1 for far ones.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.road_users.placement.localisation import Observation, Place

Floats = NDArray[np.float64]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]


class PseudoLidarConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Parameters of places by depth and of their fusion with Eq. 1."""

    rule: Literal["covariance", "paper", "off"] = "covariance"  # fusion of the places by depth and by Eq. 1
    near_m: Positive = 20.0  # of the paper's rule: below it depth alone, above it Eq. 1 alone
    top_rel: float = 0.35  # of a box's height: first row of the body, below the windows
    bottom_rel: float = 0.8  # of a box's height: last row of the body, above the road
    columns: Annotated[int, msgspec.Meta(ge=4, le=64)] = 16  # per box, with one depth each
    yaws: Annotated[int, msgspec.Meta(ge=4, le=180)] = 36  # of the fan, over half a turn
    sigma_shape_rel: Positive = 0.03  # of a depth: distortion of a vehicle's shape in the map
    sigma_shape_m: Positive = 0.25  # deviation of vehicles from cuboids
    independent_columns: Positive = 4.0  # effective number; errors of neighbouring columns are correlated
    outlier_sigma: Positive = 3.0  # outlier threshold of a column
    least_columns: Annotated[int, msgspec.Meta(ge=2)] = 5  # minimum number of columns for a fit
    least_points: Annotated[int, msgspec.Meta(ge=1)] = 40  # minimum number of points of a frustum for the network
    max_range_m: Positive = 60.0  # maximum depth; beyond, Eq. 1 alone
    gate_sigma: Positive = 3.0  # difference of the places above which the covariance grows
    road_near_m: Positive = 5.0  # near end of the road that scales a non-metric map
    road_far_m: Positive = 25.0  # far end of that road


class DepthPlace(msgspec.Struct, frozen=True):
    """Place of a vehicle by depth, in ego: centre of the footprint (2,) and yaw, with their covariances.

    `flip` is the probability that front and rear are swapped. If it is 0.5, the yaw is that of the axis, in (-pi/2,
    pi/2].
    """

    centre_m: Floats
    cov: Floats  # (2, 2)
    yaw_rad: float
    sigma_yaw_rad: float
    flip: float = 0.5
    size_m: tuple[float, float, float] | None = None  # length, width, height, if measured

    @property
    def has_front(self) -> bool:
        """Whether the yaw is that of the front and not of the axis only."""
        return self.flip < 0.5

    @property
    def front_logit(self) -> float:
        """Log odds that the yaw points to the front."""
        return math.log(1.0 - self.flip) - math.log(max(self.flip, 1e-6))


def fuse(by_box: Place, by_depth: DepthPlace | None, config: PseudoLidarConfig) -> Place:
    """Fuses the two places.

    By covariance, inflated if they differ by more than `gate_sigma`, or by the paper's rule. The nearest face moves
    with the centre.
    """
    if by_depth is None or config.rule == "off":
        return by_box
    if config.rule == "paper":
        if by_box.depth_m > config.near_m:
            return by_box
        return _move_place(by_box, by_depth.centre_m, by_depth.cov)
    # Across the line of sight both use the same edges of the box, so only the depth is new
    apart_m = float(by_depth.centre_m[0] - by_box.centre_m[0])
    variance = float(by_box.cov[0, 0] + by_depth.cov[0, 0])
    inflation = max(1.0, apart_m**2 / variance / config.gate_sigma**2)
    gain = by_box.cov[:, 0] / variance
    cov = by_box.cov - np.outer(gain, by_box.cov[0])
    return _move_place(by_box, by_box.centre_m + gain * apart_m, inflation * cov)


def _move_place(place: Place, centre_m: Floats, cov: Floats) -> Place:
    depth_m = max(place.depth_m + float(centre_m[0] - place.centre_m[0]), 0.1)
    return Place(depth_m, centre_m, (cov + cov.T) / 2.0)


def lateral_variance(seen: Observation, x_m: float) -> float:
    """Variance of the centre across the line of sight; each edge is half an outline away."""
    of_left, of_right = seen.sigma_left**-2, seen.sigma_right**-2
    lopsided = (of_left - of_right) / (of_left + of_right)
    half_m = lopsided * seen.dimensions.sigma_width_rel * seen.tan_width * x_m / 2.0
    return x_m**2 / (of_left + of_right) + half_m**2
