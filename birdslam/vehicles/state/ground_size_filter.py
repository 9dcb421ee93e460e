"""The road's tilt and the vehicles' sizes, each from the other, by the boxes of the vehicles alone.

    x = [pitch, roll, and of every vehicle: log h, log w, edge, tilt]   and, for one frame only, of every box: log z

One Kalman filter holds them all. With H the camera's height, y/x the bearing, r on to the roof's far edge where the
camera looks down on it, and slopes that count downwards from the plane of the road, a box measures
bottom = (H + edge) / z - pitch - tilt + roll y/x (Eq. 1), top = (H - h) / (z + r) - pitch - tilt + roll y/x, and
log width = log w + log(class's outline) - log z.

What is wrong with one vehicle for as long as it is in sight is a state, so that its many frames don't average it away:
`edge` is by how much its box ends lower than the ego's plane at its face (m: the kerb, and where the detector draws the
edge of this vehicle), `tilt` by how much the road at it is tilted against the ego's (rad).
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry import bev
from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.vehicles.placement.localisation import Observation
from birdslam.vehicles.state.parallax import LearnedSize

Floats = NDArray[np.float64]

COMMON, OWN = 2, 4  # states: pitch, roll; and of each vehicle log h, log w, edge, tilt
HEIGHT, OUTLINE, EDGE, TILT = range(OWN)
Cue = Literal["bottom", "top", "width"]
CUES: tuple[Cue, ...] = ("bottom", "top", "width")  # measurements of each box, in this order
ITERATIONS = 2
DEPTH_UNKNOWN = 2.0  # 1-sigma of log z before a frame is seen
UNUSED = 1e3  # 1-sigma of a cue that is not used
_MIN_VARIANCE = 1e-12  # variance of a height that its class knows exactly
_MIN_DT_S = 1e-3
_MIN_SHARE = 1e-6  # of a second, that counts as driving


class GroundSizeConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Priors of roads and vehicles, and how long the errors of a box last."""

    sigma_pitch_rad: float = 0.010  # of the camera over real roads against its calibration
    pitch_memory_s: float = 5.0  # of driving: how long the pitch's deviation from the calibration lasts
    sigma_pitch_step_rad: float = 0.0008  # a frame of driving: the road's change of grade, and the odometry's error
    sigma_pitch_blind_rad: float = 0.003  # a frame without odometry
    sigma_roll_rad: float = 0.02  # of the camera over real roads against its calibration
    roll_memory_s: float = 20.0  # of driving: how long the roll's deviation lasts
    # Road and views change with time far above this speed, and with the way far below it: of a second, 1 - exp(-speed /
    # this) is of driving. KITTI tracking chose between it and 3 m/s
    driving_mps: float = 1.0
    sigma_kerb_m: float = 0.018  # how far the road under a vehicle lies off the ego's plane, whatever its distance
    sigma_edge_rel: float = 0.022  # of its height: a detector draws the lower edge of one vehicle alike in all frames
    sigma_tilt_rad: float = 0.0017  # of the road at a vehicle against the ego's
    sigma_crown_rad: float = 0.0047  # and the more the farther it stands to the side, a unit of y/x
    tilt_memory_s: float = 5.0  # of driving: how long that tilt lasts
    width_drift_rel: float = 0.002  # of the outline, a frame
    width_turn_rel: float = 1.0  # of the outline, a radian that the line of sight turned: the yaw is not known as well
    # 1-sigma of the curvature of a vehicle's own way: a bend of 200 m. KITTI tracking chose between it and 100 m
    bend_per_m: float = 0.005
    width_turned_rel: float = 0.6  # of a change of the outline that comes of a yaw newly learned
    roof_reach_rel: float = 0.6  # of the vehicle's extent along the line of sight, to the edge of its roof
    cues: tuple[Cue, ...] = ("bottom", "top", "width")  # which measurements of a box are used
    gate_sigma: float = 2.0  # past it a measurement is an outlier: its weight falls with its residual (Huber)
    image_pitch_frames: float = 5.0  # for how long the error of a pitch from the images lasts
    box_memory_s: float = 0.5  # for so long a box has the same error: this time of driving counts as one box


