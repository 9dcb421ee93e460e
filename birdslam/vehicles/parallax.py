"""How large vehicles are, from how they grow in the image as the ego drives: the parallax of what stands.

A box that grows from 20 to 40 pixels while the ego comes 30 m nearer is of a car that is 30 m away, however large cars
are, if it stands. If it drives, its growth says little of its size. Kalman filters, one for each way to move, are mixed
by how well each predicts the measurements (interacting multiple model, Blom and Bar-Shalom 1988). Each has

    x = [x, y, vx, vy, log h, log w]

in the odometry's world, m and m/s; h (m) is the vehicle's height, w its outline's width as a factor of its class's. The
measurements of a box are made of its slopes (see localisation.Observation), with z the depth of the nearest face, r on
to the roof's far edge, y/x the centre's bearing and H the camera's height:

    log(bottom - top - (H - h) r / (z (z + r))) = log h - log z
    log(left - right) = log w + log(class's outline) - log z
    y / x

and, for the weights of the filters alone, bottom = H / z (Eq. 1): the state learns nothing from that one, since the
ground and size filter does.

The result is a measurement of log h that holds all that motion says and nothing of what its class says. There is none
for a vehicle in the ego's own path: straight ahead there is no parallax. What stands there keeps its bearing, as does
what drives on before the ego; growth alone gives how fast the gap closes as a share of itself, which any size fits.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry import bev
from birdslam.geometry.se2 import SE2
from birdslam.vehicles.localisation import Observation

Floats = NDArray[np.float64]

STANDING, UNUSUAL, CREEPING, DRIVING = range(4)  # UNUSUAL stands too, and is of no usual size
STILL, MOVING = [STANDING, UNUSUAL], [CREEPING, DRIVING]
X, Y, VX, VY, HEIGHT, WIDTH = range(6)
UNKNOWN = 1e6  # variance of a size on which motion says nothing
DEPTH_UNKNOWN = 1.0  # 1-sigma at birth, as a fraction
LEAST_WEIGHT = 1e-9  # of a filter: one that was ruled out may come back
NEAREST_M = 1.0


class ParallaxConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How vehicles move and stop, and how long a detector errs alike."""

    standing: float = 0.3  # of the vehicles, when first seen; those that drive are the rest
    unusual: float = 0.03  # that stand and are of no usual size
    creeping: float = 0.3  # of the vehicles, when first seen
    sigma_unusual_rel: float = 0.3  # of their height
    sigma_creep_mps: float = 2.0  # 1-sigma of a creeping vehicle's velocity
    sigma_drive_mps: float = 10.0  # 1-sigma of a driving vehicle's velocity
    stands_for_s: float = 60.0  # on average, until it starts to creep
    creeps_for_s: float = 10.0  # until it stops, or drives
    drives_for_s: float = 20.0  # until it creeps
    change_mps: float = 2.0  # 1-sigma by which the velocity of a vehicle that moves changes within a second
    outline_drift_rel: float = 0.03  # of the outline's width, in a second: the yaw is not known as well
    box_memory_s: float = 0.5  # a box errs in the next frame as in this: this time counts as one box
    view_memory_s: float = 1.5  # and so do, for longer, the pitch and what is taken for the nearest face
    sigma_scale_rel: float = 0.02  # of the odometry's metres
    sigma_face_m: float = 1.0  # edges of a box lie not all at its nearest face, and on others as it turns
    path_half_width_m: float = 1.75  # of the ego's path: half a lane
    gate_sigma: float = 3.0  # past it of all filters a measurement is an outlier: its noise is raised


@dataclass(frozen=True)
class ParallaxMeasurements:
    """One frame's boxes (N,): see the module; `reach_m` from the nearest face to the centre."""

    log_height: Floats
    log_width: Floats  # less the class's outline
    bearing: Floats  # of the centre
    sigma: Floats  # (N, 3)
    depth_m: Floats  # about
    bottom: Floats  # slope
    sigma_bottom: Floats
    reach_m: Floats
    turned_rad: Floats  # by how much the line of sight turned since last seen: another side shows


@dataclass(frozen=True)
class LearnedSize:
    """Measurements of log h that exclude each other, (N, K): each holds with its weight, and has its variance."""

    weight: Floats
    log_height: Floats
    variance: Floats


