"""Size and stationarity of vehicles from the growth of their boxes as the ego moves.

If a stationary vehicle's box doubles over 30 m of ego motion, the vehicle is 30 m away, whatever its size. One Kalman
filter per motion mode, mixed by likelihood (interacting multiple model, Blom and Bar-Shalom 1988):

    x = [x, y, vx, vy, log h, log w, tilt, ground offset]        measurements: parallax_measurements.py
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.se2 import SE2
from birdslam.road_users.state.ground_size_config import TILT_MEMORY_S
from birdslam.road_users.state.motion_modes import (
    FILTERS,
    MODES,
    MOVING_MODES,
    NEIGHBOUR,
    STATIONARY,
    STATIONARY_MODES,
    UNUSUAL_SIZE,
    WITHOUT_GROUND,
    birth_velocity_cov,
    birth_weights,
    ego_step_cov,
    mix,
    process_noise,
)
from birdslam.road_users.state.parallax_config import (
    GATE_SIGMA,
    OUTLINE_DRIFT_REL,
    PATH_HALF_WIDTH_M,
    ROAD_HALF_WIDTH_M,
    SIDE_OUTLIER_MEMORY_S,
    SIGMA_ANOTHER_M,
    SIGMA_ANOTHER_REL,
    SIGMA_ANOTHER_SIZE_REL,
    SIGMA_BANK_PER_M,
    SIGMA_CROWN_RAD,
    SIGMA_KERB_M,
    SIGMA_SIDE_OUTLIER_REL,
    SIGMA_TILT_RAD,
    SIGMA_UNUSUAL_REL,
    ParallaxConfig,
)
from birdslam.road_users.state.parallax_measurements import (
    BY_HEIGHT,
    BY_WIDTH,
    CUES,
    GROUND,
    HEIGHT,
    MIN_SLOPE,
    OFFSET,
    STATES,
    TILT,
    VX,
    VY,
    WIDTH,
    ParallaxMeasurements,
    X,
    Y,
    linearised,
    side_outlier_shift,
)
from birdslam.road_users.state.side_outliers import update_with_side_outliers

Floats = NDArray[np.float64]

UNKNOWN_VARIANCE = 1e6  # of an unmeasured size, and of unused measurements
INITIAL_POSITION_SIGMA_REL = 1.0  # of the depth
MAX_SIDE_OUTLIER_PROBABILITY = 0.45  # prior of one side
MIN_WEIGHT = 1e-9  # of a filter, so that it can recover


@dataclass(frozen=True)
class LearnedSize:
    """Alternative measurements of log h (N, K), each with its probability `weight` and its variance.

    `speed_mps` (N,) is the RMS speed over the modes. `side_outlier` (N, 2) are the probabilities that the left side of
    the box is an outlier, and the right.
    """

    weight: Floats
    log_height: Floats
    variance: Floats
    speed_mps: Floats
    side_outlier: Floats


class Parallax:
    """Calls per frame: predict(), then learn_sizes().

    State of each vehicle and mode: x, y (m), vx, vy (m/s) in the odometry world, log height (m), log factor on the
    width of the outline, tilt (rad) and offset (m) of its ground, and the probability of the mode. Measurements of each
    box: logs of height, width and bottom slope, and bearing of the centre. Readers: `placing.Placing`, which passes the
    sizes to `ground_size_filter.GroundSizeFilter`; tracker and smoother for `stationary_probability`.
    """

    def __init__(self, config: ParallaxConfig) -> None:
        self.config = config
        self._prior_weight = np.maximum(birth_weights(), MIN_WEIGHT)
        self._x = np.zeros((0, FILTERS, len(STATES)))
        self._P = np.zeros((0, FILTERS, len(STATES), len(STATES)))
        self._weight = np.zeros((0, len(MODES)))
        self._prior = np.zeros((0, 2))  # log h of the class and its variance
        self._unseen_s = np.zeros(0)
        self._yaw_rad = np.zeros(0)  # in world
        self._on_road = np.zeros(0, np.bool_)
        self._side_outlier = np.zeros((0, 2))

    def __len__(self) -> int:
        return len(self._x)

    def stationary_probability(self, row: int) -> float:
        """Probability that a vehicle is stationary."""
        weight = self._weight[row]
        return float(weight[STATIONARY] + weight[UNUSUAL_SIZE] + weight[NEIGHBOUR])

    def add_vehicle(
        self,
        centre_m: Floats,
        yaw_rad: float,
        T_world_ego: SE2,
        log_height: float,
        sigmas: tuple[float, float],
    ) -> None:
        """Adds a vehicle at about `centre_m` (2,) and `yaw_rad` in ego, before the update by its first box.

        `log_height` is that of its class, `sigmas` are those of log h and log w.
        """
        config = self.config
        x = np.zeros((1, FILTERS, len(STATES)))
        x[..., :2] = T_world_ego @ centre_m
        x[..., HEIGHT] = log_height
        P = np.zeros((1, FILTERS, len(STATES), len(STATES)))
        P[..., :2, :2] = np.eye(2) * (INITIAL_POSITION_SIGMA_REL * float(centre_m[0])) ** 2
        heading_rad = np.array([T_world_ego.yaw_rad + yaw_rad])
        on_road = abs(float(centre_m[1])) < ROAD_HALF_WIDTH_M
        for moving, cov in birth_velocity_cov(heading_rad, on_road).items():
            P[:, moving, VX:HEIGHT, VX:HEIGHT] = cov
        P[..., [HEIGHT, WIDTH], [HEIGHT, WIDTH]] = np.square(sigmas)
        P[:, [UNUSUAL_SIZE, WITHOUT_GROUND[1]], HEIGHT, HEIGHT] = SIGMA_UNUSUAL_REL**2
        P[..., TILT, TILT] = SIGMA_TILT_RAD**2
        aside_m = float(centre_m[1])
        below_m = SIGMA_KERB_M, SIGMA_CROWN_RAD * aside_m, SIGMA_BANK_PER_M * aside_m**2
        P[..., OFFSET, OFFSET] = math.hypot(*below_m) ** 2
        self._x, self._P = np.concatenate([self._x, x]), np.concatenate([self._P, P])
        self._weight = np.concatenate([self._weight, self._prior_weight[None]])
        self._prior = np.concatenate([self._prior, [[log_height, sigmas[0] ** 2]]])
        self._yaw_rad = np.append(self._yaw_rad, heading_rad)
        self._on_road = np.append(self._on_road, on_road)
        self._side_outlier = np.concatenate([self._side_outlier, np.zeros((1, 2))])
        self._unseen_s = np.append(self._unseen_s, max(config.box_memory_s, config.view_memory_s))

    def predict(self, dt_s: float, T_world_ego: SE2, ego_cov: Floats | None) -> None:
        """Predicts to the next frame; `ego_cov` (3, 3) is the covariance of the ego's step in its tangent space."""
        self._unseen_s += dt_s
        self._side_outlier *= math.exp(-dt_s / SIDE_OUTLIER_MEMORY_S)
        if not len(self._x) or dt_s <= 0.0:
            return
        neighbour_cov = self._neighbour_covs(T_world_ego)
        self._weight, self._x, self._P = mix(self.config.own_for_s, dt_s, self._weight, self._x, self._P, neighbour_cov)
        decay = math.exp(-dt_s / TILT_MEMORY_S)
        self._x[..., TILT] *= decay
        self._P[..., TILT, :] *= decay
        self._P[..., TILT] *= decay
        self._P[..., TILT, TILT] += (1.0 - decay**2) * SIGMA_TILT_RAD**2
        F = np.eye(len(STATES))
        F[X, VX] = F[Y, VY] = dt_s
        self._x[:, MOVING_MODES] = self._x[:, MOVING_MODES] @ F.T
        self._P[:, MOVING_MODES] = F @ self._P[:, MOVING_MODES] @ F.T
        self._P[:, MOVING_MODES, : VY + 1, : VY + 1] += process_noise(dt_s, self._yaw_rad, self._on_road)
        if ego_cov is not None:
            self._P[..., :2, :2] += ego_step_cov(self._x[..., :2], T_world_ego, ego_cov)

    def _neighbour_covs(self, T_world_ego: SE2) -> Floats:
        """(N, 8, 8) covariance of a parked neighbour's state about a vehicle's own."""
        along = SIGMA_ANOTHER_REL * (self._x[:, STATIONARY, :VX] - [T_world_ego.x_m, T_world_ego.y_m])
        out = np.zeros((len(along), len(STATES), len(STATES)))
        out[:, :VX, :VX] = along[:, :, None] * along[:, None, :] + SIGMA_ANOTHER_M**2 * np.eye(2)
        out[:, [HEIGHT, WIDTH], [HEIGHT, WIDTH]] = SIGMA_ANOTHER_SIZE_REL**2
        return out

    def learn_sizes(
        self, rows: Sequence[int], boxes: ParallaxMeasurements, T_world_ego: SE2, height_m: float
    ) -> LearnedSize:
        """Updates these rows by their boxes and returns the sizes by parallax; `height_m` is the camera height."""
        if not rows:
            nothing = np.zeros((0, len(WITHOUT_GROUND) + 1))
            return LearnedSize(nothing, nothing, nothing, np.zeros(0), np.zeros((0, 2)))
        config = self.config
        x, P = self._x[rows], self._P[rows]
        outline_var = np.square(boxes.turned_rad) + OUTLINE_DRIFT_REL**2 * self._unseen_s[rows]
        P[..., WIDTH, WIDTH] += outline_var[:, None]
        innovation, J = linearised(x, boxes, T_world_ego, height_m)
        of_box, of_view = (
            np.maximum(1.0, memory_s / np.maximum(self._unseen_s[rows], 1e-3))
            for memory_s in (config.box_memory_s, config.view_memory_s)
        )
        of_face = np.square(config.sigma_face_m / boxes.depth_m)

        PJt = P @ J.swapaxes(-1, -2)
        S = J @ PJt
        noise = self._noise(boxes, innovation, S, of_box, of_face * of_view)
        S = S + noise
        shift = side_outlier_shift(boxes, innovation, SIGMA_SIDE_OUTLIER_REL * np.sqrt(of_box))
        share = np.minimum(config.side_outlier + self._side_outlier[rows], MAX_SIDE_OUTLIER_PROBABILITY).T
        after = update_with_side_outliers(P, PJt, S, innovation, shift, share)
        self._x[rows] = x + after.step
        self._P[rows] = after.cov

        log_likelihood = after.log_likelihood[:, : len(MODES)]
        weight = self._weight[rows] * np.exp(log_likelihood - log_likelihood.max(axis=1, keepdims=True))
        weight = np.maximum(weight / weight.sum(axis=1, keepdims=True), MIN_WEIGHT)
        self._weight[rows] = weight
        self._unseen_s[rows] = 0.0
        self._yaw_rad[rows] = boxes.yaw_rad + T_world_ego.yaw_rad
        in_path = np.abs(boxes.bearing) * (boxes.depth_m + boxes.reach_m) < PATH_HALF_WIDTH_M
        side_outlier = (after.outlier[..., : len(MODES)] * weight).sum(axis=-1).T
        self._side_outlier[rows] = side_outlier
        return self._size_measurements(rows, of_face + config.sigma_scale_rel**2, in_path, side_outlier)

    def _noise(
        self, boxes: ParallaxMeasurements, innovation: Floats, S: Floats, of_box: Floats, face_var: Floats
    ) -> Floats:
        """(N, FILTERS, 4, 4) measurement noise, raised for outliers; S is of the predicted measurements.

        Noise is inflated so that correlated errors count once per correlation time: `of_box` (N,) is the factor on a
        box's variance, `face_var` (N,) the inflated variance of the nearest face.
        """
        variance = np.empty((len(of_box), FILTERS, len(CUES)))
        variance[..., :GROUND] = (np.square(boxes.sigma) * of_box[:, None])[:, None]
        variance[..., [BY_HEIGHT, BY_WIDTH]] += face_var[:, None, None]
        sigma_rel = boxes.sigma_bottom / np.maximum(boxes.bottom, MIN_SLOPE)
        variance[..., GROUND] = (np.square(sigma_rel) * of_box)[:, None]
        variance[:, WITHOUT_GROUND, GROUND] = UNKNOWN_VARIANCE
        noise = variance[..., None] * np.eye(len(CUES))
        nis = _squared_mahalanobis(innovation, S + noise).min(axis=1)
        noise *= np.maximum(1.0, nis / GATE_SIGMA**2)[:, None, None, None]
        return noise

    def keep_rows(self, rows: Sequence[int]) -> None:
        """Removes the vehicles of all other rows."""
        for name in ("_x", "_P", "_weight", "_prior", "_unseen_s", "_yaw_rad", "_on_road", "_side_outlier"):
            setattr(self, name, getattr(self, name)[rows])

    def _size_measurements(
        self, rows: Sequence[int], lasting: Floats, in_path: NDArray[np.bool_], side_outlier: Floats
    ) -> LearnedSize:
        """Log h of each stationary filter without the class's prior; none of the moving filters.

        `lasting` (N,) is a variance that does not average out. Vehicles `in_path` (N,) are excluded in this output
        only.
        """
        mean, var = self._x[rows][:, WITHOUT_GROUND, HEIGHT], self._P[rows][:, WITHOUT_GROUND, HEIGHT, HEIGHT]
        prior, prior_var = self._prior[rows].T[..., None]
        information = 1.0 / var - 1.0 / prior_var
        informed = information > 1.0 / UNKNOWN_VARIANCE
        informed[in_path] = False
        information = np.where(informed, information, 1.0 / UNKNOWN_VARIANCE)
        log_height = np.where(informed, (mean / var - prior / prior_var) / information, prior)
        variance = 1.0 / information + lasting[:, None]
        weight = self._weight[rows]
        square = np.square(self._x[rows][:, MOVING_MODES, VX:HEIGHT]).sum(axis=-1)
        return LearnedSize(
            np.column_stack([weight[:, STATIONARY_MODES], 1.0 - weight[:, STATIONARY_MODES].sum(axis=1)]),
            np.column_stack([log_height, prior]),
            np.column_stack([variance, np.full(len(rows), UNKNOWN_VARIANCE)]),
            np.sqrt((weight[:, MOVING_MODES] * square).sum(axis=1)),
            side_outlier,
        )


def _squared_mahalanobis(gap: Floats, S: Floats) -> Floats:
    """Squared Mahalanobis distances (...) of gaps (..., 4) with covariances (..., 4, 4)."""
    out: Floats = np.einsum("...a,...a->...", gap, np.linalg.solve(S, gap[..., None])[..., 0])
    return out
