"""Where people are and how they move: Kalman filters, one for each way of moving and height, mixed by likelihood.

    x = [x, y, vx, vy, log h, tilt, kerb, foot, head]

With H the camera's height, b the kerb (the road under the feet lies b lower than the ego's plane), and slopes that
count downwards from the plane of the road, the box of somebody at depth X, whose nearest foot is at X - reach, measures

    bearing = Y / X,   bottom = (H + b) / (X - reach) - tilt + foot h / X (Eq. 1),
    log of the height = log(h) - log(X) + log(1 + reach (H + b) / ((X - reach) h)) + foot - head,
    log of the width = log(w) - log(X),

where foot and head are errors of the box that last for a while: somebody's pose, what a detector makes of clothes. The
logarithms keep the derivatives the same from frame to frame; with the top's slope in their place the filter grows too
sure of itself. Feet that something hides are a second hypothesis of each box: then it ends higher by a share of h / X.

People stand, walk along the road or walk anyhow, and change between these (interacting multiple model, Blom and
Bar-Shalom 1988), each with a grown-up's height and with a child's, which does not change. So the road places first and
the size second: a small box whose foot is near is a child's, and no distant adult's. Tilt, kerb and height are states,
so that what lasts for a track is not averaged away.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry import bev
from birdslam.geometry.se2 import SE2
from birdslam.people.people_boxes import PEDESTRIAN, PersonBox

Floats = NDArray[np.float64]

STATES = X, Y, VX, VY, HEIGHT, TILT, KERB, FOOT, HEAD = range(9)
# Who moves along the road comes towards the ego or goes away from it; others cross, or walk anyhow
MOTIONS = STANDING, TOWARDS, AWAY, CROSSING = range(4)
FILTERS = 2 * len(MOTIONS)  # for an adult's height, and for a child's
STANDING_FILTERS, CHILD_FILTERS = [STANDING, len(MOTIONS) + STANDING], slice(len(MOTIONS), None)
VELOCITY = slice(2, 4)
BEARING, BOTTOM, TALL, WIDTH = range(4)
UNUSED = 1e3  # 1-sigma of what is not measured
DEPTH_UNKNOWN = 0.6  # 1-sigma at birth, as a fraction
NEAREST_M = 0.7
BIRTH_ITERATIONS, ITERATIONS = 4, 1
MIN_WEIGHT = 1e-6  # of a filter: one that was ruled out may come back
MIN_SLOPE = 1e-3


class Sizes(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a kind of road user measures, and how it moves."""

    height_m: float  # mean of grown-ups
    sigma_height_rel: float  # 1-sigma of it
    child_m: float  # mean height of children
    sigma_child_rel: float  # 1-sigma of it
    child: float  # of them, are children
    width_m: float  # mean of boxes
    sigma_width_rel: float  # 1-sigma of it
    length_m: float  # of the footprint
    footprint_m: float  # its width
    reach_m: float  # from the centre to the nearest foot or wheel, along the line of sight
    along_mps: float  # speed of who moves along the road
    sigma_along_mps: float  # 1-sigma of it
    sigma_beside_mps: float  # 1-sigma of the velocity across it
    crossing_mps: float  # 1-sigma of the velocity of who moves anyhow
    change_mps: float  # 1-sigma by which a velocity changes within a second


class PeopleConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Priors of people and of the road under them, and how long the errors of a box last."""

    # Heights by KITTI tracking's labels, widths of boxes, how people walk; docs/constants.md has the data
    pedestrian: Sizes = Sizes(
        height_m=1.72,
        sigma_height_rel=0.075,
        child_m=1.2,
        sigma_child_rel=0.15,
        child=0.06,
        width_m=0.68,
        sigma_width_rel=0.3,
        length_m=0.7,
        footprint_m=0.6,
        reach_m=0.25,
        along_mps=1.3,
        sigma_along_mps=0.4,
        sigma_beside_mps=0.25,
        crossing_mps=1.1,
        change_mps=0.5,
    )
    cyclist: Sizes = Sizes(  # with the rider
        height_m=1.74,
        sigma_height_rel=0.07,
        child_m=1.45,
        sigma_child_rel=0.12,
        child=0.06,
        width_m=0.9,
        sigma_width_rel=0.5,
        length_m=1.75,
        footprint_m=0.6,
        reach_m=0.6,
        along_mps=4.5,
        sigma_along_mps=2.0,
        sigma_beside_mps=0.5,
        crossing_mps=4.0,
        change_mps=1.2,
    )
    standing: float = 0.2  # of them stand when first seen
    stands_for_s: float = 10.0  # on average
    moves_for_s: float = 10.0  # until a stop
    crossing: float = 0.3  # of those who move
    turns_after_s: float = 10.0  # from one way of moving to another
    stop_mps: float = 0.08  # 1-sigma of the velocity of who stands: they sway
    sigma_tilt_rad: float = 0.012  # of the road at somebody against the ego's, beside the front end's own sigma
    tilt_memory_s: float = 5.0  # of driving: how long that lasts
    tilt_drift_rad: float = 0.006  # and by how much it changes within a second as people walk on
    driving_mps: float = 1.0  # as `GroundSizeConfig.driving_mps`
    sigma_roll_rad: float = 0.01  # of the front end's roll, which tilts what is aside
    kerb_m: float = -0.03  # people are on pavements too
    sigma_kerb_m: float = 0.1  # 1-sigma of it
    hidden_share: float = 0.3  # of a person's height, that is hidden where the feet are
    sigma_hidden_share: float = 0.35  # 1-sigma of it
    box_memory_s: float = 0.4  # for so long a box has the same error: this time counts as one box
    width_memory_s: float = 5.0  # and its width, by clothes and by what is carried: it counts once in so long
    outline_memory_s: float = 2.0  # errors that last: a box that is drawn too low or too high, by
    sigma_outline_rel: float = 0.05  # of its height
    sure_feet: float = 0.01  # a box whose feet are hidden with less probability tells of the road
    sigma_common_rel: float = 0.03  # of the mean height of those who are there

    def sizes(self, label: str) -> Sizes:
        """Of a kind."""
        return self.pedestrian if label == PEDESTRIAN else self.cyclist


@dataclass(frozen=True)
class Moments:
    """Means (N, 9) and covariances (N, 9, 9) of the mixtures, and the probabilities (N,) of standing and a child."""

    mean: Floats
    cov: Floats
    standing: Floats
    child: Floats


class PeopleFilter:
    """predict() once a frame, then correct() the rows that boxes are of, and begin() new ones.

    State, of each person and each filter: x, y (m), vx, vy (m/s) in the odometry's world, log of the height in metres,
    tilt (rad) and kerb (m) of the road there against the front end's ground. Measurements: of each box the bearing, the
    slopes of its bottom and top, the log of its width (see the module). Read by `people_tracker` for association, and
    by `people_edges`.
    """

    def __init__(self, config: PeopleConfig) -> None:
        self.config = config
        self._x = np.zeros((0, FILTERS, len(STATES)))
        self._P = np.zeros((0, FILTERS, len(STATES), len(STATES)))
        self._weight = np.zeros((0, FILTERS))
        self._unseen_s = np.zeros(0)
        self._sizes = np.zeros((0, 4))  # reach, change, log width, sigma width
        self._moves = np.zeros((0, len(MOTIONS), 3))  # speed along the road, 1-sigma of it and of that across it
        self._tilt_prior = np.zeros((0, 2))  # mean and variance, as the front end and the others have it

    def __len__(self) -> int:
        return len(self._x)

    def keep_rows(self, rows: Sequence[int]) -> None:
        """Forgets all others."""
        self._x, self._P, self._weight = self._x[rows], self._P[rows], self._weight[rows]
        self._unseen_s, self._sizes = self._unseen_s[rows], self._sizes[rows]
        self._tilt_prior, self._moves = self._tilt_prior[rows], self._moves[rows]

    def predict(
        self,
        dt_s: float,
        T_world_ego: SE2,
        ego_cov: Floats | None,
        ground_shift_rad: float,
        ego_mps: float,
    ) -> None:
        """To the next frame: people move, and the ground's estimate moved by `ground_shift_rad` beside its own motion.

        `ego_cov` (3, 3) is of the ego's step, in its tangent.
        """
        config, n = self.config, len(self._x)
        if not n or dt_s <= 0.0:
            return
        self._unseen_s += dt_s
        self._mix(dt_s, T_world_ego.yaw_rad)
        F = np.eye(len(STATES))
        F[X, VX] = F[Y, VY] = dt_s
        self._x = self._x @ F.T
        self._P = F @ self._P @ F.T
        q = np.square(self._sizes[:, 1])[:, None]
        moving = np.ones(FILTERS, dtype=np.bool_)
        moving[STANDING_FILTERS] = False
        for at, by in ((X, VX), (Y, VY)):
            self._P[:, moving, at, at] += q * dt_s**3 / 3.0
            self._P[:, moving, at, by] += q * dt_s**2 / 2.0
            self._P[:, moving, by, at] += q * dt_s**2 / 2.0
            self._P[:, moving, by, by] += q * dt_s
        driving = -math.expm1(-ego_mps / config.driving_mps)
        keep = math.exp(-driving * dt_s / config.tilt_memory_s)
        mean, var = self._tilt_prior.T
        self._x[..., TILT] = mean[:, None] + keep * (self._x[..., TILT] - ground_shift_rad - mean[:, None])
        self._P[..., TILT, :] *= keep
        self._P[..., TILT] *= keep
        self._P[..., TILT, TILT] += ((1.0 - keep**2) * (var + config.sigma_tilt_rad**2))[:, None]
        self._P[..., TILT, TILT] += config.tilt_drift_rad**2 * dt_s
        keep = math.exp(-dt_s / config.outline_memory_s)
        for state in (FOOT, HEAD):
            self._x[..., state] *= keep
            self._P[..., state, :] *= keep
            self._P[..., state] *= keep
            self._P[..., state, state] += (1.0 - keep**2) * config.sigma_outline_rel**2
        if ego_cov is not None:  # an error of the ego's step moves everybody against it
            from_ego = self._x[..., :2] - [T_world_ego.x_m, T_world_ego.y_m]
            J = np.zeros((n, FILTERS, 2, 3))
            J[..., :2, :2] = T_world_ego.rotation()
            J[..., 0, 2], J[..., 1, 2] = -from_ego[..., 1], from_ego[..., 0]
            self._P[..., :2, :2] += J @ ego_cov @ J.swapaxes(-1, -2)

    def _mix(self, dt_s: float, road_rad: float) -> None:
        """People start, stop and turn: who starts has the velocities of that way of moving, who stops has none."""
        config, n, m = self.config, len(self._x), len(MOTIONS)
        start, stop, turn = (
            -math.expm1(-dt_s / s) for s in (config.stands_for_s, config.moves_for_s, config.turns_after_s)
        )
        share = self._shares()[1:] / (1.0 - config.standing)
        change = np.zeros((m, m))  # from, to
        change[STANDING, 1:] = start * share
        change[1:, STANDING] = stop
        change[1:, 1:] = (1.0 - stop) * turn * share
        change[np.diag_indices(m)] += 1.0 - change.sum(axis=1)
        x = np.repeat(self._x.reshape(n, 2, 1, m, -1), m, axis=2)  # height, to, from
        P = np.repeat(self._P.reshape(n, 2, 1, m, len(STATES), -1), m, axis=2)
        mean, cov = self._velocities(road_rad)
        began = np.zeros((m, m), dtype=np.bool_)  # to, from
        began[1:, STANDING] = began[STANDING, 1:] = True
        x[:, :, began, VELOCITY] = 0.0
        P[:, :, began, VELOCITY] = 0.0
        P[:, :, began, :, VELOCITY] = 0.0
        for to in MOTIONS:
            sources = began[to]
            x[:, :, to, sources, VELOCITY] = mean[:, None, to, None]
            P[:, :, to, sources, VELOCITY, VELOCITY] = cov[:, None, to, None]
        weight = self._weight.reshape(n, 2, 1, m) * change.T
        total = np.maximum(weight.sum(axis=-1), 1e-300)
        mixed_x, mixed_P = _merged(x, P, weight / total[..., None])
        self._x, self._P = mixed_x.reshape(self._x.shape), mixed_P.reshape(self._P.shape)
        self._weight = total.reshape(n, FILTERS)
        self._weight /= self._weight.sum(axis=1, keepdims=True)

    def _shares(self) -> Floats:
        """(4,) of the motions, when first seen."""
        config = self.config
        along = (1.0 - config.standing) * (1.0 - config.crossing) / 2.0
        return np.array([config.standing, along, along, (1.0 - config.standing) * config.crossing])

    def _velocities(self, road_rad: float) -> tuple[Floats, Floats]:
        """Means (N, 4, 2) and covariances (N, 4, 2, 2) of the velocities with which each motion begins, in world."""
        c, s = math.cos(road_rad), math.sin(road_rad)
        R = np.array([[c, -s], [s, c]])
        speed, along, beside = np.moveaxis(self._moves, -1, 0)
        D = np.zeros((*speed.shape, 2, 2))
        D[..., 0, 0], D[..., 1, 1] = along**2, beside**2
        return speed[..., None] * R[:, 0], R @ D @ R.T

    def begin(self, boxes: Sequence[PersonBox], tilt_prior: Floats, T_world_ego: SE2, height_m: float) -> None:
        """People seen for the first time, each in a row after the others, already corrected by their boxes.

        `tilt_prior` (N, 2): mean and variance of the road's tilt there against the front end's ground.
        """
        if not boxes:
            return
        config, n, before = self.config, len(boxes), len(self._x)
        x, P = np.zeros((n, FILTERS, len(STATES))), np.zeros((n, FILTERS, len(STATES), len(STATES)))
        weight, rows = np.zeros((n, FILTERS)), np.zeros((n, 4))
        moves = np.zeros((n, len(MOTIONS), 3))
        for k, box in enumerate(boxes):
            sizes = config.sizes(box.label)
            moves[k] = [
                (0.0, config.stop_mps, config.stop_mps),
                (-sizes.along_mps, sizes.sigma_along_mps, sizes.sigma_beside_mps),
                (sizes.along_mps, sizes.sigma_along_mps, sizes.sigma_beside_mps),
                (0.0, sizes.crossing_mps, sizes.crossing_mps),
            ]
            rows[k] = [
                sizes.reach_m, sizes.change_mps, math.log(sizes.width_m), sizes.sigma_width_rel
            ]  # fmt: skip
            for child, (h_m, sigma) in enumerate(
                ((sizes.height_m, sizes.sigma_height_rel), (sizes.child_m, sizes.sigma_child_rel))
            ):
                x_m = min(h_m / max(box.tan_height, MIN_SLOPE), bev.MAX_RANGE_M)
                both = slice(len(MOTIONS) * child, len(MOTIONS) * (child + 1))
                x[k, both, :2] = T_world_ego @ np.array([x_m, box.bearing * x_m])
                x[k, both, HEIGHT], x[k, both, KERB] = math.log(h_m), config.kerb_m
                P[k, both, :2, :2] = np.eye(2) * (DEPTH_UNKNOWN * x_m) ** 2
                P[k, both, HEIGHT, HEIGHT] = sigma**2
                weight[k, both] = (sizes.child if child else 1.0 - sizes.child) * self._shares()
            x[k, :, TILT] = tilt_prior[k, 0]
            P[k, :, TILT, TILT] = (
                tilt_prior[k, 1] + config.sigma_tilt_rad**2 + (config.sigma_roll_rad * box.bearing) ** 2
            )
            P[k, :, [FOOT, HEAD], [FOOT, HEAD]] = config.sigma_outline_rel**2
            P[k, :, KERB, KERB] = config.sigma_kerb_m**2
        self._moves = np.concatenate([self._moves, moves])
        mean, cov = self._velocities(T_world_ego.yaw_rad)
        x[..., VELOCITY] = np.tile(mean[before:], (1, 2, 1))
        P[..., VELOCITY, VELOCITY] = np.tile(cov[before:], (1, 2, 1, 1))
        self._x, self._P = np.concatenate([self._x, x]), np.concatenate([self._P, P])
        self._weight = np.concatenate([self._weight, weight])
        self._sizes = np.concatenate([self._sizes, rows])
        self._tilt_prior = np.concatenate([self._tilt_prior, tilt_prior])
        self._unseen_s = np.concatenate([self._unseen_s, np.full(n, max(config.box_memory_s, config.width_memory_s))])
        self.correct(range(before, before + n), boxes, T_world_ego, height_m, BIRTH_ITERATIONS)

    def correct(
        self,
        rows: Sequence[int],
        boxes: Sequence[PersonBox],
        T_world_ego: SE2,
        height_m: float,
        iterations: int = ITERATIONS,
    ) -> None:
        """The people in `rows` by their boxes, one each; `height_m` is the camera's over the road."""
        if not boxes:
            return
        at = np.asarray(rows)
        z, R = self._measured(at, boxes)  # (M, 4), (M, 4, 4)
        hidden = np.array([box.hidden for box in boxes])
        x0, P0 = self._x[at][:, :, None], self._P[at][:, :, None]  # (M, K, 1, 9)
        x = np.repeat(x0, 2, axis=2)
        for _ in range(iterations):
            expected, J = self._expected(x, at, T_world_ego, height_m)
            noise = np.broadcast_to(R[:, None, None], (*x.shape[:3], 4, 4)).copy()
            _hide_feet(noise[:, :, 1], np.exp(expected[:, :, 0, TALL]), self.config)
            PJt = P0 @ J.swapaxes(-1, -2)
            S = J @ PJt + noise
            innovation = z[:, None, None] - expected - ((x0 - x)[..., None, :] @ J.swapaxes(-1, -2))[..., 0, :]
            information = np.linalg.inv(S)
            gain = PJt @ information
            x = x0 + (gain @ innovation[..., None])[..., 0]
        P = P0 - gain @ PJt.swapaxes(-1, -2)
        P = (P + P.swapaxes(-1, -2)) / 2.0
        squared = (innovation[..., None, :] @ information @ innovation[..., None])[..., 0, 0]
        log_likelihood = -0.5 * (squared + np.linalg.slogdet(S)[1])
        log_weight = log_likelihood + np.log(np.stack([1.0 - hidden, hidden], axis=1))[:, None]
        log_weight += np.log(np.maximum(self._weight[at], 1e-300))[:, :, None]
        log_weight -= log_weight.max(axis=(1, 2), keepdims=True)
        weight = np.exp(log_weight)
        weight /= weight.sum(axis=(1, 2), keepdims=True)
        share = weight / np.maximum(weight.sum(axis=2, keepdims=True), 1e-300)
        self._x[at], self._P[at] = _merged(x, P, share)
        of_filters = np.maximum(weight.sum(axis=2), MIN_WEIGHT)
        self._weight[at] = of_filters / of_filters.sum(axis=1, keepdims=True)
        self._unseen_s[at] = 0.0

    def _measured(self, at: NDArray[np.intp], boxes: Sequence[PersonBox]) -> tuple[Floats, Floats]:
        """(M, 4) of the boxes, and their covariances (M, 4, 4), more where an error is the one of the frames before."""
        config = self.config
        z, R = measured_boxes(boxes)
        unseen_s = self._unseen_s[at]
        R *= np.maximum(1.0, config.box_memory_s / unseen_s)[:, None, None]
        uses = np.array([b.whole for b in boxes]) & (unseen_s >= config.width_memory_s)
        R[:, WIDTH, WIDTH] = np.where(uses, self._sizes[at, 3], UNUSED) ** 2
        return z, R

    def _expected(self, x: Floats, at: NDArray[np.intp], T_world_ego: SE2, height_m: float) -> tuple[Floats, Floats]:
        """Measurements (M, K, 2, 4) expected of states (M, K, 2, 9), feet visible and hidden, and their Jacobians."""
        R = T_world_ego.rotation()
        in_ego = (x[..., :2] - [T_world_ego.x_m, T_world_ego.y_m]) @ R
        depth, y = np.maximum(in_ego[..., 0], NEAREST_M), in_ego[..., 1]
        foot = np.maximum(depth - self._sizes[at, 0][:, None, None], 0.5 * NEAREST_M)
        height, below = np.exp(x[..., HEIGHT]), height_m + x[..., KERB]
        expected, J = np.empty((*x.shape[:3], 4)), np.zeros((*x.shape[:3], 4, len(STATES)))
        expected[..., BEARING] = y / depth
        tall = height / depth
        expected[..., BOTTOM] = bev.road_slope(foot, below) - x[..., TILT] + x[..., FOOT] * tall  # Eq. 1
        nearer = (depth - foot) * below / (foot * height)  # how much taller a nearer foot makes it
        expected[..., TALL] = x[..., HEIGHT] - np.log(depth) + np.log1p(nearer) + x[..., FOOT] - x[..., HEAD]
        expected[..., WIDTH] = self._sizes[at, 2][:, None, None] - np.log(depth)
        by_depth = np.stack([-y / depth**2, -below / foot**2, -(1.0 + nearer) / depth, -1.0 / depth], axis=-1)
        J[..., :2] = by_depth[..., None] * R[:, 0]
        J[..., BEARING, :2] += R[:, 1] / depth[..., None]
        J[..., BOTTOM, TILT], J[..., BOTTOM, KERB], J[..., BOTTOM, FOOT] = -1.0, 1.0 / foot, tall
        J[..., TALL, HEIGHT], J[..., TALL, FOOT], J[..., TALL, HEAD] = 1.0, 1.0, -1.0
        # Where feet are hidden the box ends higher, by a share of the height, and is so much shorter
        share = self.config.hidden_share
        expected[:, :, 1, BOTTOM] -= share * tall[:, :, 1]
        expected[:, :, 1, TALL] += math.log(1.0 - share)
        return expected, J

    def moments(self, after_s: float = 0.0) -> Moments:
        """Of everybody, `after_s` later, as they move."""
        mean, cov = _merged(self._x, self._P, self._weight)
        if after_s > 0.0 and len(mean):
            F = np.eye(len(STATES))
            F[X, VX] = F[Y, VY] = after_s
            mean, cov = mean @ F.T, F @ cov @ F.T
            q = (1.0 - self._weight[:, STANDING_FILTERS].sum(axis=1)) * np.square(self._sizes[:, 1])
            cov[:, [X, Y], [X, Y]] += (q * after_s**3 / 3.0)[:, None]
            cov[:, [VX, VY], [VX, VY]] += (q * after_s)[:, None]
        return Moments(
            mean, cov, self._weight[:, STANDING_FILTERS].sum(axis=1), self._weight[:, CHILD_FILTERS].sum(axis=1)
        )

    def tilts_of(self, boxes: Sequence[PersonBox], sigma_pitch_rad: float, height_m: float) -> Floats:
        """(N, 2): mean and variance of the road's tilt against the front end's ground, as everybody else's box has it.

        A box alone tells it by the height of its kind; its own must not be told to it twice. Of several the mean is
        known no better than the mean of heights is.
        """
        config, n = self.config, len(boxes)
        if not n:
            return np.zeros((0, 2))
        tilt, variance, slope = np.zeros(n), np.full(n, UNUSED), np.zeros(n)
        for k, box in enumerate(boxes):
            if box.whole and box.hidden <= config.sure_feet and box.tan_height > MIN_SLOPE:
                sizes = config.sizes(box.label)
                depth = sizes.height_m / box.tan_height
                tilt[k] = bev.road_slope(max(depth - sizes.reach_m, NEAREST_M), height_m + config.kerb_m)
                tilt[k] -= box.slope_bottom
                rel = math.hypot(sizes.sigma_height_rel, 2.0 * config.sigma_outline_rel)
                slope[k] = height_m / depth
                variance[k] = (slope[k] * rel) ** 2 + (config.sigma_kerb_m / depth) ** 2
        weight = information = 1.0 / variance
        for _ in range(2):  # a child, or feet that something hides, tells another tilt (Cauchy)
            mean = float((weight * tilt).sum()) / (float(weight.sum()) + sigma_pitch_rad**-2)
            weight = information / (1.0 + information * np.square(tilt - mean) / 4.0)
        total = weight.sum() - weight + sigma_pitch_rad**-2  # of all others, and of the front end
        mean_tilt = ((weight * tilt).sum() - weight * tilt) / total
        by_heights = config.sigma_common_rel * ((weight * slope).sum() - weight * slope) / total
        return np.stack([mean_tilt, 1.0 / total + np.square(by_heights)], axis=1)

    def expect_tilt(self, rows: Sequence[int], tilt_prior: Floats) -> None:
        """What the next frames draw the tilts in `rows` to, (M, 2)."""
        self._tilt_prior[np.asarray(rows, dtype=np.intp)] = tilt_prior

    def distances(self, boxes: Sequence[PersonBox], T_world_ego: SE2, height_m: float) -> tuple[Floats, Floats]:
        """(N, M) squared Mahalanobis distances of boxes from everybody, and -2 log of their likelihoods.

        Each is the better one of feet visible and hidden.
        """
        n = len(self._x)
        x = np.repeat(self._x[:, :, None], 2, axis=2)
        expected, J = self._expected(x, np.arange(n), T_world_ego, height_m)
        expected, J = expected[..., :WIDTH], J[..., :WIDTH, :]
        S = J @ self._P[:, :, None] @ J.swapaxes(-1, -2)
        mean, S = _merged(expected.swapaxes(1, 2), S.swapaxes(1, 2), self._weight[:, None])  # (N, 2, 3), (N, 2, 3, 3)
        z, R = measured_boxes(boxes)
        noise = np.stack([R, R])
        _hide_feet(noise[1], np.exp(z[:, TALL]) / (1.0 - self.config.hidden_share), self.config)
        hidden = np.array([b.hidden for b in boxes])
        squared, told = np.full((n, len(boxes)), np.inf), np.full((n, len(boxes)), np.inf)
        for k, prior in enumerate((1.0 - hidden, hidden)):
            gap = z[None, :, :WIDTH] - mean[:, None, k]
            whole = S[:, None, k] + noise[k][None, :, :WIDTH, :WIDTH]
            d2 = (gap[..., None, :] @ np.linalg.inv(whole) @ gap[..., None])[..., 0, 0]
            cost = d2 + np.linalg.slogdet(whole)[1] - 2.0 * np.log(prior)[None]
            squared, told = np.where(cost < told, d2, squared), np.minimum(told, cost)
        return squared, told