def measure_boxes(
    seen: Sequence[Observation], centres_m: Floats, extents_m: Floats, turned_rad: Floats, roof_m2: Floats
) -> ParallaxMeasurements:
    """Of observations (N,), with each centre (N, 2) in ego at about its depth, and extents (N, 2) as of `extent_m`.

    `roof_m2` (N,): how far the camera stands above the roof times how far the roof reaches along the line of sight.
    """
    depth = np.maximum(centres_m[:, 0] - extents_m[:, 0] / 2.0, NEAREST_M)
    over_roof = roof_m2 / (depth * (depth + extents_m[:, 0]))
    sigma = [
        (
            math.hypot(o.sigma_top, o.sigma_bottom) / max(o.tan_height, 1e-3),
            math.hypot(o.sigma_left, o.sigma_right) / o.tan_width,
            math.hypot(o.sigma_left, o.sigma_right) / 2.0,
        )
        for o in seen
    ]
    return ParallaxMeasurements(
        log_height=np.log(np.maximum(np.array([o.tan_height for o in seen]) - over_roof, 1e-3)),
        log_width=np.log([o.tan_width for o in seen]) - np.log(extents_m[:, 1]),
        bearing=centres_m[:, 1] / centres_m[:, 0],
        sigma=np.array(sigma).reshape(-1, 3),
        depth_m=depth,
        bottom=np.array([o.slope_bottom for o in seen]),
        sigma_bottom=np.array([o.sigma_bottom for o in seen]),
        reach_m=extents_m[:, 0] / 2.0,
        turned_rad=turned_rad,
    )


