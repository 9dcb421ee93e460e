"""The places of a frame's vehicles, all of them together, from everything that tells depth.

Boxes against the road (horizon.py), sizes learned as the ego drives by (parallax.py), and a depth map where there is
one (pseudolidar.py). A further source of a place with its covariance belongs into `Placing.places`, beside the last.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import erfcx

from birdslam.geometry.se2 import SE2, wrap
from birdslam.vehicles.association import NEAREST_M, in_ego
from birdslam.vehicles.depth_fusion import DepthPlace, PseudoLidarConfig, combined
from birdslam.vehicles.ground_size_filter import Depths, Horizon
from birdslam.vehicles.heading import HeadingConfig, Headings, spread
from birdslam.vehicles.localisation import LocalisationConfig, Observation, Place, Taken, extent_m, place
from birdslam.vehicles.parallax import LearnedSize, Parallax, ParallaxConfig, sights_of
from birdslam.vehicles.track import Track

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Body:
    """An observation and whose it is: a track's, or that of a vehicle which is new."""

    serial: int
    track: Track | None
    seen: Observation
    by_depth: DepthPlace | None = None

    def yaw_rad(self, T_world_ego: SE2) -> float:
        """In ego; a new vehicle is headed as it looks, or like the ego where its front was not seen."""
        if self.track is None:
            return self.by_depth.yaw_rad if self.by_depth is not None and self.by_depth.front_seen else 0.0
        return wrap(self.track.yaw_rad - T_world_ego.yaw_rad)

    def yaw_doubt(self, config: HeadingConfig) -> tuple[float, float]:
        """1-sigma of that yaw, and the probability that it is another one altogether."""
        if self.track is None:
            if self.by_depth is not None and self.by_depth.front_seen:
                return self.by_depth.sigma_yaw_rad, config.astray_known
        elif self.track.yaw_known:
            return self.track.sigma_yaw_rad, config.astray_known
        return config.sigma_along_road_rad, config.astray_unknown

    def expected_depth_m(self, T_world_ego: SE2) -> float:
        """Of the nearest face, before it is measured: as the track predicts it, or by the height of its class."""
        if self.track is None:
            return self.seen.depth_by_height_m
        reach_m = self.track.place.centre_m[0] - self.track.place.depth_m
        return max(NEAREST_M, in_ego(T_world_ego, self.track.state[:2])[0] - reach_m)

    def turned_rad(self, T_world_ego: SE2) -> float:
        """By how much the line of sight to it turned over the ground since it was last seen."""
        if self.track is None:
            return 0.0
        before = math.atan(self.track.observation.bearing) + self.track.T_world_ego.yaw_rad
        return wrap(math.atan(self.seen.bearing) + T_world_ego.yaw_rad - before)