def measured_boxes(boxes: Sequence[PersonBox]) -> tuple[Floats, Floats]:
    """(M, 4) bearing, bottom, log of the height and of the width, and their covariance (M, 4, 4); of width none."""
    tall = np.array([max(b.tan_height, MIN_SLOPE) for b in boxes])
    z = np.array([[b.bearing, b.slope_bottom, 0.0, b.log_width] for b in boxes])
    z[:, TALL] = np.log(tall)
    bottom, top = np.array([[b.sigma_bottom, b.sigma_top] for b in boxes]).T
    R = np.zeros((len(boxes), 4, 4))
    R[:, BEARING, BEARING] = np.square([b.sigma_bearing for b in boxes])
    R[:, BOTTOM, BOTTOM] = bottom**2
    R[:, BOTTOM, TALL] = R[:, TALL, BOTTOM] = bottom**2 / tall
    R[:, TALL, TALL] = (bottom**2 + top**2) / tall**2
    R[:, WIDTH, WIDTH] = UNUSED**2
    return z, R


def _hide_feet(noise: Floats, tall: Floats, config: PeopleConfig) -> None:
    """What hidden feet add to covariances (..., 4, 4) of boxes of `tall` (...), a height at a depth of 1, in place."""
    of_bottom, of_height = config.sigma_hidden_share * tall, config.sigma_hidden_share / (1.0 - config.hidden_share)
    noise[..., BOTTOM, BOTTOM] += of_bottom**2
    noise[..., BOTTOM, TALL] += of_bottom * of_height
    noise[..., TALL, BOTTOM] += of_bottom * of_height
    noise[..., TALL, TALL] += of_height**2


def _merged(x: Floats, P: Floats, weight: Floats) -> tuple[Floats, Floats]:
    """Mean (..., S) and covariance (..., S, S) of Gaussian mixtures (..., C, S), (..., C, S, S) by weights (..., C)."""
    mean = (weight[..., None] * x).sum(axis=-2)
    gap = x - mean[..., None, :]
    spread = P + gap[..., :, None] * gap[..., None, :]
    return mean, (weight[..., None, None] * spread).sum(axis=-3)