class Parallax:
    """predict() once a frame, then learn_sizes() from its boxes.

    State, of each vehicle and each of four ways to move: x, y (m), vx, vy (m/s) in the odometry's world, log height (of
    metres), log of the outline's width as a factor, and the probability of that way. Measurements: of each box the logs
    of its height and width as slopes, and the bearing of its centre (see the module). `placing.Placing` hands the
    learned sizes to `ground_size_filter.GroundSizeFilter`; the tracker and the smoother read `standing`.
    """

    def __init__(self, config: ParallaxConfig) -> None:
        self.config = config
        driving = 1.0 - config.standing - config.unusual - config.creeping
        self._birth = np.maximum([config.standing, config.unusual, config.creeping, driving], LEAST_WEIGHT)
        self._vehicles: list[int] = []
        self._x = np.zeros((0, 4, 6))
        self._P = np.zeros((0, 4, 6, 6))
        self._weight = np.zeros((0, 4))
        self._prior = np.zeros((0, 2))  # log h and its variance, as the class has it
        self._unseen_s = np.zeros(0)

    def standing(self, vehicle: int) -> float:
        """The probability that a vehicle stands."""
        return float(self._weight[self._vehicles.index(vehicle), STILL].sum())

    def begin(
        self, vehicle: int, centre_m: Floats, T_world_ego: SE2, log_height: float, sigmas: tuple[float, float]
    ) -> None:
        """A vehicle seen for the first time, at about `centre_m` (2,) in ego; its first `update` says how well.

        `sigmas` are those of log h and log w in its class.
        """
        config = self.config
        x = np.zeros((1, 4, 6))
        x[..., :2] = T_world_ego @ centre_m
        x[..., HEIGHT] = log_height
        P = np.zeros((1, 4, 6, 6))
        P[..., :2, :2] = np.eye(2) * (DEPTH_UNKNOWN * float(centre_m[0])) ** 2
        for moving, sigma_mps in zip(MOVING, (config.sigma_creep_mps, config.sigma_drive_mps), strict=True):
            P[:, moving, [VX, VY], [VX, VY]] = sigma_mps**2
        P[..., [HEIGHT, WIDTH], [HEIGHT, WIDTH]] = np.square(sigmas)
        P[:, UNUSUAL, HEIGHT, HEIGHT] = config.sigma_unusual_rel**2
        self._vehicles.append(vehicle)
        self._x, self._P = np.concatenate([self._x, x]), np.concatenate([self._P, P])
        self._weight = np.concatenate([self._weight, self._birth[None]])
        self._prior = np.concatenate([self._prior, [[log_height, sigmas[0] ** 2]]])
        self._unseen_s = np.append(self._unseen_s, max(config.box_memory_s, config.view_memory_s))

    def predict(self, dt_s: float, T_world_ego: SE2, ego_cov: Floats | None) -> None:
        """To the next frame, whose ego pose the odometry gives with `ego_cov` (3, 3) of the last step's tangent."""
        self._unseen_s += dt_s
        if not self._vehicles or dt_s <= 0.0:
            return
        self._mix(dt_s)
        config = self.config
        F = np.eye(6)
        F[X, VX] = F[Y, VY] = dt_s
        self._x[:, MOVING] = self._x[:, MOVING] @ F.T
        Q = np.zeros((6, 6))
        Q[[X, Y], [X, Y]] = dt_s**3 / 3.0
        Q[[X, Y, VX, VY], [VX, VY, X, Y]] = dt_s**2 / 2.0
        Q[[VX, VY], [VX, VY]] = dt_s
        self._P[:, MOVING] = F @ self._P[:, MOVING] @ F.T + Q * config.change_mps**2
        if ego_cov is not None:  # an error of the ego's step moves the vehicle against it
            at = self._x[..., :2] - [T_world_ego.x_m, T_world_ego.y_m]
            J = np.zeros((*at.shape[:2], 2, 3))
            J[..., :2, :2] = T_world_ego.rotation()
            J[..., 0, 2], J[..., 1, 2] = -at[..., 1], at[..., 0]
            self._P[..., :2, :2] += J @ ego_cov @ J.swapaxes(-1, -2)

    def learn_sizes(
        self,
        vehicles: Sequence[int],
        boxes: ParallaxMeasurements,
        T_world_ego: SE2,
        height_m: float,
        sigma_pitch_rad: float,
    ) -> LearnedSize:
        """What motion says of each vehicle's size.

        `height_m` is the camera's, `sigma_pitch_rad` of the road that the slopes count from.
        """
        rows = [self._vehicles.index(vehicle) for vehicle in vehicles]
        if not rows:
            return LearnedSize(*np.zeros((3, 0, 4)))
        config = self.config
        x, P = self._x[rows], self._P[rows]
        outline_var = np.square(boxes.turned_rad) + config.outline_drift_rel**2 * self._unseen_s[rows]
        P[..., WIDTH, WIDTH] += outline_var[:, None]
        innovation, J, depth = _linearised(x, boxes, T_world_ego)
        of_box, of_view = (
            np.maximum(1.0, memory_s / np.maximum(self._unseen_s[rows], 1e-3))
            for memory_s in (config.box_memory_s, config.view_memory_s)
        )
        of_face = np.square(config.sigma_face_m / boxes.depth_m)

        PJt = P @ J.swapaxes(-1, -2)
        S = J @ PJt
        S = S + self._noise(boxes, innovation, S, of_box, of_face * of_view)
        gain = PJt @ np.linalg.inv(S)
        self._x[rows] = x + (gain @ innovation[..., None])[..., 0]
        posterior = P - gain @ PJt.swapaxes(-1, -2)
        self._P[rows] = (posterior + posterior.swapaxes(-1, -2)) / 2.0

        log_likelihood = -0.5 * (_squared(innovation, S) + np.log(np.linalg.det(S)))
        road_var = np.square(boxes.sigma_bottom) * of_box + sigma_pitch_rad**2 * of_view
        log_likelihood -= _bottom_misfit(boxes, P, depth, T_world_ego, height_m, road_var)
        weight = self._weight[rows] * np.exp(log_likelihood - log_likelihood.max(axis=1, keepdims=True))
        self._weight[rows] = np.maximum(weight / weight.sum(axis=1, keepdims=True), LEAST_WEIGHT)
        self._unseen_s[rows] = 0.0
        in_path = np.abs(boxes.bearing) * (boxes.depth_m + boxes.reach_m) < config.path_half_width_m
        return self._learned(rows, of_face + config.sigma_scale_rel**2, in_path)

    def _noise(
        self, boxes: ParallaxMeasurements, innovation: Floats, S: Floats, of_box: Floats, face_var: Floats
    ) -> Floats:
        """(N, 1, 3, 3): measurement noise, raised for outliers; S (N, 4, 3, 3) is of the predicted measurements.

        Errors that last get in each frame so little weight that they count right over their memory: `of_box` (N,) is by
        how much a box's variance grows for that, `face_var` (N,) the variance of the nearest face, grown already.
        """
        noise = np.zeros((len(of_box), 1, 3, 3))
        noise[:, 0, range(3), range(3)] = np.square(boxes.sigma) * of_box[:, None]
        noise[:, 0, [0, 1], [0, 1]] += face_var[:, None]
        misfit = _squared(innovation, S + noise).min(axis=1)
        noise *= np.maximum(1.0, misfit / self.config.gate_sigma**2)[:, None, None, None]
        return noise

    def keep_only(self, vehicles: Iterable[int]) -> None:
        """Forget the others."""
        wanted = set(vehicles)
        rows = [k for k, vehicle in enumerate(self._vehicles) if vehicle in wanted]
        if len(rows) == len(self._vehicles):
            return
        self._vehicles = [self._vehicles[k] for k in rows]
        for name in ("_x", "_P", "_weight", "_prior", "_unseen_s"):
            setattr(self, name, getattr(self, name)[rows])

    def _mix(self, dt_s: float) -> None:
        """The filters' states and weights mixed by how often vehicles change their way to move within `dt_s`."""
        config = self.config
        starts, changes, slows = (
            1.0 - math.exp(-dt_s / time_s) for time_s in (config.stands_for_s, config.creeps_for_s, config.drives_for_s)
        )
        share = np.eye(4)  # (from, to)
        share[STILL, STILL], share[STILL, CREEPING] = 1.0 - starts, starts
        share[CREEPING] = [changes / 2.0, 0.0, 1.0 - changes, changes / 2.0]
        share[DRIVING] = [0.0, 0.0, slows, 1.0 - slows]
        joint = self._weight[:, :, None] * share
        self._weight = joint.sum(axis=1)
        share = joint / self._weight[:, None]
        P = self._P.copy()
        for still in STILL:  # it starts
            P[:, still, [VX, VY], [VX, VY]] = config.sigma_creep_mps**2
        mean = np.einsum("nij,nia->nja", share, self._x)
        gap = self._x[:, :, None] - mean[:, None]  # (N, from, to, 6)
        cov = np.einsum("nij,niab->njab", share, P) + np.einsum("nij,nija,nijb->njab", share, gap, gap)
        speed = slice(VX, VY + 1)
        mean[:, STILL, speed] = 0.0
        cov[:, STILL, speed] = 0.0
        cov[:, STILL, :, speed] = 0.0
        self._x, self._P = mean, cov

    def _learned(self, rows: list[int], lasting: Floats, in_path: NDArray[np.bool_]) -> LearnedSize:
        """Of each filter, its log h less what the class says of it; `lasting` (N,) is a variance that time keeps.

        Vehicles `in_path` (N,) are left out here, not in the filters: once the ego passes beside one, all counts.
        """
        mean, var = self._x[rows][..., HEIGHT], self._P[rows][..., HEIGHT, HEIGHT]
        prior, prior_var = self._prior[rows].T[..., None]
        information = 1.0 / var - 1.0 / prior_var
        informed = information > 1.0 / UNKNOWN
        informed[in_path] = False
        informed[:, MOVING] = False  # drivers brake and turn for seconds: what looks like parallax there is none
        information = np.where(informed, information, 1.0 / UNKNOWN)
        log_height = np.where(informed, (mean / var - prior / prior_var) / information, prior)
        return LearnedSize(self._weight[rows], log_height, 1.0 / information + lasting[:, None])


