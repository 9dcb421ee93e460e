"""A vehicle's place with the uncertainty of its yaw marginalised out.

The width of a box, at a depth, measures how much a vehicle is turned, not to which side. Each yaw of a fan puts the
footprint's centre elsewhere; the posterior over the fan, from the yaw's prior and the width, gives the centre's mean
and covariance. Nothing is kept from frame to frame: the yaws (rad) are `yaw_filter.YawFilter`'s, the log depths
`ground_size_filter.GroundSizeFilter`'s, and `placing.Placing` reads the result.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.vehicles.placement.localisation import CENTRE_STEPS, LocalisationConfig, Observation, extent_m

Floats = NDArray[np.float64]
Share = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]

_GAUSS_HERMITE = np.array([0.0, math.sqrt(3.0), -math.sqrt(3.0)])  # points of a normal distribution, in sigmas
_GAUSS_HERMITE_WEIGHT = np.array([2.0, 0.5, 0.5]) / 3.0
_MIN_WEIGHT = 1e-12


class HeadingConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How vehicles stand on roads, and how well the width of a box measures it."""

    outlier_unknown: Share = 0.25  # of the vehicles whose yaw was not measured yet: they are headed anywhere
    outlier_known: Share = 0.1  # of those whose motion or body measured it: it may be wrong
    sigma_along_road_rad: float = 0.05  # of the others of the first kind: they are headed like the ego
    sigma_width_rel: float = 0.09  # of the outline of a footprint, among vehicles of a class
    # Of the vehicles, when first seen: they stand or drive across the ego's road. By the labels of KITTI tracking 0000
    # to 0020 43 of 343 do
    across: Share = 0.1
    fan: Annotated[int, msgspec.Meta(ge=4, le=90)] = 36  # yaws over half a turn: the opposite has the same outline
    # Of the vehicles: along the ego's way no more than across it. By the labels of KITTI tracking 31 of 296 cars are
    # turned by 10 to 70 degrees at their first sight of 25 px
    oblique: Share = 0.1
    sigma_across_rad: float = 0.2  # of those across the ego's way
    bend_m: float = 5.0  # of the way, over which its bend is known
    box_memory_s: float = 0.5  # for so long the width of a box has the same error
    least_width_rel: float = 0.03  # 1-sigma of a box's width, at least


@dataclass(frozen=True)
class YawPrior:
    """Of the yaws (N,) of a frame's vehicles against the ego: a normal distribution mixed with a uniform one.

    `outlier` (N,) is the weight of the uniform one.
    """

    yaw_rad: Floats
    sigma_rad: Floats
    outlier: Floats


def initial_yaw_rad(seen: Observation, config: HeadingConfig) -> float:
    """Against the ego, of a vehicle whose yaw nothing has measured: along the road or, by the shape of its box, across.

    A car from the side is 2.5 times as wide as high, one from behind as wide as high: the shape of its box needs no
    depth. One that the image's border cuts is taken to stand along the road.
    """
    if seen.cut_side or seen.sigma_cut is not None:
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
    """Where the centres (N, M, 2) in ego of boxes (N,) would be at each of the yaws of a fan.

    `residual` (N, M): by how much the log of a box's width exceeds the log of its footprint's outline at that yaw;
    `box_variance` (N,) is that of the log width.
    """

    centres_m: Floats
    residual: Floats
    box_variance: Floats

    def marginalised(self, weight: Floats) -> tuple[Floats, Floats]:
        """Shift (N, 2) from the first yaw's centre to the mean one, its covariance (N, 2, 2), by `weight` (N, M)."""
        mean = (weight[..., None] * self.centres_m).sum(axis=1)
        away = self.centres_m - mean[:, None]
        return mean - self.centres_m[:, 0], (weight[..., None] * away).swapaxes(1, 2) @ away


def look_at_yaws(seen: Sequence[Observation], log_depth: Floats, yaws: Floats, reach_rel: float) -> YawFan:
    """The fan of boxes whose nearest faces are at `log_depth` (N,), at the yaws (N, M) against the ego."""
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

    # Corners about the centre, (4, N, M): the last two are opposite to the first
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


def fan_of(yaws_prior: YawPrior, fan_rad: Floats) -> Floats:
    """(N, 3 + F): the points of each prior's normal distribution, the mean first, then its fan (N, F) or (F,)."""
    n = len(yaws_prior.yaw_rad)
    near = yaws_prior.yaw_rad[:, None] + yaws_prior.sigma_rad[:, None] * _GAUSS_HERMITE
    return np.hstack([near, np.broadcast_to(fan_rad, (n, fan_rad.shape[-1]))])


def weigh_yaws(fan: YawFan, variance: Floats, yaws_prior: YawPrior, config: HeadingConfig) -> Floats:
    """(N, M) of a fan as `fan_of` has it: its posterior by the widths of the boxes, at depths of this log variance."""
    outlier, many = yaws_prior.outlier[:, None], fan.residual.shape[1] - len(_GAUSS_HERMITE)
    uniform = np.broadcast_to(outlier / many, (len(outlier), many))
    prior = np.hstack([(1.0 - outlier) * _GAUSS_HERMITE_WEIGHT, uniform])
    noise = (variance + config.sigma_width_rel**2 + fan.box_variance)[:, None]
    weight: Floats = prior * np.exp(-0.5 * fan.residual**2 / noise) + prior * _MIN_WEIGHT
    return weight / weight.sum(axis=1, keepdims=True)


def marginalise_yaw(
    seen: Sequence[Observation],
    log_depth: Floats,
    variance: Floats,
    yaws_prior: YawPrior,
    localisation: LocalisationConfig,
    config: HeadingConfig,
) -> tuple[Floats, Floats]:
    """(N, 2) m in ego: how far the mean centre lies from the centre at the mean yaw; its covariance (N, 2, 2) by yaw.

    `log_depth` (N,) is of the nearest faces, with its `variance`; of the yaws nothing but their prior is known.
    """
    if not seen:
        return np.zeros((0, 2)), np.zeros((0, 2, 2))
    yaws = fan_of(yaws_prior, np.arange(config.fan, dtype=np.float64) * (math.pi / config.fan))
    fan = look_at_yaws(seen, log_depth, yaws, localisation.reach_rel)
    return fan.marginalised(weigh_yaws(fan, variance, yaws_prior, config))
