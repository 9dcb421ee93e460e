"""Places of all vehicles of a frame from every measurement of depth.

Sizes by growth (models/user_filter.py), Eq. 1 on all boxes with one road (ground_size_filter.py), the uncertain yaw
(uncertain_yaw.py), and the depth map if there is one (pseudolidar.py). Add a new source of places to `Placing.locate`,
a new filter to `Placing._add_vehicles`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry import bev
from birdslam.geometry.bev import RoadProfile
from birdslam.geometry.se2 import SE2, wrap
from birdslam.road_users.association import in_ego
from birdslam.road_users.models.user_boxes import Boxes
from birdslam.road_users.models.user_filter import GrownSize, UserFilter
from birdslam.road_users.placement.depth_fusion import DepthPlace, PseudoLidarConfig, fuse
from birdslam.road_users.placement.localisation import (
    MIN_DISTANCE_M,
    AssumedSize,
    LocalisationConfig,
    Observation,
    Place,
    centre_at,
    extent_m,
    place,
)
from birdslam.road_users.placement.tyre_contact import bottom_at_face
from birdslam.road_users.placement.uncertain_yaw import (
    HeadingConfig,
    YawPrior,
    evaluate_yaws,
    initial_yaw_rad,
    make_fan,
    weigh_yaws,
)
from birdslam.road_users.placement.vehicle_boxes import (
    ITERATIONS,
    KINDS,
    SIGMA_ODD_REL,
    SIGMA_SIDE_OUTLIER_REL,
    measure_boxes,
    vehicle_kinds,
)
from birdslam.road_users.state.ground_size_filter import Depths, GroundSizeFilter
from birdslam.road_users.state.yaw_by_outline import YawByOutline
from birdslam.road_users.track import VehicleTrack

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Assignment:
    """An observation with its track, None for a new vehicle, and its place by depth.

    `row` is the row of the vehicle in `Tracker.tracks` and in each filter.
    """

    row: int
    track: VehicleTrack | None
    observation: Observation
    by_depth: DepthPlace | None = None

    def yaw_rad(self, T_world_ego: SE2, config: HeadingConfig) -> float:
        """Yaw in ego; for a new vehicle from the body, or from the shape of the box if its front is unknown."""
        if self.track is None:
            if self.by_depth is not None and self.by_depth.has_front:
                return self.by_depth.yaw_rad
            return initial_yaw_rad(self.observation, config)
        return wrap(self.track.yaw_rad - T_world_ego.yaw_rad)

    def yaw_uncertainty(self, config: HeadingConfig) -> tuple[float, float]:
        """1-sigma of the yaw (rad), and the probability that it is an outlier."""
        if self.track is None:
            if self.by_depth is not None and self.by_depth.has_front:
                return self.by_depth.sigma_yaw_rad, config.outlier_known
        elif self.track.is_yaw_known:
            return self.track.sigma_yaw_rad, config.outlier_known
        return config.sigma_along_road_rad, config.outlier_unknown

    @property
    def is_yaw_known(self) -> bool:
        """Whether motion or body measured the yaw."""
        if self.track is None:
            return self.by_depth is not None and self.by_depth.has_front
        return self.track.is_yaw_known

    def expected_depth_m(self, T_world_ego: SE2) -> float:
        """Predicted depth of the nearest face, from the track or the height of the class."""
        if self.track is None:
            return self.observation.depth_by_height_m
        reach_m = float(self.track.place.centre_m[0]) - self.track.place.depth_m
        return max(MIN_DISTANCE_M, in_ego(T_world_ego, self.track.predicted_m)[0] - reach_m)

    def turned_rad(self, T_world_ego: SE2) -> float:
        """Rotation over the ground of the line of sight since the last observation."""
        if self.track is None:
            return 0.0
        before = math.atan(self.track.observation.bearing) + self.track.frame.T_world_ego.yaw_rad
        return wrap(math.atan(self.observation.bearing) + T_world_ego.yaw_rad - before)


@dataclass(frozen=True)
class _Prediction:
    """Predicted vehicles (N) of a frame in ego."""

    yaw_rad: list[float]
    centre_m: Floats  # (N, 2)
    extent_m: Floats  # (N, 2) as of `localisation.extent_m`
    turned_rad: Floats  # (N,)


class Placing:
    """Calls per frame: predict(), then locate().

    Its state is that of its filters, `UserFilter`, `GroundSizeFilter` and `YawByOutline`. Readers: the tracker for
    places (m, with covariances), the smoother for the assumed sizes.
    """

    def __init__(
        self,
        ground_size: GroundSizeFilter,
        localisation: LocalisationConfig,
        pseudolidar: PseudoLidarConfig,
        heading: HeadingConfig,
    ) -> None:
        import scipy.special  # noqa: F401  # imported with the tracker, not with the first cut box

        self.ground_size = ground_size
        self.localisation = localisation
        self.heading = heading
        self.pseudolidar = pseudolidar
        self.users = UserFilter(KINDS)
        self.yaw_by_outline = YawByOutline(heading)

    def predict(self, dt_s: float, T_world_ego: SE2, step_cov: Floats | None) -> None:
        """Predicts to the ego pose of the next frame; `step_cov` (3, 3) is the covariance of the step."""
        self.users.predict(dt_s, T_world_ego, step_cov, self.ground_size.step)
        self.yaw_by_outline.predict(dt_s, T_world_ego)

    def locate(self, assignments: Sequence[Assignment], T_world_ego: SE2) -> list[Place]:
        """Returns one place in ego per assignment; updates the tilt of the road and the sizes."""
        assignments = self._with_face_bottoms(assignments, T_world_ego)
        expected = self._expected(assignments, T_world_ego)
        boxes = self._measure(assignments, expected, T_world_ego)
        self._add_vehicles(assignments, expected, boxes, T_world_ego)
        sizes, outlier = self._sizes_by_growth(assignments, boxes, T_world_ego)
        assignments = self._with_side_outliers(assignments, outlier)
        depths = _depths_by_eq_1(assignments, expected, sizes, self.ground_size)
        self.users.set_common_priors(np.array([(0.0, self.ground_size.sigma_pitch_rad**2), (0.0, 0.0)]))
        by_eq_1 = self._places_at(depths, assignments, expected.yaw_rad, T_world_ego)
        # Fuse the two sources of Fig. 2
        fused = [fuse(where, a.by_depth, self.pseudolidar) for where, a in zip(by_eq_1, assignments, strict=True)]
        return [
            msgspec.structs.replace(
                both, assumed=self._assumed_size(depths, k, a.row, float(both.cov[0, 0] / one.cov[0, 0]))
            )
            for k, (both, one, a) in enumerate(zip(fused, by_eq_1, assignments, strict=True))
        ]

    def _with_face_bottoms(self, assignments: Sequence[Assignment], T_world_ego: SE2) -> list[Assignment]:
        """Moves the lower edges of boxes that end at the tyres to the nearest face."""
        height_m = self.ground_size.ground.height_m
        out = []
        for a in assignments:
            yaw_rad = a.yaw_rad(T_world_ego, self.heading)
            out.append(replace(a, observation=bottom_at_face(a.observation, yaw_rad, height_m, self.localisation)))
        return out

    def _expected(self, assignments: Sequence[Assignment], T_world_ego: SE2) -> _Prediction:
        yaws = [a.yaw_rad(T_world_ego, self.heading) for a in assignments]
        depths = [a.expected_depth_m(T_world_ego) for a in assignments]
        turned = [a.turned_rad(T_world_ego) for a in assignments]
        each = [(a.observation, yaw, depth) for a, yaw, depth in zip(assignments, yaws, depths, strict=True)]
        centres = [centre_at(o, depth, yaw, self.localisation)[:2] for o, yaw, depth in each]
        extents = [extent_m(o.dimensions, yaw, depth, o.bearing) for o, yaw, depth in each]
        return _Prediction(
            yaws, np.array(centres).reshape(-1, 2), np.array(extents).reshape(-1, 2), np.array(turned, dtype=np.float64)
        )

    def _measure(self, assignments: Sequence[Assignment], expected: _Prediction, T_world_ego: SE2) -> Boxes:
        """The measurements of the boxes."""
        seen, height_m = [a.observation for a in assignments], self.ground_size.ground.height_m
        is_below = np.array([height_m > o.dimensions.height_m for o in seen], dtype=np.bool_)
        top_m = is_below * expected.extent_m[:, 0] * self.ground_size.config.roof_reach_rel
        direction_rad = np.array(expected.yaw_rad) + T_world_ego.yaw_rad
        return measure_boxes(seen, expected.centre_m, expected.extent_m, expected.turned_rad, direction_rad, top_m)

    def _add_vehicles(
        self, assignments: Sequence[Assignment], expected: _Prediction, boxes: Boxes, T_world_ego: SE2
    ) -> None:
        """Adds the new vehicles, each in the next row of every filter."""
        new = [k for k, a in enumerate(assignments) if a.track is None]
        if not new:
            return
        dimensions = [assignments[k].observation.dimensions for k in new]
        heights = np.array([[(d.height_m, sigma) for sigma in (d.sigma_height_rel, SIGMA_ODD_REL)] for d in dimensions])
        widths = np.array([d.sigma_width_rel for d in dimensions])
        self.users.add(vehicle_kinds(expected.centre_m[new]), boxes.take(new), heights, widths, T_world_ego)
        for k in new:
            self.ground_size.add_vehicle(assignments[k].observation)
            self.yaw_by_outline.add_vehicle()

    def _sizes_by_growth(
        self, assignments: Sequence[Assignment], boxes: Boxes, T_world_ego: SE2
    ) -> tuple[GrownSize | None, Floats]:
        """Heights of the vehicles from the growth of their boxes, and probabilities (N, 2) of outlying sides."""
        rows, road = [a.row for a in assignments], self.ground_size
        if not rows:
            return None, np.zeros((0, 2))
        profile = RoadProfile(road.ground.height_m, road.vertical_per_m)
        cases = self.users.correct(rows, boxes, T_world_ego, profile, ITERATIONS)
        return self.users.sizes_by_growth(rows, boxes, T_world_ego), cases[:, 1:3]

    def _with_side_outliers(self, assignments: Sequence[Assignment], outlier: Floats) -> list[Assignment]:
        """Raises the sigmas of probable outlier sides of boxes, with probabilities (N, 2)."""
        sigma_rel = SIGMA_SIDE_OUTLIER_REL * np.sqrt(outlier)
        out = []
        for a, (left_rel, right_rel) in zip(assignments, sigma_rel.tolist(), strict=True):
            seen = a.observation
            sigma_left = math.hypot(seen.sigma_left, left_rel * seen.tan_width)
            sigma_right = math.hypot(seen.sigma_right, right_rel * seen.tan_width)
            widened = msgspec.structs.replace(seen, sigma_left=sigma_left, sigma_right=sigma_right)
            out.append(replace(a, observation=widened))
        return out

    def _places_at(
        self, depths: Depths, assignments: Sequence[Assignment], yaws_rad: Sequence[float], T_world_ego: SE2
    ) -> list[Place]:
        """Places at these depths, with the uncertainty of depths and yaws."""
        seen = [a.observation for a in assignments]
        if not seen:
            return []
        sigma_rad, outlier = np.array([a.yaw_uncertainty(self.heading) for a in assignments]).T
        prior = YawPrior(np.array(yaws_rad), sigma_rad, outlier)
        yaws = make_fan(prior, self.yaw_by_outline.grid_rad - T_world_ego.yaw_rad)
        fan = evaluate_yaws(seen, depths.log_depth, yaws, self.localisation.reach_rel)
        weight = weigh_yaws(fan, depths.variance, prior, self.heading)
        near = yaws.shape[1] - len(self.yaw_by_outline.grid_rad)
        unknown = [k for k, a in enumerate(assignments) if not a.is_yaw_known]
        if unknown:
            weight[unknown, :near] = 0.0
            weight[unknown, near:] = self.yaw_by_outline.weigh(
                [assignments[k].row for k in unknown],
                fan.residual[unknown, near:],
                fan.box_variance[unknown],
                depths.variance[unknown],
                np.exp(depths.log_depth[unknown]),
            )
        shift_m, cov = fan.marginalised(weight)
        numbers = zip(seen, depths.log_depth.tolist(), depths.variance.tolist(), yaws_rad, shift_m, cov, strict=True)
        out = []
        for observation, log_depth, variance, yaw_rad, d, C in numbers:
            where = place(observation, log_depth, variance, yaw_rad, self.localisation)
            out.append(Place(where.depth_m, where.centre_m + d, where.cov + C))
        return out

    def _assumed_size(self, depths: Depths, k: int, row: int, share: float) -> AssumedSize:
        """Assumed size of the k-th place; `share` is the ratio of its depth variance after fusion to that before."""
        return AssumedSize(
            log_height=float(depths.log_height[k]),
            sigma_log_height=math.sqrt(float(depths.height_variance[k])),
            depth_per_height=float(depths.depth_per_height[k]) * min(share, 1.0),
            standing=float(self.users.stationary_probability()[row]),
        )


def _depths_by_eq_1(
    assignments: Sequence[Assignment], expected: _Prediction, sizes: GrownSize | None, ground_size: GroundSizeFilter
) -> Depths:
    """Depths (N,) of the nearest faces, from all boxes with one road."""
    seen, rows = [a.observation for a in assignments], [a.row for a in assignments]
    pitch_rad = ground_size.ground.pitch_rad
    depths = ground_size.estimate_depths(
        rows, seen, expected.extent_m[:, 1], expected.extent_m[:, 0], expected.turned_rad, sizes
    )
    return truncate_at_cut(depths, seen, ground_size, ground_size.ground.pitch_rad - pitch_rad)


def truncate_at_cut(
    depths: Depths, seen: Sequence[Observation], ground_size: GroundSizeFilter, tilted_rad: float
) -> Depths:
    """Conditions the depths (N,) on the lower bound of the bottom of boxes that the image border cuts.

    The true bottom is below the border, so the face is nearer than Eq. 1 gives. The product of the uncertain bound and
    the Gaussian of the depth has the moments of a probit. `tilted_rad` is the change of the road's tilt since the
    slopes were taken.
    """
    bounds = {
        k: (o.slope_bottom + tilted_rad, o.sigma_cut)
        for k, o in enumerate(seen)
        if o.sigma_cut is not None and o.slope_bottom + tilted_rad > 0.0
    }
    if not bounds:
        return depths
    from scipy.special import erfcx  # lazy: only processes that track need it (see `Placing`)

    cut, (slope, sigma_cut) = list(bounds), np.array(list(bounds.values())).T
    sigma_slope = np.hypot(sigma_cut, ground_size.sigma_pitch_rad)
    height_m = ground_size.ground.height_m
    bound_var = np.square(sigma_slope / slope) + (ground_size.config.sigma_kerb_m / height_m) ** 2
    before = depths.variance[cut]
    total = before + bound_var
    bound_m = bev.meet_road(np.ones_like(slope), slope, height_m)  # Eq. 1
    inside = (np.log(bound_m) - depths.log_depth[cut]) / np.sqrt(total)  # in sigmas; < 0: the depth was too large
    hazard = math.sqrt(2.0 / math.pi) / erfcx(-inside / math.sqrt(2.0))  # of the normal distribution
    log_depth, variance, depth_per_height = (
        array.copy() for array in (depths.log_depth, depths.variance, depths.depth_per_height)
    )
    left = 1.0 - before / total * hazard * (hazard + inside)
    log_depth[cut] -= before / np.sqrt(total) * hazard
    variance[cut] *= left
    depth_per_height[cut] *= left
    return replace(depths, log_depth=log_depth, variance=variance, depth_per_height=depth_per_height)