class Placing:
    """predict() once a frame, then places() of its bodies."""

    def __init__(
        self,
        localisation: LocalisationConfig,
        parallax: ParallaxConfig,
        pseudolidar: PseudoLidarConfig,
        heading: HeadingConfig,
    ) -> None:
        self.localisation = localisation
        self.heading = heading
        self.pseudolidar = pseudolidar
        self.parallax = Parallax(parallax)

    def predict(self, dt_s: float, T_world_ego: SE2, ego_cov: Floats | None) -> None:
        """To the next frame's ego pose, with the covariance (3, 3) of the step to it."""
        self.parallax.predict(dt_s, T_world_ego, ego_cov)

    def keep_only(self, serials: Iterable[int]) -> None:
        """Forget the other vehicles."""
        self.parallax.keep_only(serials)

    def places(self, bodies: Sequence[Body], T_world_ego: SE2, horizon: Horizon) -> list[Place]:
        """In ego, one for each body; the horizon learns the road's tilt and their sizes from all of them."""
        seen, serials = [body.seen for body in bodies], [body.serial for body in bodies]
        yaws = [body.yaw_rad(T_world_ego) for body in bodies]
        depths = [body.expected_depth_m(T_world_ego) for body in bodies]
        turned = np.array([body.turned_rad(T_world_ego) for body in bodies])
        extents = np.array(
            [extent_m(o.dimensions, yaw, depth, o.bearing) for o, yaw, depth in zip(seen, yaws, depths, strict=True)]
        ).reshape(-1, 2)
        centres = np.array(
            [
                place(o, math.log(depth), 0.0, yaw, self.localisation).centre_m
                for o, yaw, depth in zip(seen, yaws, depths, strict=True)
            ]
        ).reshape(-1, 2)
        learned = self._sizes(bodies, centres, extents, turned, T_world_ego, horizon)
        pitch_rad = horizon.ground.pitch_rad
        found = horizon.update(serials, seen, extents[:, 1], extents[:, 0], turned, learned)
        found = no_farther_than_cut(found, seen, horizon, horizon.ground.pitch_rad - pitch_rad)
        by_boxes = [
            place(o, log_depth, variance, yaw, self.localisation)
            for o, log_depth, variance, yaw in zip(
                seen, found.log_depth.tolist(), found.variance.tolist(), yaws, strict=True
            )
        ]
        by_boxes = self._headed(by_boxes, bodies, found, yaws)
        where = [
            combined(by_box, body.by_depth, self.pseudolidar) for by_box, body in zip(by_boxes, bodies, strict=True)
        ]
        return [
            replace(whole, taken=self._taken(found, k, serials[k], float(whole.cov[0, 0] / by_box.cov[0, 0])))
            for k, (whole, by_box) in enumerate(zip(where, by_boxes, strict=True))
        ]

    def _headed(
        self, places: Sequence[Place], bodies: Sequence[Body], depths: Depths, yaws_rad: Sequence[float]
    ) -> list[Place]:
        """The places with all that the doubt of the yaws makes of them."""
        sigma_rad, astray = np.array([body.yaw_doubt(self.heading) for body in bodies]).reshape(-1, 2).T
        shift_m, cov = spread(
            [body.seen for body in bodies],
            depths.log_depth,
            depths.variance,
            Headings(np.array(yaws_rad), sigma_rad, astray),
            self.localisation,
            self.heading,
        )
        return [
            replace(where, centre_m=where.centre_m + d, cov=where.cov + C)
            for where, d, C in zip(places, shift_m, cov, strict=True)
        ]

    def _taken(self, depths: Depths, k: int, serial: int, share: float) -> Taken:
        """`share` of the box's variance along the line of sight is left: so much of the place is still the box's."""
        return Taken(
            log_height=float(depths.log_height[k]),
            sigma_log_height=math.sqrt(float(depths.height_variance[k])),
            depth_per_height=float(depths.depth_per_height[k]) * min(share, 1.0),
            standing=self.parallax.standing(serial),
        )

    def _sizes(
        self,
        bodies: Sequence[Body],
        centres_m: Floats,
        extents_m: Floats,
        turned_rad: Floats,
        T_world_ego: SE2,
        horizon: Horizon,
    ) -> LearnedSize:
        """What the vehicles' growth in the image says of their heights."""
        for body, centre_m in zip(bodies, centres_m, strict=True):
            if body.track is None:
                d = body.seen.dimensions
                sigmas = d.sigma_height_rel, d.sigma_width_rel
                self.parallax.begin(body.serial, centre_m, T_world_ego, math.log(d.height_m), sigmas)
        seen, height_m = [body.seen for body in bodies], horizon.ground.height_m
        over_roof_m = np.array([max(0.0, height_m - o.dimensions.height_m) for o in seen])
        roof_m2 = over_roof_m * extents_m[:, 0] * horizon.config.roof_reach_rel
        sights = sights_of(seen, centres_m, extents_m, turned_rad, roof_m2)
        serials = [body.serial for body in bodies]
        return self.parallax.update(serials, sights, T_world_ego, height_m, horizon.sigma_pitch_rad)


def no_farther_than_cut(found: Depths, seen: Sequence[Observation], horizon: Horizon, tilted_rad: float) -> Depths:
    """The depths (N,), given that a box that the image's border cuts reaches at least down to where it was drawn.

    A vehicle's true bottom lies below the border, so that the nearest face of it is nearer than Eq. 1 makes of the
    border: a bound as sure as that, whose product with the Gaussian has the moments of a probit. The road tilted by
    `tilted_rad` since the slopes were taken.
    """
    bounds = {
        k: (o.slope_bottom + tilted_rad, o.sigma_cut)
        for k, o in enumerate(seen)
        if o.sigma_cut is not None and o.slope_bottom + tilted_rad > 0.0
    }
    if not bounds:
        return found
    cut, (slope, sigma_cut) = list(bounds), np.array(list(bounds.values())).T
    sigma_slope = np.hypot(sigma_cut, horizon.sigma_pitch_rad)
    height_m = horizon.ground.height_m
    doubt = np.square(sigma_slope / slope) + (horizon.config.sigma_kerb_m / height_m) ** 2
    before = found.variance[cut]
    total = before + doubt
    inside = (np.log(height_m / slope) - found.log_depth[cut]) / np.sqrt(total)  # in sigmas; < 0: it was too far off
    hazard = math.sqrt(2.0 / math.pi) / erfcx(-inside / math.sqrt(2.0))  # of the normal distribution
    log_depth, variance, depth_per_height = (
        array.copy() for array in (found.log_depth, found.variance, found.depth_per_height)
    )
    left = 1.0 - before / total * hazard * (hazard + inside)
    log_depth[cut] -= before / np.sqrt(total) * hazard
    variance[cut] *= left
    depth_per_height[cut] *= left
    return replace(found, log_depth=log_depth, variance=variance, depth_per_height=depth_per_height)
