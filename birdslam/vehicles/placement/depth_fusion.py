"""The two sources of a vehicle's place, its depth and Eq. 1, fused into one (paper, Fig. 2).

They are fused by their covariances, or by the paper's rule: the depth where the vehicle is near, Eq. 1 where it is far.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.vehicles.placement.localisation import Observation, Place

Floats = NDArray[np.float64]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]


class PseudoLidarConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How depth becomes a place, and how it is weighted against Eq. 1."""

    rule: Literal["covariance", "paper", "off"] = "covariance"  # how the places by depth and by Eq. 1 become one
    near_m: Positive = 20.0  # by the paper's rule: nearer, the depth map alone; farther, Eq. 1 alone
    top_rel: float = 0.35  # of a box's height: upper end of the rows in which a body shows, below its windows
    bottom_rel: float = 0.8  # of a box's height: lower end of these rows, above the road before it
    columns: Annotated[int, msgspec.Meta(ge=4, le=64)] = 16  # of the box, each with one depth
    yaws: Annotated[int, msgspec.Meta(ge=4, le=180)] = 36  # of the fan, over half a turn
    sigma_shape_rel: Positive = 0.03  # of a depth: how well the map keeps a vehicle's shape, columns apart
    sigma_shape_m: Positive = 0.25  # vehicles are no cuboids
    independent_columns: Positive = 4.0  # errors of neighbouring columns go together
    outlier_sigma: Positive = 3.0  # past it a column is taken for something else
    least_columns: Annotated[int, msgspec.Meta(ge=2)] = 5  # with depth, to fit a body
    least_points: Annotated[int, msgspec.Meta(ge=1)] = 40  # of a frustum that the network is asked about
    max_range_m: Positive = 60.0  # farther vehicles are left to Eq. 1
    gate_sigma: Positive = 3.0  # past it the covariance of two places that differ grows
    road_near_m: Positive = 5.0  # of the road that gives an unscaled map its metres
    road_far_m: Positive = 25.0  # and where that stretch of road ends


class DepthPlace(msgspec.Struct, frozen=True):
    """Where the depth map puts a vehicle, in ego: its footprint's centre (2,) and yaw, with their covariances.

    The yaw is of the axis, in (-pi/2, pi/2], where `flip` is 0.5: which end is the front is then not known. `flip` is
    the probability that the front is the rear.
    """

    centre_m: Floats
    cov: Floats  # (2, 2)
    yaw_rad: float
    sigma_yaw_rad: float
    flip: float = 0.5
    size_m: tuple[float, float, float] | None = None  # length, width, height, where they were measured

    @property
    def front_seen(self) -> bool:
        """Whether the yaw is of the front, in all likelihood, and not of the axis alone."""
        return self.flip < 0.5

    @property
    def front_logit(self) -> float:
        """Log odds that the yaw points to the front."""
        return math.log(1.0 - self.flip) - math.log(max(self.flip, 1e-6))


def fuse(by_box: Place, by_depth: DepthPlace | None, config: PseudoLidarConfig) -> Place:
    """One place from the two sources.

    By their covariances, which grow where the two differ by more than `gate_sigma`, or by the paper's rule, which asks
    the depth. The nearest face moves with the centre.
    """
    if by_depth is None or config.rule == "off":
        return by_box
    if config.rule == "paper":
        if by_box.depth_m > config.near_m:
            return by_box
        return _moved(by_box, by_depth.centre_m, by_depth.cov)
    # Across the line of sight both rest on the same edges of the box: the depth is all that is new
    apart_m = float(by_depth.centre_m[0] - by_box.centre_m[0])
    variance = float(by_box.cov[0, 0] + by_depth.cov[0, 0])
    inflation = max(1.0, apart_m**2 / variance / config.gate_sigma**2)
    gain = by_box.cov[:, 0] / variance
    cov = by_box.cov - np.outer(gain, by_box.cov[0])
    return _moved(by_box, by_box.centre_m + gain * apart_m, inflation * cov)


def _moved(place: Place, centre_m: Floats, cov: Floats) -> Place:
    depth_m = max(place.depth_m + float(centre_m[0] - place.centre_m[0]), 0.1)
    return Place(depth_m, centre_m, (cov + cov.T) / 2.0)


def across_var(seen: Observation, x_m: float) -> float:
    """Variance of the centre across the line of sight: each edge is half an outline away from it."""
    of_left, of_right = seen.sigma_left**-2, seen.sigma_right**-2
    lopsided = (of_left - of_right) / (of_left + of_right)
    half_m = lopsided * seen.dimensions.sigma_width_rel * seen.tan_width * x_m / 2.0
    return x_m**2 / (of_left + of_right) + half_m**2
