"""Joint Kalman filter of the road's tilt and the vehicles' sizes, from the boxes of all road users.

    x = [pitch, roll, crown, errors of the images' tilt, common size and edge, vertical curvature, size of people,
         and of every vehicle: log h, log w, edge, tilt]      and, for one frame only, of every box: log z

Systematic errors of a drive or a track are states, so that they do not average out over frames. Measurements:
ground_measurements.py; states: docs/road-users.md.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera, GroundPlane, VerticalCurvature
from birdslam.road_users.models.user_filter import GrownSize, RoadStep
from birdslam.road_users.placement.localisation import Dimensions, Observation
from birdslam.road_users.state.ground_measurements import (
    BODY,
    COMMON,
    CROWN,
    CUES,
    EDGE,
    HEIGHT,
    IMAGE_PITCH,
    IMAGE_ROLL,
    LOWER,
    OUTLINE,
    OWN,
    PITCH,
    ROLL,
    SIZE,
    TILT,
    VERTICAL,
    RoadTilts,
    expected_boxes,
    robust_information,
)
from birdslam.road_users.state.ground_size_config import (
    DRIVING_MPS,
    IMAGE_PITCH_MEMORY_S,
    IMAGE_PITCH_SIGMA_REL,
    IMAGE_ROLL_MEMORY_S,
    IMAGE_VAR,
    SIGMA_BODIES_REL,
    SIGMA_COMMON_REL,
    SIGMA_PAVEMENT_REL,
    SIZE_DOF,
    TILT_MEMORY_S,
    WIDTH_DRIFT_REL,
    WIDTH_TURN_REL,
    WIDTH_TURNED_REL,
    GroundSizeConfig,
)
from birdslam.road_users.state.size_prior import MIN_VARIANCE, SizePrior

Floats = NDArray[np.float64]

ITERATIONS = 2
CURVATURE_ITERATIONS = 5
PEOPLE_ITERATIONS = 4
FLAT_VARIANCE = 1e-16  # of the vertical curvature without lanes: the road is a plane
INITIAL_DEPTH_SIGMA_LOG = 2.0
UNUSED_SIGMA = 1e3  # 1-sigma of an unused cue
_TILTS, _ROAD, _IMAGES = slice(PITCH, ROLL + 1), slice(PITCH, CROWN + 1), slice(IMAGE_PITCH, IMAGE_ROLL + 1)
_MIN_DT_S = 1e-3
_MIN_DRIVING_RATIO = 1e-6  # minimum driving fraction of a second


@dataclass(frozen=True)
class Depths:
    """One frame's boxes, (N,) each: log depth of the nearest face and log height of the vehicle, in metres."""

    log_depth: Floats
    variance: Floats
    log_height: Floats
    height_variance: Floats
    depth_per_height: Floats  # derivative of log_depth by log_height