def _linearised(x: Floats, boxes: ParallaxMeasurements, T_world_ego: SE2) -> tuple[Floats, Floats, Floats]:
    """Innovations (N, 4, 3), their derivatives (N, 4, 3, 6) by the states x (N, 4, 6), and depths (N, 4) in m."""
    R_ego_world = T_world_ego.rotation().T
    at = (x[..., :2] - [T_world_ego.x_m, T_world_ego.y_m]) @ R_ego_world.T
    depth = np.maximum(at[..., 0] - boxes.reach_m[:, None], NEAREST_M)
    ahead = np.maximum(at[..., 0], NEAREST_M)
    J = np.zeros((len(x), 4, 3, 6))
    J[..., 0, HEIGHT] = J[..., 1, WIDTH] = 1.0
    J[..., 0, :2] = J[..., 1, :2] = -R_ego_world[0] / depth[..., None]
    J[..., 2, :2] = (R_ego_world[1] - (at[..., 1] / ahead)[..., None] * R_ego_world[0]) / ahead[..., None]
    seen = np.stack([boxes.log_height, boxes.log_width, boxes.bearing], axis=-1)[:, None]
    log_z = np.log(depth)
    expected = np.stack([x[..., HEIGHT] - log_z, x[..., WIDTH] - log_z, at[..., 1] / ahead], axis=-1)
    return seen - expected, J, depth


def _bottom_misfit(
    boxes: ParallaxMeasurements, P: Floats, depth: Floats, T_world_ego: SE2, height_m: float, road_var: Floats
) -> Floats:
    """(N, 4): the negative log likelihood of each box's bottom by Eq. 1; `road_var` (N,) is of its slope."""
    forward = T_world_ego.rotation().T[0]
    along_var = np.einsum("a,nmab,b->nm", forward, P[..., :2, :2], forward)
    var = road_var[:, None] + along_var * np.square(height_m / depth**2)
    gap = boxes.bottom[:, None] - bev.road_slope(depth, height_m)  # Eq. 1
    out: Floats = 0.5 * (np.square(gap) / var + np.log(var))
    return out


def _squared(gap: Floats, S: Floats) -> Floats:
    """(...): Mahalanobis distances squared of gaps (..., 3) with covariances (..., 3, 3)."""
    out: Floats = np.einsum("...a,...a->...", gap, np.linalg.solve(S, gap[..., None])[..., 0])
    return out
