"""The filter of all road users: Kalman filters by motion and size, mixed by likelihood.

The road and the size of a road user measure its depth; so does the growth of its box as the ego moves, if it is
stationary. Tilt, ground offset, size and lasting errors of the box are states, so that they do not average out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry import bev
from birdslam.geometry.arrays import Bools, Floats
from birdslam.geometry.bev import RoadProfile
from birdslam.geometry.se2 import SE2
from birdslam.road_users.models.user_boxes import BEARING, MIN_DISTANCE_M, TALL, WIDE, Boxes, expected_boxes
from birdslam.road_users.models.user_motion import initial_velocities, mix_motions, predict_motion, transitions
from birdslam.road_users.models.user_priors import UserPriors
from birdslam.road_users.models.user_state import (
    CROSSING,
    FOOT,
    HEAD,
    HEIGHT,
    MOTIONS,
    OFFSET,
    PLACE,
    STATES,
    STATIONARY,
    TILT,
    VELOCITY,
    VX,
    VY,
    WIDTH,
    Moments,
    X,
    Y,
    ego_step_cov,
    merge_mixture,
)

INITIAL_DEPTH_SIGMA_REL = 0.6
MIN_WEIGHT = 1e-6  # of a filter, so that it can recover
UNKNOWN_VARIANCE = 1e6  # of an unmeasured size
SIGMA_SCALE_REL = 0.02  # of the odometry's scale
_MIN_DT_S, _MIN_PROBABILITY = 1e-3, 1e-300
_SIZES = [TALL, WIDE]


class RoadStep(NamedTuple):
    """The road's change to a frame: its estimated pitch without the camera's motion, and its memory.

    `driving` is the driving fraction of a second, `keep_tilt` the correlation of the tilt at a road user with that of
    the last frame.
    """

    level_rad: float
    driving: float
    keep_tilt: float


@dataclass(frozen=True)
class GrownSize:
    """Log heights (N,) from the growth of boxes, as if stationary, without the prior; RMS speeds (N,)."""

    log_height: Floats
    variance: Floats
    stationary: Floats  # probability
    speed_mps: Floats


class UserFilter:
    """Calls per frame: predict(), correct() for observed rows, add() for new ones.

    State of each road user and filter: user_state.py, and the probability of the filter. Measurements: user_boxes.py.
    Readers: association, `people_records`, and `placing.Placing` for sizes and motion of vehicles.
    """

    def __init__(self, kinds: Sequence[UserPriors]) -> None:
        self._kinds, filters = tuple(kinds), 2 * len(MOTIONS)
        self._motions, self._per_s = np.array([k.motions for k in kinds]), np.array([k.changes_per_s for k in kinds])
        self._ratios = np.array([(*k.ratios, *k.odd_ratios) for k in kinds])
        self._x, self._P = np.zeros((0, filters, len(STATES))), np.zeros((0, filters, len(STATES), len(STATES)))
        self._weight, self._kind = np.zeros((0, filters)), np.zeros(0, dtype=np.intp)
        # Of each road user: time since its last box, direction of travel, and geometry as in `Boxes`
        self._unseen_s, self._direction_rad, self._reach_m, self._top_m = np.zeros((4, 0))
        # Where the ego was at its first box, and for how long it has driven since
        self._born_m, self._driven_s = np.zeros((0, 2)), np.zeros(0)
        # Log heights, and variances of the own parts of them; means and variances of common tilt and height
        self._log_height, self._own_var, self._common = np.zeros((0, filters)), np.zeros((0, filters)), np.zeros((2, 2))
        self._driving = 1.0  # as in `RoadStep`, as is:
        self._level_rad: float | None = None

    def __len__(self) -> int:
        return len(self._x)

    def keep_rows(self, rows: Sequence[int]) -> None:
        """Removes all other rows."""
        for name in (
            "x",
            "P",
            "weight",
            "kind",
            "unseen_s",
            "direction_rad",
            "reach_m",
            "top_m",
            "born_m",
            "driven_s",
            "log_height",
            "own_var",
        ):
            setattr(self, f"_{name}", getattr(self, f"_{name}")[rows])

    def _of(self, name: str, kind: NDArray[np.intp] | None = None) -> Floats:
        """(N, 1) values of a field of the priors, of all rows or of kinds (N,)."""
        values = np.array([getattr(k, name) for k in self._kinds])
        return values[self._kind if kind is None else kind][:, None]

    def predict(self, dt_s: float, T_world_ego: SE2, ego_cov: Floats | None, road: RoadStep) -> None:
        """Predicts to the next frame; `ego_cov` (3, 3) is the covariance of the ego's step in its tangent space."""
        shift_rad = 0.0 if self._level_rad is None else road.level_rad - self._level_rad
        self._level_rad = road.level_rad
        self._driving = road.driving
        self._common[0, 0] -= shift_rad
        self._unseen_s += dt_s
        self._driven_s += road.driving * dt_s
        if not len(self._x) or dt_s <= 0.0:
            return
        motions, change = self._motions[self._kind], transitions(self._per_s, dt_s)[self._kind]
        mixed = mix_motions(self._x, self._P, self._weight, change, motions, self._direction_rad)
        self._x, self._P, self._weight = mixed
        self._x, self._P = predict_motion(self._x, self._P, motions, self._direction_rad, dt_s)
        mean, var = self._common[0]
        self._x[..., TILT] -= shift_rad
        self._relax(TILT, road.keep_tilt, mean, var + self._of("sigma_tilt_rad") ** 2)
        self._P[..., TILT, TILT] += self._of("tilt_drift_rad") ** 2 * dt_s
        self._P[..., WIDTH, WIDTH] += self._of("outline_drift_rel") ** 2 * dt_s
        keep, outline_var = np.exp(-dt_s / self._of("outline_memory_s")), self._of("sigma_outline_rel") ** 2
        self._relax(FOOT, keep, self._of("foot_rel"), outline_var)
        self._relax(HEAD, keep, -self._of("head_rel"), outline_var)
        if ego_cov is not None:
            self._P[..., PLACE, PLACE] += ego_step_cov(self._x[..., PLACE], T_world_ego, ego_cov)

    def _relax(self, state: int, keep: Floats | float, mean: Floats | float, variance: Floats) -> None:
        """Draws a state towards its mean (N, 1); `keep` (N, 1) is the correlation with its value before."""
        keep = np.broadcast_to(keep, (len(self._x), 1))
        self._x[..., state] = mean + keep * (self._x[..., state] - mean)
        self._P[..., state, :] *= keep[..., None]
        self._P[..., state] *= keep[..., None]
        self._P[..., state, state] += (1.0 - keep**2) * variance

    def add(self, kinds: Sequence[int], boxes: Boxes, heights: Floats, sigma_width: Floats, T_world_ego: SE2) -> None:
        """Adds road users (M,) in rows after the others, about where their boxes are, but not corrected by these.

        `heights` (M, 2, 2) are mean (m) and relative 1-sigma of usual and odd size, `sigma_width` (M,) that of log w.
        """
        n, of_size = len(kinds), np.repeat([0, 1], len(MOTIONS))
        before, self._kind = len(self._x), np.append(self._kind, np.array(kinds, dtype=np.intp))
        self._direction_rad = np.append(self._direction_rad, boxes.direction_rad)
        self._reach_m, self._top_m = np.append(self._reach_m, boxes.reach_m), np.append(self._top_m, boxes.top_m)
        kind = self._kind[before:]
        x, P = np.zeros((n, self._x.shape[1], len(STATES))), np.zeros((n, self._x.shape[1], len(STATES), len(STATES)))
        log_height, own_var = np.log(heights[:, of_size, 0]), np.square(heights[:, of_size, 1])
        depth = np.exp(log_height - boxes.z[:, None, TALL]) + (boxes.reach_m - boxes.top_m)[:, None]
        depth = np.clip(depth, MIN_DISTANCE_M, bev.MAX_RANGE_M)
        at = np.stack([depth, boxes.z[:, None, BEARING] * depth], axis=-1)
        x[..., PLACE] = at @ T_world_ego.rotation().T + [T_world_ego.x_m, T_world_ego.y_m]
        mean, cov = initial_velocities(self._motions[kind], boxes.direction_rad)
        x[..., VELOCITY] = np.tile(mean, (1, 2, 1))
        P[..., VELOCITY, VELOCITY] = np.tile(cov, (1, 2, 1, 1))
        (tilt, tilt_var), (body, body_var) = self._common
        x[..., HEIGHT], x[..., TILT] = log_height + body, tilt
        x[..., FOOT], x[..., HEAD] = self._of("foot_rel", kind), -self._of("head_rel", kind)
        offset = np.hypot(self._of("sigma_offset_m", kind), self._of("sigma_crown_rad", kind) * at[..., 1])
        P[..., X, X] = P[..., Y, Y] = np.square(INITIAL_DEPTH_SIGMA_REL * depth)
        P[..., HEIGHT, HEIGHT], P[..., WIDTH, WIDTH] = own_var + body_var, np.square(sigma_width)[:, None]
        P[..., TILT, TILT], P[..., OFFSET, OFFSET] = tilt_var + self._of("sigma_tilt_rad", kind) ** 2, offset**2
        P[..., FOOT, FOOT] = P[..., HEAD, HEAD] = self._of("sigma_outline_rel", kind) ** 2
        self._x, self._P = np.concatenate([self._x, x]), np.concatenate([self._P, P])
        self._weight = np.concatenate([self._weight, np.maximum(self._ratios[kind], MIN_WEIGHT)])
        self._log_height = np.concatenate([self._log_height, log_height])
        self._own_var = np.concatenate([self._own_var, own_var])
        self._unseen_s = np.append(self._unseen_s, np.full(n, np.inf))
        self._born_m = np.concatenate([self._born_m, np.tile([T_world_ego.x_m, T_world_ego.y_m], (n, 1))])
        self._driven_s = np.append(self._driven_s, np.zeros(n))

    def correct(
        self, rows: Sequence[int], boxes: Boxes, T_world_ego: SE2, road: RoadProfile, iterations: int = 1
    ) -> Floats:
        """Updates the road users in `rows` by their boxes, one each; returns the probability of each case (M, C).

        `iterations` of an iterated Kalman filter linearize it, as if the boxes were complete (the first case).
        """
        if not len(boxes.z):
            return np.zeros_like(boxes.cases.prior)
        at = np.asarray(rows, dtype=np.intp)
        self._direction_rad[at], self._reach_m[at], self._top_m[at] = boxes.direction_rad, boxes.reach_m, boxes.top_m
        x0, P0 = self._x[at], self._P[at]
        P0[..., WIDTH, WIDTH] += boxes.outline_var[:, None]
        of_box, of_view = (self._correlated(at, name) for name in ("box_memory_s", "view_memory_s"))
        of_one, lasting = boxes.R.copy(), boxes.R * of_box[:, None, None]
        of_one[:, _SIZES, _SIZES] += boxes.face_var[:, None]
        lasting[:, _SIZES, _SIZES] += (boxes.face_var * of_view)[:, None]
        x = x0
        for left in reversed(range(iterations)):
            expected, J = expected_boxes(x, boxes.reach_m, boxes.top_m, T_world_ego, road)
            PJt = P0 @ J.swapaxes(-1, -2)
            predicted = J @ PJt
            innovation = boxes.z[:, None] - expected - (J @ (x0 - x)[..., None])[..., 0]
            if left:
                x = x0 + (PJt @ np.linalg.solve(predicted + lasting[:, None], innovation[..., None]))[..., 0]

        # The cases of each box, (M, K, C). Errors last: the update uses inflated noise, and a box is evidence once per
        # correlation time, or repeated boxes favour one filter
        cases = boxes.cases
        of_case = cases.sigma[..., :, None] * cases.sigma[..., None, :]
        gap = innovation[:, :, None] - cases.shift[:, None]
        S = predicted[:, :, None] + (lasting[:, None] + of_case * of_box[:, None, None, None])[:, None]
        P, PJt = P0[:, :, None], PJt[:, :, None]
        if cases.jump_m.any():
            along = np.stack([np.cos(boxes.direction_rad), np.sin(boxes.direction_rad)], axis=-1)
            jump = np.zeros((*x0.shape[:2], len(cases.jump_m), len(STATES)))
            jump[..., PLACE] = (cases.jump_m * along[:, None])[:, None]
            of_jump = jump @ J.swapaxes(-1, -2)
            S += of_jump[..., :, None] * of_jump[..., None, :]
            P, PJt = P + jump[..., :, None] * jump[..., None, :], PJt + jump[..., :, None] * of_jump[..., None, :]
        gain = PJt @ np.linalg.inv(S)
        x = x0[:, :, None] + (gain @ gap[..., None])[..., 0]
        P = P - gain @ PJt.swapaxes(-1, -2)
        S += (of_one - lasting)[:, None, None]
        squared = (gap * np.linalg.solve(S, gap[..., None])[..., 0]).sum(axis=-1)
        evidence = -0.5 * (squared + np.linalg.slogdet(S)[1])
        evidence += np.log(np.maximum(cases.prior, _MIN_PROBABILITY))[:, None]
        best = evidence.max(axis=2, keepdims=True)
        share = np.exp(evidence - best)
        total = share.sum(axis=2, keepdims=True)
        share /= total
        self._x[at], P = merge_mixture(x, P, share)
        self._P[at] = (P + P.swapaxes(-1, -2)) / 2.0
        log_weight = np.log(self._weight[at]) + (best + np.log(total))[..., 0] / of_box[:, None]
        weight = np.exp(log_weight - log_weight.max(axis=1, keepdims=True))
        weight = np.maximum(weight / weight.sum(axis=1, keepdims=True), MIN_WEIGHT)
        self._weight[at] = weight / weight.sum(axis=1, keepdims=True)
        self._unseen_s[at] = 0.0
        out: Floats = (self._weight[at][..., None] * share).sum(axis=1)
        return out

    def _correlated(self, at: NDArray[np.intp], memory: str) -> Floats:
        """(M,) number of consecutive boxes with the same error."""
        return np.maximum(1.0, self._of(memory, self._kind[at]).ravel() / np.maximum(self._unseen_s[at], _MIN_DT_S))

    def moments(self, after_s: float = 0.0, stands: Bools | None = None) -> Moments:
        """Moments of all road users, extrapolated by `after_s`.

        The velocity is that of the moving filters, or 0 for `stands` (N,); the covariance about it includes the
        probability of the other case.
        """
        mean, cov = merge_mixture(self._x, self._P, self._weight)
        standing = self.stationary_probability()
        moving = self._weight.copy()
        moving[:, STATIONARY :: len(MOTIONS)] = 0.0
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
            q = (1.0 - standing) * np.square(self._motions[self._kind, CROSSING, 3])
            cov[:, [X, Y], [X, Y]] += (q * after_s**3 / 3.0)[:, None]
            cov[:, [VX, VY], [VX, VY]] += (q * after_s)[:, None]
        return Moments(mean, cov, standing, self._weight[:, len(MOTIONS) :].sum(axis=1))

    def stationary_probability(self) -> Floats:
        """(N,) probability of being stationary."""
        out: Floats = self._weight[:, STATIONARY :: len(MOTIONS)].sum(axis=1)
        return out

    def sizes_by_growth(self, rows: Sequence[int], boxes: Boxes, T_world_ego: SE2) -> GrownSize:
        """The sizes of the vehicles in `rows` after their `boxes` (M,).

        Errors of boxes change while the ego drives only. Of n boxes with different errors, over a baseline b, an error
        of the height of one is an error of the distance z by the factor z / b / sqrt(n).
        """
        at, ego_m = np.asarray(rows, dtype=np.intp), [T_world_ego.x_m, T_world_ego.y_m]
        stationary = slice(STATIONARY, None, len(MOTIONS))
        weight = self._weight[at, stationary]
        share = weight / weight.sum(axis=1, keepdims=True)
        # The prior of each filter is removed from its posterior; the filters are pooled by their mean log likelihood
        P, prior_P = self._P[at, stationary, HEIGHT, HEIGHT], self._own_var[at, stationary]
        prior = self._log_height[at, STATIONARY]
        information = np.maximum((share * (1.0 / P - 1.0 / prior_P)).sum(axis=1), 1.0 / UNKNOWN_VARIANCE)
        learned = (share * (self._x[at, stationary, HEIGHT] - prior[:, None]) / P).sum(axis=1) / information
        place = (share[..., None] * self._x[at, stationary, PLACE]).sum(axis=1)
        z2, b2 = np.square(place - ego_m).sum(axis=1), np.square(self._born_m[at] - ego_m).sum(axis=1)
        different = 1.0 + self._driven_s[at] / self._of("box_memory_s", self._kind[at]).ravel()
        lasting = boxes.R[:, TALL, TALL] / different * z2 / np.maximum(b2, z2 / UNKNOWN_VARIANCE)
        lasting += boxes.face_var + SIGMA_SCALE_REL**2
        square = np.square(self._x[at][..., VELOCITY]).sum(axis=-1)
        return GrownSize(
            prior + np.where(information > 1.0 / UNKNOWN_VARIANCE, learned, 0.0),
            1.0 / information + lasting,
            self.stationary_probability()[at],
            np.sqrt((self._weight[at] * square).sum(axis=1)),
        )

    def set_common_priors(self, priors: Floats) -> None:
        """Replaces the priors of the common tilt and height, information of rank one in each filter.

        `priors` (2, 2) are means and variances. The prior of the tilt fades while the ego drives, since predict() draws
        the tilt to the new one.
        """
        own_tilt_var = self._of("sigma_tilt_rad") ** 2
        means = (
            (TILT, np.zeros((1, 1)), 1.0 - self._driving, own_tilt_var),
            (HEIGHT, self._log_height, 1.0, self._own_var),
        )
        for (state, base, kept, own), old, new in zip(means, self._common, priors, strict=True):
            before, now = 1.0 / (own + old[1]), 1.0 / (own + new[1])
            Pa = self._P[..., state]  # (N, F, S)
            change = np.maximum(kept * (now - before), -0.5 / Pa[..., state])
            gain = Pa / (1.0 + change * Pa[..., state])[..., None]
            drawn = kept * (now * new[0] - before * old[0])
            self._x = self._x + gain * (drawn - change * (self._x[..., state] - base))[..., None]
            self._P = self._P - change[..., None, None] * gain[..., :, None] * Pa[..., None, :]
        self._common = priors

    def distances(
        self, boxes: Boxes, T_world_ego: SE2, road: RoadProfile, beside: Floats | float = 0.0
    ) -> tuple[Floats, Floats]:
        """(C, N, M) squared Mahalanobis distances of boxes from road users, and -2 log likelihoods, by case of a box.

        The width is not used: shapes are compared from box to box. `beside` (N,) is the bearing from the centre of a
        road user to the middle of its box.
        """
        expected, J = expected_boxes(self._x, self._reach_m, self._top_m, T_world_ego, road)
        expected, J = expected[..., :WIDE], J[..., :WIDE, :]
        mean, S = merge_mixture(expected, J @ self._P @ J.swapaxes(-1, -2), self._weight)
        mean[:, BEARING] += beside
        cases = boxes.cases
        sigma = cases.sigma[..., :WIDE].swapaxes(0, 1)  # (C, M, 3)
        noise = boxes.R[:, :WIDE, :WIDE] + sigma[..., :, None] * sigma[..., None, :]
        noise[..., TALL, TALL] += boxes.face_var
        whole = S[:, None] + noise[:, None]  # (C, N, M, 3, 3)
        gap = boxes.z[:, :WIDE] - cases.shift[..., :WIDE].swapaxes(0, 1)[:, None] - mean[:, None]
        squared = (gap * np.linalg.solve(whole, gap[..., None])[..., 0]).sum(axis=-1)
        prior = np.log(np.maximum(cases.prior.T, _MIN_PROBABILITY))[:, None]
        return squared, squared + np.linalg.slogdet(whole)[1] - 2.0 * prior