@dataclass(frozen=True)
class Depths:
    """Of one frame's boxes, (N,) each: logs of the nearest faces' depths and of the vehicles' heights, in metres."""

    log_depth: Floats
    variance: Floats
    log_height: Floats
    height_variance: Floats
    depth_per_height: Floats  # derivative of log_depth by log_height


class GroundSizeFilter:
    """predict() once a frame, then estimate_depths() of its boxes.

    State: pitch and roll (rad) of the camera over the road; of each vehicle the log of its height in metres, the log of
    its outline's width as a factor, and its kerb (m). Measurements: of each box the slopes of bottom and top and the
    log of its width (see the module); the pitch (rad) by the images. `placing.Placing` reads depths and heights;
    `ground` is read by `localisation.observe_boxes`, by association, and by the front end's lanes and landmarks.
    """

    def __init__(self, camera: Camera, config: GroundSizeConfig) -> None:
        self.camera = camera
        self.config = config
        self._unseen_s = np.zeros(0)  # of each vehicle
        self._driven_s = np.zeros(0)  # and how much of that counts as driving of the ego
        self._sigma_tilt = np.zeros(0)
        self._x = np.array([camera.pitch_rad, camera.roll_rad])
        self._P = np.diag([config.sigma_pitch_rad**2, config.sigma_roll_rad**2])
        self._image_ground = camera.ground

    def __len__(self) -> int:
        return len(self._unseen_s)

    @property
    def ground(self) -> GroundPlane:
        """The estimate of the road under the camera."""
        return GroundPlane(self._image_ground.height_m, float(self._x[0]), float(self._x[1]))

    @property
    def sigma_roll_rad(self) -> float:
        """1-sigma of the ground's roll."""
        return float(np.sqrt(self._P[1, 1]))

    @property
    def sigma_pitch_rad(self) -> float:
        """1-sigma of its pitch."""
        return math.sqrt(float(self._P[0, 0]))

    def size(self, row: int) -> tuple[float, float]:
        """(height_m, factor of the outline's width) as learned of a vehicle."""
        at = COMMON + OWN * row
        return math.exp(float(self._x[at])), math.exp(float(self._x[at + 1]))

    def without_vehicles(self) -> GroundSizeFilter:
        """A copy without vehicles, to predict the road further while this one stays."""
        ground = copy.copy(self)
        ground._unseen_s, ground._driven_s, ground._sigma_tilt = np.zeros(0), np.zeros(0), np.zeros(0)
        ground._x, ground._P = self._x[:COMMON].copy(), self._P[:COMMON, :COMMON].copy()
        return ground

    def begin(self, seen: Observation) -> None:
        """A vehicle seen for the first time, in the next row: of its class's size until boxes correct it."""
        config, dimensions = self.config, seen.dimensions
        self._unseen_s, self._driven_s = (np.append(s, config.box_memory_s) for s in (self._unseen_s, self._driven_s))
        sigma_edge_m = math.hypot(config.sigma_kerb_m, config.sigma_edge_rel * dimensions.height_m)
        self._sigma_tilt = np.append(
            self._sigma_tilt, math.hypot(config.sigma_tilt_rad, config.sigma_crown_rad * seen.bearing)
        )
        self._x = np.append(self._x, [math.log(dimensions.height_m), 0.0, 0.0, 0.0])
        P = np.zeros((len(self._x), len(self._x)))
        P[:-OWN, :-OWN] = self._P
        P[range(-OWN, 0), range(-OWN, 0)] = np.square(
            [dimensions.sigma_height_rel, dimensions.sigma_width_rel, sigma_edge_m, self._sigma_tilt[-1]]
        )
        self._P = P

    def predict(
        self,
        dt_s: float,
        turn_rad: float | None,
        image_ground: GroundPlane | None,
        image_sigma_rad: float,
        travelled_m: float | None = None,
    ) -> None:
        """To the next frame: `turn_rad` the camera's own pitching (nose down > 0), None where it is not known.

        `image_ground` is the road by the images, None where they don't measure it. `travelled_m` is the ego's way, None
        where it is not known: it is taken to drive.
        """
        config = self.config
        share = 1.0 if travelled_m is None else self._driving_share(travelled_m / max(dt_s, _MIN_DT_S))
        self._unseen_s = self._unseen_s + dt_s
        self._driven_s = self._driven_s + share * dt_s
        calibrated = np.array([self.camera.pitch_rad, self.camera.roll_rad])
        sigma = np.array([config.sigma_pitch_rad, config.sigma_roll_rad])
        keep = np.exp(-share * dt_s / np.array([config.pitch_memory_s, config.roll_memory_s]))
        step = config.sigma_pitch_blind_rad if turn_rad is None else config.sigma_pitch_step_rad
        self._x[0] += turn_rad or 0.0
        self._x[:COMMON] = calibrated + keep * (self._x[:COMMON] - calibrated)
        keep_tilt = math.exp(-share * dt_s / config.tilt_memory_s)
        scale = np.ones(len(self._x))
        scale[:COMMON], scale[COMMON + TILT :: OWN] = keep, keep_tilt
        self._x[COMMON + TILT :: OWN] *= keep_tilt
        self._P *= np.outer(scale, scale)
        noise = np.zeros(len(self._x))
        noise[:COMMON] = (1.0 - keep**2) * sigma**2
        noise[COMMON + TILT :: OWN] = (1.0 - keep_tilt**2) * np.square(self._sigma_tilt)
        noise[0] += share * step**2
        self._P[np.diag_indices_from(self._P)] += noise
        if image_ground is not None and image_ground != self._image_ground:
            self._image_ground = image_ground
            self._correct_pitch(
                image_ground.pitch_rad,
                image_sigma_rad * math.sqrt(config.image_pitch_frames / max(share, _MIN_SHARE)),
            )

    def rescale_outline(self, row: int, log_outline: float) -> None:
        """The vehicle's yaw was corrected, so that its class's outline grows by exp(log_outline); its box does not."""
        at = COMMON + OWN * row + 1
        self._x[at] -= log_outline
        self._P[at, at] += (self.config.width_turned_rel * log_outline) ** 2

    def keep_rows(self, rows: Sequence[int]) -> None:
        """Forget the vehicles of all other rows; what was learned of the road from them stays."""
        at = [*range(COMMON), *(COMMON + OWN * row + k for row in rows for k in range(OWN))]
        self._unseen_s, self._driven_s = self._unseen_s[rows], self._driven_s[rows]
        self._sigma_tilt = self._sigma_tilt[rows]
        self._x, self._P = self._x[at], self._P[np.ix_(at, at)]

    def estimate_depths(
        self,
        rows: Sequence[int],
        seen: Sequence[Observation],
        outlines_m: Floats,
        extents_m: Floats,
        turned_rad: Floats,
        learned: LearnedSize | None = None,
    ) -> Depths:
        """The depths of all of this frame's boxes (N) together; the filter learns tilt and sizes from them.

        `outlines_m` and `extents_m` (N,): what each class measures across and along the line of sight at its yaw;
        `turned_rad` (N,): by how much that line turned since last seen. Observations are against the present `ground`.
        `learned` (N, K), sizes by parallax, counts in the depths that are returned and is not kept: the parallax filter
        gives it anew in each frame.
        """
        n = len(seen)
        if not n:
            return Depths(*np.zeros((5, 0)))
        at = COMMON + OWN * np.array(rows)
        self._P[at + 1, at + 1] += self._outline_drift(rows, turned_rad, learned)
        tops = np.array([o.slope_top for o in seen])
        slopes = np.array([o.slope_bottom for o in seen])
        bearing = np.array([o.bearing for o in seen])
        sigma_slope = np.array([[o.sigma_bottom, o.sigma_top] for o in seen])
        log_width = np.log([o.tan_width for o in seen])
        sigma_width = np.array([math.hypot(o.sigma_left, o.sigma_right) / o.tan_width for o in seen])
        z = np.concatenate([slopes, tops, log_width - np.log(outlines_m)])
        R0 = np.concatenate([sigma_slope[:, 0] ** 2, sigma_slope[:, 1] ** 2, sigma_width**2])
        R0[np.repeat([cue not in self.config.cues for cue in CUES], n)] = UNUSED**2
        log_z, P_z, log_h, P_h, P_zh = self._iterate(
            at, bearing, extents_m * self.config.roof_reach_rel, z, R0, self._correlated_frames(rows, learned)
        )
        if learned is None:
            return Depths(log_z, P_z, log_h, P_h, P_zh / P_h)
        gap = learned.log_height - log_h[:, None]
        of_depth, of_height = (P[:, None] / (P_h[:, None] + learned.variance) for P in (P_zh, P_h))
        return Depths(
            *_mixed(learned.weight, log_z[:, None] + of_depth * gap, P_z[:, None] - of_depth * P_zh[:, None]),
            *_mixed(learned.weight, log_h[:, None] + of_height * gap, P_h[:, None] - of_height * P_h[:, None]),
            P_zh / P_h,
        )

    def _outline_drift(self, rows: Sequence[int], turned_rad: Floats, learned: LearnedSize | None) -> Floats:
        """(N,): by how much the variance of each log outline grew since it was last seen.

        The line of sight to what stands turns by what the ego drives; who drives turns by itself too, the more the
        faster. A car that is seen from behind doubles its outline within 30 degrees.
        """
        config = self.config
        own_turn = 0.0 if learned is None else config.bend_per_m * learned.speed_mps  # in a second
        own_var = np.square(own_turn) * self._unseen_s[rows]
        out: Floats = config.width_drift_rel**2 + config.width_turn_rel**2 * (np.square(turned_rad) + own_var)
        return out

    def _driving_share(self, speed_mps: float) -> float:
        """The share of a second that counts as driving."""
        return -math.expm1(-speed_mps / self.config.driving_mps)

    def _correlated_frames(self, rows: Sequence[int], learned: LearnedSize | None) -> Floats:
        """(N,): how many frames in a row have the same error, by how much changed in view since each was last seen.

        Errors of a box become others as the ego drives or as the vehicle does. Of what stands before an ego that stands
        all images are the same one, and it was counted.
        """
        speed_mps = np.zeros(len(rows)) if learned is None else learned.speed_mps
        stood_s = (self._unseen_s - self._driven_s)[rows] * np.exp(-speed_mps / self.config.driving_mps)
        changed_s = np.maximum(self._unseen_s[rows] - stood_s, _MIN_SHARE)
        correlated: Floats = np.maximum(1.0, self.config.box_memory_s / changed_s)
        self._unseen_s[rows] = self._driven_s[rows] = 0.0
        return correlated

    def _iterate(
        self, at: NDArray[np.intp], bearing: Floats, reach: Floats, z: Floats, R: Floats, correlated: Floats
    ) -> tuple[Floats, Floats, Floats, Floats, Floats]:
        """log z and its variances, log h and its variances, and their covariances, (N,) each.

        They have this frame's boxes with their noise R. The state that is kept for the next frame has them with so much
        more noise that errors which last are not averaged away.
        """
        n, m = len(at), len(self._x)
        # First guess of the depth: by the prior height from the height of the box
        log_z = self._x[at] - np.log(np.maximum(z[:n] - z[n : 2 * n], 1e-3))
        prior = np.concatenate([self._x, log_z])
        P = np.zeros((m + n, m + n))
        P[:m, :m] = self._P
        P[range(m, m + n), range(m, m + n)] = DEPTH_UNKNOWN**2
        x = prior.copy()
        for iteration in range(ITERATIONS):
            expected, J = self._expected_boxes(x, at, bearing, reach)
            PJt = P @ J.T
            S = J @ PJt
            innovation = z - expected - J @ (prior - x)
            gate_sigma = self.config.gate_sigma if iteration == ITERATIONS - 1 else math.inf
            gain = PJt @ _robust_information(S + np.diag(R), innovation, len(CUES), gate_sigma)
            x = prior + gain @ innovation
        P = P - gain @ PJt.T
        lasting = S + np.diag(R * np.tile(correlated, len(CUES)))
        kept = PJt[:m] @ _robust_information(lasting, innovation, len(CUES), self.config.gate_sigma)
        kept_P = self._P - kept @ PJt[:m].T
        self._x, self._P = prior[:m] + kept @ innovation, (kept_P + kept_P.T) / 2.0
        return x[m:], np.diag(P)[m:].copy(), x[at], np.maximum(P[at, at], _MIN_VARIANCE), P[range(m, m + n), at]

    def _expected_boxes(self, x: Floats, at: NDArray[np.intp], bearing: Floats, reach: Floats) -> tuple[Floats, Floats]:
        """The measurements (3 N,) expected of a state (M + N,), cue by cue, and their derivatives (3 N, M + N) by it.

        `at` (N,) is where the state has each box's vehicle; slopes are against the ground before the update.
        """
        n, m = len(at), len(self._x)
        rows = np.arange(n)
        depth = np.exp(x[m:])
        height = np.exp(x[at])
        camera_m = self._image_ground.height_m
        below = camera_m + x[at + EDGE]
        far = np.where(camera_m > height, depth + reach, depth)
        level = x[0] - self._x[0] + x[at + TILT]
        lean = (x[1] - self._x[1]) * bearing
        expected = np.concatenate(
            [
                bev.road_slope(depth, below) - level + lean,  # Eq. 1
                (camera_m - height) / far - level + lean,
                x[at + 1] - x[m:],
            ]
        )
        J = np.zeros((len(CUES) * n, m + n))
        J[: 2 * n, 0] = -1.0
        J[:n, 1] = J[n : 2 * n, 1] = bearing
        J[rows, at + TILT] = J[n + rows, at + TILT] = -1.0
        J[rows, at + EDGE] = 1.0 / depth
        J[rows, m + rows] = -below / depth
        J[n + rows, at] = -height / far
        J[n + rows, m + rows] = -(camera_m - height) / far**2 * depth
        J[2 * n + rows, at + 1] = 1.0
        J[2 * n + rows, m + rows] = -1.0
        return expected, J

    def _correct_pitch(self, pitch_rad: float, sigma_rad: float) -> None:
        gain = self._P[:, 0] / (self._P[0, 0] + sigma_rad**2)
        self._x = self._x + gain * (pitch_rad - self._x[0])
        self._P = self._P - np.outer(gain, self._P[0])


