"""Positions and velocities of people: Kalman filters per motion and height, mixed by likelihood.

The road measures the depth, the size second: a small box with a near foot is a child. Tilt, ground offset and height
are states (people_state.py), so that systematic errors do not average out. Hidden feet are a second hypothesis of each
box (box_model.py).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry import bev
from birdslam.geometry.arrays import Bools, Floats
from birdslam.geometry.bev import RoadProfile
from birdslam.geometry.se2 import SE2
from birdslam.road_users.people.box_model import (
    MIN_SLOPE,
    TALL,
    UNUSED_SIGMA,
    WIDTH,
    expected_boxes,
    hide_feet,
    measured_boxes,
)
from birdslam.road_users.people.people_boxes import PersonBox
from birdslam.road_users.people.people_config import (
    BOX_MEMORY_S,
    HIDDEN_SHARE,
    OUTLINE_MEMORY_S,
    SIGMA_KERB_M,
    SIGMA_OUTLINE_REL,
    SIGMA_TILT_RAD,
    TILT_DRIFT_RAD,
    WIDTH_MEMORY_S,
    PeopleConfig,
)
from birdslam.road_users.people.people_motion import (
    initial_velocities,
    mix_motions,
    motion_parameters,
    motion_priors,
    predict_motion,
)
from birdslam.road_users.people.people_state import (
    CHILD_FILTERS,
    FILTERS,
    FOOT,
    HEAD,
    HEIGHT,
    MOTIONS,
    OFFSET,
    STATES,
    STATIONARY_FILTERS,
    TILT,
    VELOCITY,
    VX,
    VY,
    Moments,
    X,
    Y,
    merge_mixture,
)
from birdslam.road_users.state.motion_modes import ego_step_cov

INITIAL_DEPTH_SIGMA_REL = 0.6
BIRTH_ITERATIONS, ITERATIONS = 4, 1
MIN_WEIGHT = 1e-6  # of a filter, so that it can recover


class PeopleFilter:
    """Calls per frame: predict(), correct() for observed rows, add_people() for new ones.

    State of each person and filter: x, y (m), vx, vy (m/s) in the odometry world, log height (m), tilt (rad) and offset
    (m) of the ground relative to the front end's ground, errors of the box. Measurements of each box: bearing, bottom,
    log height, log width (box_model.py). Readers: `people_tracker` for association, and `people_records`.
    """

    def __init__(self, config: PeopleConfig) -> None:
        self.config = config
        self._x = np.zeros((0, FILTERS, len(STATES)))
        self._P = np.zeros((0, FILTERS, len(STATES), len(STATES)))
        self._weight = np.zeros((0, FILTERS))
        self._unseen_s = np.zeros(0)
        self._log_height = np.zeros((0, FILTERS))  # of adults and children
        self._sizes = np.zeros((0, 6))  # reach, change, log width, sigma width, mean errors of foot and head
        self._moves = np.zeros((0, len(MOTIONS), 3))  # speed along the road, its 1-sigma, 1-sigma across the road
        # Variances of the own parts of tilt and log height, means and variances of the common parts
        self._own_var, self._common = np.zeros((2, 0, FILTERS)), np.zeros((2, 2))
        self._driving = 1.0  # driving fraction of a second

    def __len__(self) -> int:
        return len(self._x)

    def keep_rows(self, rows: Sequence[int]) -> None:
        """Removes all other rows."""
        for name in ("_x", "_P", "_weight", "_unseen_s", "_sizes", "_log_height", "_moves"):
            setattr(self, name, getattr(self, name)[rows])
        self._own_var = self._own_var[:, rows]

    def predict(
        self,
        dt_s: float,
        T_world_ego: SE2,
        ego_cov: Floats | None,
        ground_shift_rad: float,
        driving: float,
        keep_tilt: float,
    ) -> None:
        """Predicts to the next frame; `ground_shift_rad` is the change of the ground's estimate beyond its motion.

        `ego_cov` (3, 3) is the covariance of the ego's step in its tangent space, `driving` the driving fraction of a
        second, `keep_tilt` the correlation of the road's tilt at a person with that of the last frame.
        """
        n, keep = len(self._x), keep_tilt
        self._driving = driving
        self._common[0, 0] -= ground_shift_rad
        if not n or dt_s <= 0.0:
            return
        self._unseen_s += dt_s
        self._x, self._P, self._weight = mix_motions(
            self._x, self._P, self._weight, self._moves, dt_s, T_world_ego.yaw_rad
        )
        self._x, self._P = predict_motion(self._x, self._P, self._sizes[:, 1], dt_s)
        mean, var = self._common[0]
        self._x[..., TILT] = mean + keep * (self._x[..., TILT] - ground_shift_rad - mean)
        self._P[..., TILT, :] *= keep
        self._P[..., TILT] *= keep
        self._P[..., TILT, TILT] += (1.0 - keep**2) * (var + SIGMA_TILT_RAD**2)
        self._P[..., TILT, TILT] += TILT_DRIFT_RAD**2 * dt_s
        keep = math.exp(-dt_s / OUTLINE_MEMORY_S)
        for k, state in enumerate((FOOT, HEAD)):
            mean = self._sizes[:, 4 + k, None]
            self._x[..., state] = mean + keep * (self._x[..., state] - mean)
            self._P[..., state, :] *= keep
            self._P[..., state] *= keep
            self._P[..., state, state] += (1.0 - keep**2) * SIGMA_OUTLINE_REL**2
        if ego_cov is not None:
            self._P[..., :2, :2] += ego_step_cov(self._x[..., :2], T_world_ego, ego_cov)

    def add_people(self, boxes: Sequence[PersonBox], T_world_ego: SE2, road: RoadProfile) -> None:
        """Adds new people in rows after the others, and corrects them by their boxes."""
        if not boxes:
            return
        n, before = len(boxes), len(self._x)
        x, P = np.zeros((n, FILTERS, len(STATES))), np.zeros((n, FILTERS, len(STATES), len(STATES)))
        weight, rows = np.zeros((n, FILTERS)), np.zeros((n, 6))
        log_height = np.zeros((n, FILTERS))
        moves, own_var = np.zeros((n, len(MOTIONS), 3)), np.zeros((2, n, FILTERS))
        for k, box in enumerate(boxes):
            sizes = self.config.sizes(box.label)
            moves[k] = motion_parameters(sizes)
            own_var[0, k] = SIGMA_TILT_RAD**2
            rows[k] = [
                sizes.reach_m, sizes.change_mps, math.log(sizes.width_m), sizes.sigma_width_rel,
                sizes.foot_rel, -sizes.head_rel,
            ]  # fmt: skip
            for child, (h_m, sigma) in enumerate(
                ((sizes.height_m, sizes.sigma_height_rel), (sizes.child_m, sizes.sigma_child_rel))
            ):
                x_m = min(h_m / max(box.tan_height, MIN_SLOPE), bev.MAX_RANGE_M)
                both = slice(len(MOTIONS) * child, len(MOTIONS) * (child + 1))
                x[k, both, :2] = T_world_ego @ np.array([x_m, box.bearing * x_m])
                log_height[k, both] = math.log(h_m)
                x[k, both, HEIGHT] = math.log(h_m) + self._common[1, 0]
                P[k, both, :2, :2] = np.eye(2) * (INITIAL_DEPTH_SIGMA_REL * x_m) ** 2
                own_var[1, k, both] = sigma**2
                weight[k, both] = (sizes.child if child else 1.0 - sizes.child) * motion_priors()
            x[k, :, FOOT], x[k, :, HEAD] = sizes.foot_rel, -sizes.head_rel
            x[k, :, TILT] = self._common[0, 0]
            P[k, :, [TILT, HEIGHT], [TILT, HEIGHT]] = self._common[:, 1, None] + own_var[:, k]
            P[k, :, [FOOT, HEAD], [FOOT, HEAD]] = SIGMA_OUTLINE_REL**2
            P[k, :, OFFSET, OFFSET] = SIGMA_KERB_M**2
        self._moves = np.concatenate([self._moves, moves])
        mean, cov = initial_velocities(self._moves, T_world_ego.yaw_rad)
        x[..., VELOCITY] = np.tile(mean[before:], (1, 2, 1))
        P[..., VELOCITY, VELOCITY] = np.tile(cov[before:], (1, 2, 1, 1))
        self._x, self._P = np.concatenate([self._x, x]), np.concatenate([self._P, P])
        self._weight = np.concatenate([self._weight, weight])
        self._sizes = np.concatenate([self._sizes, rows])
        self._log_height = np.concatenate([self._log_height, log_height])
        self._own_var = np.concatenate([self._own_var, own_var], axis=1)
        self._unseen_s = np.concatenate([self._unseen_s, np.full(n, max(BOX_MEMORY_S, WIDTH_MEMORY_S))])
        self.correct(range(before, before + n), boxes, T_world_ego, road, BIRTH_ITERATIONS)

    def correct(
        self,
        rows: Sequence[int],
        boxes: Sequence[PersonBox],
        T_world_ego: SE2,
        road: RoadProfile,
        iterations: int = ITERATIONS,
    ) -> None:
        """Updates the people in `rows` by their boxes, one each."""
        if not boxes:
            return
        at = np.asarray(rows)
        z, R = self._measured(at, boxes)  # (M, 4), (M, 4, 4)
        independent = np.minimum(1.0, self._unseen_s[at] / BOX_MEMORY_S)  # effective number of boxes
        counts = independent[:, None, None]
        hidden = np.array([box.hidden for box in boxes])
        x0, P0 = self._x[at][:, :, None], self._P[at][:, :, None]  # (M, K, 1, 9)
        x = np.repeat(x0, 2, axis=2)
        for _ in range(iterations):
            expected, J = expected_boxes(x, T_world_ego, road, self._sizes[at, 0], self._sizes[at, 2])
            noise = np.broadcast_to(R[:, None, None], (*x.shape[:3], 4, 4)).copy()
            hide_feet(noise[:, :, 1], np.exp(expected[:, :, 0, TALL]))
            PJt = P0 @ J.swapaxes(-1, -2)
            of_one_box = J @ PJt + noise
            S = J @ PJt + noise / counts[..., None, None]
            innovation = z[:, None, None] - expected - ((x0 - x)[..., None, :] @ J.swapaxes(-1, -2))[..., 0, :]
            information = np.linalg.inv(S)
            gain = PJt @ information
            x = x0 + (gain @ innovation[..., None])[..., 0]
        P = P0 - gain @ PJt.swapaxes(-1, -2)
        P = (P + P.swapaxes(-1, -2)) / 2.0
        # Evidence of one box, since errors are correlated; otherwise repeated boxes favour one filter
        squared = (innovation[..., None, :] @ np.linalg.inv(of_one_box) @ innovation[..., None])[..., 0, 0]
        evidence = -0.5 * (squared + np.linalg.slogdet(of_one_box)[1])
        evidence += np.log(np.stack([1.0 - hidden, hidden], axis=1))[:, None]
        most = evidence.max(axis=2, keepdims=True)
        share = np.exp(evidence - most)
        total = share.sum(axis=2, keepdims=True)
        self._x[at], self._P[at] = merge_mixture(x, P, share / total)
        log_weight = np.log(np.maximum(self._weight[at], 1e-300)) + (counts * (most + np.log(total)))[..., 0]
        weight = np.maximum(np.exp(log_weight - log_weight.max(axis=1, keepdims=True)), MIN_WEIGHT)
        self._weight[at] = weight / weight.sum(axis=1, keepdims=True)
        self._unseen_s[at] = 0.0

    def _measured(self, at: NDArray[np.intp], boxes: Sequence[PersonBox]) -> tuple[Floats, Floats]:
        """Measurements (M, 4) of the boxes, and their covariances (M, 4, 4)."""
        z, R = measured_boxes(boxes)
        uses = np.array([b.is_complete for b in boxes]) & (self._unseen_s[at] >= WIDTH_MEMORY_S)
        R[:, WIDTH, WIDTH] = np.where(uses, self._sizes[at, 3], UNUSED_SIGMA) ** 2
        return z, R

    def moments(self, after_s: float = 0.0, stands: Bools | None = None) -> Moments:
        """Moments of all people, extrapolated by `after_s`.

        The velocity is that of the moving filters, or 0 for `stands` (N,); the covariance about it includes the
        probability of the other case.
        """
        mean, cov = merge_mixture(self._x, self._P, self._weight)
        standing = self._weight[:, STATIONARY_FILTERS].sum(axis=1)
        moving = self._weight.copy()
        moving[:, STATIONARY_FILTERS] = 0.0
        velocity = (moving[..., None] * self._x[..., VELOCITY]).sum(axis=1) / moving.sum(axis=1)[:, None]
        if stands is not None:
            velocity[stands] = 0.0
        off = mean[:, VELOCITY] - velocity
        mean[:, VELOCITY] = velocity
        cov[:, VELOCITY, VELOCITY] += off[:, :, None] * off[:, None, :]
        if after_s > 0.0 and len(mean):
            F = np.eye(len(STATES))
            F[X, VX] = F[Y, VY] = after_s
            mean, cov = mean @ F.T, F @ cov @ F.T
            q = (1.0 - standing) * np.square(self._sizes[:, 1])
            cov[:, [X, Y], [X, Y]] += (q * after_s**3 / 3.0)[:, None]
            cov[:, [VX, VY], [VX, VY]] += (q * after_s)[:, None]
        return Moments(mean, cov, standing, self._weight[:, CHILD_FILTERS].sum(axis=1))

    def set_common_priors(self, priors: Floats) -> None:
        """Replaces the priors of the common tilt and height, information of rank one in each filter.

        `priors` (2, 2) are means and variances. The prior of the tilt fades while the ego drives, since predict() draws
        the tilt to the new one.
        """
        means = ((TILT, np.zeros((1, 1)), 1.0 - self._driving), (HEIGHT, self._log_height, 1.0))
        for (state, base, kept), own, old, new in zip(means, self._own_var, self._common, priors, strict=True):
            before, now = 1.0 / (own + old[1]), 1.0 / (own + new[1])
            Pa = self._P[..., state]  # (N, F, S)
            change = np.maximum(kept * (now - before), -0.5 / Pa[..., state])
            gain = Pa / (1.0 + change * Pa[..., state])[..., None]
            drawn = kept * (now * new[0] - before * old[0])
            self._x = self._x + gain * (drawn - change * (self._x[..., state] - base))[..., None]
            self._P = self._P - change[..., None, None] * gain[..., :, None] * Pa[..., None, :]
        self._common = priors

    def distances(self, boxes: Sequence[PersonBox], T_world_ego: SE2, road: RoadProfile) -> tuple[Floats, Floats]:
        """(2, N, M) squared Mahalanobis distances of boxes from people, and -2 log likelihoods.

        The first are with visible feet, the second with hidden feet.
        """
        x = np.repeat(self._x[:, :, None], 2, axis=2)
        expected, J = expected_boxes(x, T_world_ego, road, self._sizes[:, 0], self._sizes[:, 2])
        expected, J = expected[..., :WIDTH], J[..., :WIDTH, :]
        S = J @ self._P[:, :, None] @ J.swapaxes(-1, -2)
        # (N, 2, 3), (N, 2, 3, 3)
        mean, S = merge_mixture(expected.swapaxes(1, 2), S.swapaxes(1, 2), self._weight[:, None])
        z, R = measured_boxes(boxes)
        noise = np.stack([R, R])
        hide_feet(noise[1], np.exp(z[:, TALL]) / (1.0 - HIDDEN_SHARE))
        hidden = np.array([b.hidden for b in boxes])
        squared, costs = np.empty((2, 2, len(self._x), len(boxes)))
        for k, prior in enumerate((1.0 - hidden, hidden)):
            gap = z[None, :, :WIDTH] - mean[:, None, k]
            whole = S[:, None, k] + noise[k][None, :, :WIDTH, :WIDTH]
            squared[k] = (gap[..., None, :] @ np.linalg.inv(whole) @ gap[..., None])[..., 0, 0]
            costs[k] = squared[k] + np.linalg.slogdet(whole)[1] - 2.0 * np.log(prior)
        return squared, costs
