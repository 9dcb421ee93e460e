"""Marginalization of the uncertain yaw of a vehicle.

The width of a box at a depth measures the yaw, but not its sign. Each yaw of a fan gives another centre; the posterior
over the fan, from the prior of the yaw and the width, gives mean and covariance of the centre.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.road_users.placement.localisation import CENTRE_STEPS, Observation, extent_m

Floats = NDArray[np.float64]
Share = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]

_GAUSS_HERMITE = np.array([0.0, math.sqrt(3.0), -math.sqrt(3.0)])  # sigma points of a normal distribution
_GAUSS_HERMITE_WEIGHT = np.array([2.0, 0.5, 0.5]) / 3.0
_MIN_WEIGHT = 1e-12


class HeadingConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Priors of the heading of vehicles, and the noise of the width of a box."""

    outlier_unknown: Share = 0.25  # of vehicles without a measured yaw
    outlier_known: Share = 0.1  # of vehicles with a yaw by motion or body
    sigma_along_road_rad: float = 0.05  # 1-sigma about the road, of the inliers without a measured yaw
    sigma_width_rel: float = 0.09  # of the outline of footprints of a class
    across: Share = 0.1  # fraction of vehicles across the road, at the first observation
    fan: Annotated[int, msgspec.Meta(ge=4, le=90)] = 36  # number of yaws over half a turn
    oblique: Share = 0.1  # fraction of vehicles neither along nor across the road
    sigma_across_rad: float = 0.2  # of vehicles across the road
    bend_m: float = 5.0  # distance over which the curvature of the path is averaged
    box_memory_s: float = 0.5  # correlation time of the width of boxes
    least_width_rel: float = 0.03  # minimum 1-sigma of the width of a box


@dataclass(frozen=True)
class YawPrior:
    """Prior of the yaws (N,) in ego: a mixture of a normal and a uniform distribution.

    `outlier` (N,) is the weight of the uniform part.
    """

    yaw_rad: Floats
    sigma_rad: Floats
    outlier: Floats


def initial_yaw_rad(seen: Observation, config: HeadingConfig) -> float:
    """Initial yaw in ego: along the road or, by the aspect ratio of the box, across it.

    The aspect ratio needs no depth. A vehicle cut by the image border is assumed to be along the road.
    """
    if seen.is_cut_at_side or seen.sigma_cut is not None:
        return 0.0
    d, tan_height, across_rad = seen.dimensions, max(seen.tan_height, 1e-3), math.pi / 2.0
    sigmas = (
        math.hypot(seen.sigma_left, seen.sigma_right) / seen.tan_width,
        math.hypot(seen.sigma_bottom, seen.sigma_top) / tan_height,
        config.sigma_width_rel,
        d.sigma_height_rel,
    )
    along, across = (
        math.log(extent_m(d, yaw_rad, seen.depth_by_height_m, seen.bearing)[1] / d.height_m)
        for yaw_rad in (0.0, across_rad)
    )
    shape = math.log(seen.tan_width / tan_height)
    more_likely = 0.5 * ((shape - along) ** 2 - (shape - across) ** 2) / sum(sigma**2 for sigma in sigmas)
    return across_rad if config.across > 0.0 and more_likely > math.log(1.0 / config.across - 1.0) else 0.0


@dataclass(frozen=True)
class YawFan:
    """Centres (N, M, 2) in ego of boxes (N,) at each yaw of a fan.

    `residual` (N, M) is log(width of the box / outline of the footprint) at that yaw; `box_variance` (N,) is the
    variance of the log width.
    """

    centres_m: Floats
    residual: Floats
    box_variance: Floats

    def marginalised(self, weight: Floats) -> tuple[Floats, Floats]:
        """Shift (N, 2) from the first yaw's centre to the mean, and its covariance (N, 2, 2), with weights (N, M)."""
        mean = (weight[..., None] * self.centres_m).sum(axis=1)
        away = self.centres_m - mean[:, None]
        return mean - self.centres_m[:, 0], (weight[..., None] * away).swapaxes(1, 2) @ away


def evaluate_yaws(seen: Sequence[Observation], log_depth: Floats, yaws: Floats, reach_rel: float) -> YawFan:
    """Fan of boxes with nearest faces at `log_depth` (N,), at yaws (N, M) in ego."""
    left, right, var_left, var_right, half_l, half_w = np.array(
        [
            (
                o.left,
                o.right,
                o.sigma_left**2,
                o.sigma_right**2,
                o.dimensions.length_m / 2.0,
                o.dimensions.width_m / 2.0,
            )
            for o in seen
        ]
    ).T[..., None]

    # Corners about the centre, (4, N, M); the last two are opposite to the first
    c, s = np.cos(yaws), np.sin(yaws)
    ahead = np.stack([half_l * c - half_w * s, half_l * c + half_w * s])
    aside = np.stack([half_l * s + half_w * c, half_l * s - half_w * c])
    ahead, aside = (np.concatenate([half, -half]) * reach_rel for half in (ahead, aside))
    depth_m = np.exp(log_depth)[:, None]
    x_m = depth_m + ahead.max(axis=0)
    far_m = np.maximum(x_m + ahead, 0.1)
    y_m = (left + right) / 2.0 * x_m
    of_left, of_right = 1.0 / var_left, 1.0 / var_right
    for _ in range(CENTRE_STEPS):  # as `localisation.place`
        outline = (y_m + aside) / far_m
        widest, least = outline.max(axis=0), outline.min(axis=0)
        y_m = y_m + ((left - widest) * of_left + (right - least) * of_right) / (of_left + of_right) * x_m
    residual = np.log(np.maximum(left - right, 1e-3) / np.maximum(widest - least, 1e-3))
    box_variance = ((var_left + var_right) / (left - right) ** 2)[:, 0]
    return YawFan(np.stack([x_m, y_m], axis=-1), residual, box_variance)


def make_fan(yaws_prior: YawPrior, fan_rad: Floats) -> Floats:
    """(N, 3 + F): sigma points of each prior's normal distribution, the mean first, then its fan (N, F) or (F,)."""
    n = len(yaws_prior.yaw_rad)
    near = yaws_prior.yaw_rad[:, None] + yaws_prior.sigma_rad[:, None] * _GAUSS_HERMITE
    return np.hstack([near, np.broadcast_to(fan_rad, (n, fan_rad.shape[-1]))])


def weigh_yaws(fan: YawFan, variance: Floats, yaws_prior: YawPrior, config: HeadingConfig) -> Floats:
    """(N, M) posterior of a fan of `make_fan`, from the widths of the boxes and the variance of the log depths."""
    outlier, many = yaws_prior.outlier[:, None], fan.residual.shape[1] - len(_GAUSS_HERMITE)
    uniform = np.broadcast_to(outlier / many, (len(outlier), many))
    prior = np.hstack([(1.0 - outlier) * _GAUSS_HERMITE_WEIGHT, uniform])
    noise = (variance + config.sigma_width_rel**2 + fan.box_variance)[:, None]
    weight: Floats = prior * np.exp(-0.5 * fan.residual**2 / noise) + prior * _MIN_WEIGHT
    return weight / weight.sum(axis=1, keepdims=True)