def _robust_information(S: Floats, innovation: Floats, cues: int, gate_sigma: float) -> Floats:
    """The inverse of the innovations' covariance S (M, M), with the worst cue of each box at a robust weight (Huber).

    Innovations (M,) stand cue by cue, of all boxes each. One differs from its prediction by all the others by
    (S^-1 v)_i / (S^-1)_ii, with the variance 1 / (S^-1)_ii: past `gate_sigma` its noise is raised.
    """
    whole = np.asarray(np.linalg.inv(S), dtype=np.float64)
    precision = np.diag(whole)
    residual = np.abs(whole @ innovation) / np.sqrt(precision)
    by_box = residual.reshape(cues, -1)
    n = by_box.shape[1]
    worst = by_box.argmax(axis=0) * n + np.arange(n)
    worst = worst[residual[worst] > gate_sigma]
    if not len(worst):
        return whole
    # Woodbury: noise added to a few measurements
    more = ((residual[worst] / gate_sigma) ** 4 - 1.0) / precision[worst]
    columns = whole[:, worst]
    inner = np.diag(1.0 / more) + columns[worst]
    out: Floats = whole - columns @ np.linalg.solve(inner, columns.T)
    return out


def _mixed(weight: Floats, means: Floats, variances: Floats) -> tuple[Floats, Floats]:
    """Mean (N,) and variance (N,) of mixtures (N, K)."""
    mean = (weight * means).sum(axis=1)
    return mean, (weight * (np.square(means - mean[:, None]) + variances)).sum(axis=1)