class GroundSizeFilter:
    """Calls per frame: predict(), then estimate_depths().

    State: pitch and roll (rad) of the camera over the road, crown (rad), systematic errors of the tilt by images;
    common log factor on heights, common offset of lower edges relative to the height, common log factor on the heights
    of people; of each vehicle log height (m), log factor on the width of its outline, edge (m) and tilt (rad).
    Measurements: bottom and top slopes and log width of each box; tilt by people; pitch and roll (rad) by images.
    Readers: `placing.Placing` for depths and heights; `localisation.observe_boxes`, association, people, lanes and
    landmarks for `ground`.
    """

    def __init__(self, camera: Camera, config: GroundSizeConfig) -> None:
        self.camera = camera
        self.config = config
        self._unseen_s = np.zeros(0)  # since the last observation of each vehicle
        self._driven_s = np.zeros(0)  # driving time of the ego in it
        self._sigma_tilt = np.zeros(0)
        self._x = np.array([camera.pitch_rad, camera.roll_rad, *np.zeros(COMMON - 2)])
        self._body_var = SIGMA_BODIES_REL**2 + SIGMA_PAVEMENT_REL**2
        common = np.square([SIGMA_COMMON_REL, config.sigma_common_edge_rel])
        self._P = np.diag([*config.road_var, *IMAGE_VAR, *common, FLAT_VARIANCE, self._body_var])
        self._sizes = SizePrior(SIGMA_COMMON_REL, SIZE_DOF)
        self._image_ground = camera.ground
        self._turned_rad, self._share, self._keep_tilt = 0.0, 1.0, 1.0  # since the start; of the last step

    def __len__(self) -> int:
        return len(self._unseen_s)

    @property
    def ground(self) -> GroundPlane:
        """Estimated road under the camera."""
        return GroundPlane(self._image_ground.height_m, float(self._x[PITCH]), float(self._x[ROLL]))

    @property
    def step(self) -> RoadStep:
        """The change of the road to this frame, for the filters of road users."""
        return RoadStep(float(self._x[PITCH]) - self._turned_rad, self._share, self._keep_tilt)

    @property
    def sigma_roll_rad(self) -> float:
        """1-sigma of the ground's roll."""
        return float(np.sqrt(self._P[1, 1]))

    @property
    def sigma_pitch_rad(self) -> float:
        """1-sigma of the ground's pitch."""
        return math.sqrt(float(self._P[PITCH, PITCH]))

    @property
    def vertical_per_m(self) -> float:
        """The road's vertical curvature; > 0 if it rises ahead, over `ground` (`PLANE_AT_M`)."""
        return float(self._x[VERTICAL])

    @property
    def sigma_vertical_per_m(self) -> float:
        """1-sigma of the vertical curvature."""
        return math.sqrt(float(self._P[VERTICAL, VERTICAL]))

    @property
    def bodies(self) -> tuple[float, float]:
        """Common log factor on the heights of people, and its variance; the rest of the state is the pavement's."""
        of_bodies = SIGMA_BODIES_REL**2
        share = of_bodies / self._body_var
        return share * float(self._x[BODY]), share**2 * float(self._P[BODY, BODY]) + (1.0 - share) * of_bodies

    @property
    def tilt_cov(self) -> Floats:
        """(2, 2) covariance of the ground's pitch and roll."""
        return self._P[_TILTS, _TILTS]

    def size(self, row: int) -> tuple[float, float]:
        """(height_m, factor on the width of the outline) of a vehicle."""
        at = COMMON + OWN * row
        return math.exp(float(self._x[at + HEIGHT])), math.exp(float(self._x[at + OUTLINE]))

    def without_vehicles(self) -> GroundSizeFilter:
        """A copy without vehicles, to predict the road further."""
        ground = copy.copy(self)
        ground._unseen_s, ground._driven_s, ground._sigma_tilt = np.zeros(0), np.zeros(0), np.zeros(0)
        ground._sizes = self._sizes.without_vehicles()
        ground._x, ground._P = self._x[:COMMON].copy(), self._P[:COMMON, :COMMON].copy()
        return ground

    def add_vehicle(self, seen: Observation) -> None:
        """Adds a vehicle in the next row, with the size of its class."""
        config, dimensions = self.config, seen.dimensions
        self._unseen_s, self._driven_s = (np.append(s, config.box_memory_s) for s in (self._unseen_s, self._driven_s))
        sigma_edge_m = math.hypot(config.sigma_kerb_m, config.sigma_edge_rel * dimensions.height_m)
        self._sigma_tilt = np.append(
            self._sigma_tilt, math.hypot(config.sigma_tilt_rad, config.sigma_crown_rad * seen.bearing)
        )
        share, own_var = self._sizes.add_vehicle(dimensions.height_m, dimensions.sigma_height_rel)
        n = len(self._x)
        birth = np.zeros((n + OWN, n))  # log h = log h_class + common + own
        birth[:n] = np.eye(n)
        birth[n + HEIGHT, SIZE], birth[n + EDGE, LOWER] = share, dimensions.height_m
        self._x = birth @ self._x + np.append(np.zeros(n), [math.log(dimensions.height_m), 0.0, 0.0, 0.0])
        self._P = birth @ self._P @ birth.T
        self._P[range(-OWN, 0), range(-OWN, 0)] += [
            own_var,
            dimensions.sigma_width_rel**2,
            sigma_edge_m**2,
            self._sigma_tilt[-1] ** 2,
        ]

    def predict(
        self,
        dt_s: float,
        turn_rad: float | None,
        image_ground: GroundPlane | None,
        image_cov: Floats | None,
        travelled_m: float | None = None,
        vertical: VerticalCurvature | None = None,
    ) -> None:
        """Predicts to the next frame; `turn_rad` is the camera's pitch change (nose down > 0), or None.

        `image_ground` is the road by images with the covariance `image_cov` (2, 2) of pitch and roll, or None.
        `travelled_m` is the distance of the ego; None is treated as driving. `vertical` is the road's vertical
        curvature by lanes, or None.
        """
        config = self.config
        share = self.driving_share(dt_s, travelled_m)
        self._unseen_s = self._unseen_s + dt_s
        self._driven_s = self._driven_s + share * dt_s
        self._x[PITCH] += turn_rad or 0.0
        self._turned_rad += turn_rad or 0.0
        keep = np.exp(-share * dt_s / config.road_memory_s)
        keep_image = np.exp(-share * dt_s / np.array([IMAGE_PITCH_MEMORY_S, IMAGE_ROLL_MEMORY_S]))
        keep_tilt = math.exp(-share * dt_s / TILT_MEMORY_S)
        self._share, self._keep_tilt = share, keep_tilt
        scale = np.ones(len(self._x))
        scale[_ROAD], scale[_IMAGES], scale[COMMON + TILT :: OWN] = keep, keep_image, keep_tilt
        self._x *= scale
        self._x[_ROAD] += (1.0 - keep) * [self.camera.pitch_rad, self.camera.roll_rad, 0.0]
        self._P *= np.outer(scale, scale)
        noise = np.zeros(len(self._x))
        noise[_ROAD] = (1.0 - keep**2) * config.road_var
        noise[_IMAGES] = (1.0 - keep_image**2) * IMAGE_VAR
        noise[COMMON + TILT :: OWN] = (1.0 - keep_tilt**2) * np.square(self._sigma_tilt)
        step = config.sigma_pitch_blind_rad if turn_rad is None else config.sigma_pitch_step_rad
        noise[PITCH] += share * step**2
        self._P[np.diag_indices_from(self._P)] += noise
        self._set_vertical_curvature(vertical)
        if image_ground is not None and image_cov is not None and image_ground != self._image_ground:
            self._image_ground = image_ground
            self._correct_tilt(image_ground, image_cov / max(share, _MIN_DRIVING_RATIO))

    def rescale_outline(self, row: int, log_outline: float) -> None:
        """Compensates a yaw correction that scales the class's outline by exp(log_outline)."""
        at = COMMON + OWN * row + OUTLINE
        self._x[at] -= log_outline
        self._P[at, at] += (WIDTH_TURNED_REL * log_outline) ** 2

    def reclassify(self, row: int, dimensions: Dimensions, log_outline: float) -> None:
        """Replaces the prior of the height by that of another class, with an outline larger by exp(log_outline)."""
        at = COMMON + OWN * row
        height = dimensions.height_m, dimensions.sigma_height_rel
        self._x, self._P = self._sizes.replace(row, self._x, self._P, (at + HEIGHT, SIZE), *height)
        self._x[at + OUTLINE] -= log_outline

    def keep_rows(self, rows: Sequence[int]) -> None:
        """Removes the vehicles of all other rows; the road stays."""
        at = [*range(COMMON), *(COMMON + OWN * row + k for row in rows for k in range(OWN))]
        self._unseen_s, self._driven_s = self._unseen_s[rows], self._driven_s[rows]
        self._sigma_tilt = self._sigma_tilt[rows]
        self._sizes.keep_rows(rows)
        self._x, self._P = self._x[at], self._P[np.ix_(at, at)]

    def estimate_depths(
        self,
        rows: Sequence[int],
        seen: Sequence[Observation],
        outlines_m: Floats,
        extents_m: Floats,
        turned_rad: Floats,
        learned: GrownSize | None = None,
    ) -> Depths:
        """Returns the depths of all boxes (N) of this frame; updates tilt and sizes.

        `outlines_m` and `extents_m` (N,) are the class's extent across and along the line of sight at its yaw;
        `turned_rad` (N,) is the rotation of the line of sight since the last observation. Observations are relative to
        the current `ground`. `learned` (N,), sizes by growth, affects the returned depths but not the state.
        """
        n = len(seen)
        if not n:
            return Depths(*np.zeros((5, 0)))
        at = COMMON + OWN * np.array(rows)
        self._P[at + OUTLINE, at + OUTLINE] += self._outline_drift(rows, turned_rad, learned)
        tops = np.array([o.slope_top for o in seen])
        slopes = np.array([o.slope_bottom for o in seen])
        bearing = np.array([o.bearing for o in seen])
        sigma_slope = np.array([[o.sigma_bottom, o.sigma_top] for o in seen])
        log_width = np.log([o.tan_width for o in seen])
        sigma_width = np.array([math.hypot(o.sigma_left, o.sigma_right) / o.tan_width for o in seen])
        z = np.concatenate([slopes, tops, log_width - np.log(outlines_m)])
        R0 = np.concatenate([sigma_slope[:, 0] ** 2, sigma_slope[:, 1] ** 2, sigma_width**2])
        R0[np.repeat([cue not in self.config.cues for cue in CUES], n)] = UNUSED_SIGMA**2
        log_z, P_z, log_h, P_h, P_zh = self._iterate(
            at, bearing, extents_m * self.config.roof_reach_rel, z, R0, self._correlated_frames(rows, learned)
        )
        self._x, self._P = self._sizes.reweigh(rows, self._x, self._P, at, SIZE)
        if learned is None:
            return Depths(log_z, P_z, log_h, P_h, P_zh / P_h)
        depth, height = (
            _pulled(mean, variance, cross, learned, log_h, P_h)
            for mean, variance, cross in ((log_z, P_z, P_zh), (log_h, P_h, P_h))
        )
        return Depths(*depth, *height, P_zh / P_h)

    def _outline_drift(self, rows: Sequence[int], turned_rad: Floats, learned: GrownSize | None) -> Floats:
        """Returns (N,) the growth of the variance of each log outline since it was last seen.

        The line of sight turns with the ego motion, and for a moving vehicle with its own speed. The outline of a
        car that is seen from behind doubles within 30 degrees.
        """
        config = self.config
        own_turn = 0.0 if learned is None else config.bend_per_m * learned.speed_mps  # per second
        own_var = np.square(own_turn) * self._unseen_s[rows]
        out: Floats = WIDTH_DRIFT_REL**2 + WIDTH_TURN_REL**2 * (np.square(turned_rad) + own_var)
        return out

    def driving_share(self, dt_s: float, travelled_m: float | None) -> float:
        """Driving fraction of a step of the ego; a step of unknown length is treated as driving."""
        if travelled_m is None:
            return 1.0
        return -math.expm1(-travelled_m / max(dt_s, _MIN_DT_S) / DRIVING_MPS)

    def _correlated_frames(self, rows: Sequence[int], learned: GrownSize | None) -> Floats:
        """(N,) number of consecutive frames with the same error, from the change of view since the last observation.

        Errors of a box decorrelate as ego or vehicle move. While both are stationary, all images show the same error.
        """
        speed_mps = np.zeros(len(rows)) if learned is None else learned.speed_mps
        stationary_s = (self._unseen_s - self._driven_s)[rows] * np.exp(-speed_mps / DRIVING_MPS)
        changed_s = np.maximum(self._unseen_s[rows] - stationary_s, _MIN_DRIVING_RATIO)
        correlated: Floats = np.maximum(1.0, self.config.box_memory_s / changed_s)
        self._unseen_s[rows] = self._driven_s[rows] = 0.0
        return correlated

    def _iterate(
        self, at: NDArray[np.intp], bearing: Floats, reach: Floats, z: Floats, R: Floats, correlated: Floats
    ) -> tuple[Floats, Floats, Floats, Floats, Floats]:
        """log z and its variances, log h and its variances, and their covariances, (N,) each.

        They use this frame's boxes with noise R. The stored state uses inflated noise, for correlated errors.
        """
        n, m = len(at), len(self._x)
        ground = self._image_ground.height_m, self._x[_TILTS].copy()
        # Initial depth from the prior height and the height of the box
        log_z = self._x[at] - np.log(np.maximum(z[:n] - z[n : 2 * n], 1e-3))
        prior = np.concatenate([self._x, log_z])
        P = np.zeros((m + n, m + n))
        P[:m, :m] = self._P
        P[range(m, m + n), range(m, m + n)] = INITIAL_DEPTH_SIGMA_LOG**2
        x = prior.copy()
        for iteration in range(ITERATIONS):
            expected, J = expected_boxes(x, at, bearing, reach, *ground)
            PJt = P @ J.T
            S = J @ PJt
            innovation = z - expected - J @ (prior - x)
            gate_sigma = self.config.gate_sigma if iteration == ITERATIONS - 1 else math.inf
            gain = PJt @ robust_information(S + np.diag(R), innovation, gate_sigma)
            gain[VERTICAL] = 0.0
            x = prior + gain @ innovation
        P = P - gain @ PJt.T
        P[VERTICAL] = P[:, VERTICAL]
        lasting = S + np.diag(R * np.tile(correlated, len(CUES)))
        kept = PJt[:m] @ robust_information(lasting, innovation, self.config.gate_sigma)
        kept[VERTICAL] = 0.0
        kept_P = self._P - kept @ PJt[:m].T
        kept_P[VERTICAL] = kept_P[:, VERTICAL]
        self._x, self._P = prior[:m] + kept @ innovation, (kept_P + kept_P.T) / 2.0
        return x[m:], np.diag(P)[m:].copy(), x[at], np.maximum(P[at, at], MIN_VARIANCE), P[range(m, m + n), at]

    def _correct_tilt(self, by_images: GroundPlane, cov: Floats) -> None:
        """Updates with pitch and roll by images, which have systematic errors."""
        sigma_rel = np.array([IMAGE_PITCH_SIGMA_REL, 1.0])
        PHt = self._P[:, _TILTS] + self._P[:, _IMAGES]
        gain = PHt @ np.linalg.inv(PHt[_TILTS] + PHt[_IMAGES] + cov * np.outer(sigma_rel, sigma_rel))
        expected = self._x[_TILTS] + self._x[_IMAGES]
        self._update(gain, np.array([by_images.pitch_rad, by_images.roll_rad]) - expected, PHt)

    def correct_by_people(self, people: RoadTilts) -> None:
        """Updates with the boxes of people; outliers are children and people with hidden feet (Cauchy)."""
        if not len(people.tilt_rad):
            return
        J = np.zeros((len(people.tilt_rad), len(self._x)))
        J[:, PITCH], J[:, ROLL], J[:, BODY] = 1.0, -people.bearing, people.slope
        innovation = people.tilt_rad - people.slope * self._x[BODY]
        PJt = self._P @ J.T
        S = J @ PJt
        residual = np.zeros(len(innovation))
        for _ in range(PEOPLE_ITERATIONS):
            outlying = 1.0 + np.square(residual) / people.variance / 4.0
            gain = PJt @ np.linalg.inv(S + np.diag(people.variance * people.correlated * outlying))
            residual = innovation - J @ (gain @ innovation)
        self._update(gain, innovation, PJt)

    def _update(self, gain: Floats, innovation: Floats, PJt: Floats) -> None:
        gain[VERTICAL] = 0.0
        self._x = self._x + gain @ innovation
        P = self._P - gain @ PJt.T
        P[VERTICAL] = P[:, VERTICAL]
        self._P = (P + P.T) / 2.0

    def _set_vertical_curvature(self, by_lanes: VerticalCurvature | None) -> None:
        """Sets the vertical curvature from lanes; boxes do not correct it (Schmidt-Kalman filter).

        A common offset of the lower edges or of the heights looks like a sag.
        """
        config = self.config
        mean, variance = 0.0, FLAT_VARIANCE
        if by_lanes is not None:
            mean, variance = estimate_curvature(by_lanes, config.sigma_vertical_per_m, config.vertical_dof)
        ratio = math.sqrt(variance / self._P[VERTICAL, VERTICAL])
        self._P[VERTICAL] *= ratio
        self._P[:, VERTICAL] *= ratio
        self._P[VERTICAL, VERTICAL] = variance  # without rounding errors
        self._x[VERTICAL] = mean


def estimate_curvature(by_lanes: VerticalCurvature, scale_per_m: float, dof: float) -> tuple[float, float]:
    """(mean, variance) of the vertical curvature, from lanes and a Student's t prior of roads.

    The t allows hills and suppresses small curvatures. Its weight is found by fixed-point iterations (EM).
    """
    mean, variance = by_lanes.per_m, by_lanes.sigma_per_m**2
    for _ in range(CURVATURE_ITERATIONS):
        of_roads = (dof * scale_per_m**2 + mean**2) / (dof + 1.0)
        variance = 1.0 / (1.0 / of_roads + by_lanes.sigma_per_m**-2)
        mean = variance * by_lanes.per_m / by_lanes.sigma_per_m**2
    return mean, variance


def _pulled(
    mean: Floats, variance: Floats, cross: Floats, by: GrownSize, log_h: Floats, P_h: Floats
) -> tuple[Floats, Floats]:
    """Mean and variance (N,), given the log height by growth if stationary; `cross` is the covariance with log_h."""
    gain, p = cross / (P_h + by.variance), by.stationary
    step = gain * (by.log_height - log_h)
    return mean + p * step, variance - p * gain * cross + p * (1.0 - p) * np.square(step)
