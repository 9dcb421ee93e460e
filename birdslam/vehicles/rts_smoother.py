"""Vehicles' trajectories after a drive: smoothed, with their sizes as known after it, and with their later motion.

Once a height is known better, every measurement moves along its line of sight by what it owes to the one assumed then:

    log z = log z_then + (d log z / d log h) (log h - log h_then)

then all go through an RTS smoother (Rauch, Tung and Striebel 1965) of constant velocity with stops. The ego's
trajectory is the live one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.se2 import SE2
from birdslam.types import Estimate, Measurements, VehicleEdge
from birdslam.vehicles.placement.localisation import Dimensions, corners_of

Floats = NDArray[np.float64]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]

STANDING_PROBABILITY = 0.5  # the probability from which on a vehicle is taken to stand
MIN_COV_SHARE = 0.1  # of a measurement's variance along the line of sight: not all of it is the size's
MIN_DEPTH_M = 1.0
MIN_SIGMA_LOG_HEIGHT = 1e-3
NOT_JUDGED = 0.5  # probability of being stationary where it is unknown, or where no graph estimates it
MIN_PROBABILITY = 1e-3  # and 1 less it is the largest


class SmootherConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How vehicles move and stop, and how long the error of a detector lasts."""

    change_mps: Positive = 2.0  # 1-sigma by which a velocity changes within a second
    birth_mps: Positive = 12.0  # 1-sigma of the velocity of a vehicle seen for the first time
    standing_mps: Positive = 0.05  # 1-sigma of that of one that stands
    stands_for_s: Positive = 60.0  # on average
    moves_for_s: Positive = 15.0
    box_memory_s: Positive = 0.3  # for so long a box has the same error
    gate_sigma: Positive = 4.0  # past it a measurement is an outlier: its noise is raised


@dataclass(frozen=True)
class VehicleMeasurement:
    """A vehicle in one frame: its CV edge, the ego's pose then, and the vehicle's as the live graph had it.

    `standing` is how probably it stands, by all that was known then.
    """

    frame_id: int
    t_s: float
    edge: VehicleEdge
    T_world_ego: SE2
    T_world_vehicle: SE2
    standing: float


class RtsSmoother:
    """add() each frame with its live estimate; smooth() at any time.

    State, of each vehicle: x, y (m) and vx, vy (m/s) of its centre in the world of its epoch. Measurements: the places
    (m) of its CV edges, corrected for the size that all of them tell. Read by evaluation (final trajectories).
    """

    def __init__(self, config: SmootherConfig) -> None:
        self.config = config
        self._measurements: dict[tuple[int, int], list[VehicleMeasurement]] = {}  # by epoch and vehicle

    def add(self, measurements: Measurements, estimate: Estimate) -> None:
        """One frame's edges, and where they left everybody."""
        estimated = {v.vehicle: v for v in estimate.vehicles}
        t_s = estimate.t_source_ns * 1e-9
        for edge in measurements.cv:
            if (vehicle := estimated.get(edge.vehicle)) is not None:
                standing = edge.standing if vehicle.standing == NOT_JUDGED else vehicle.standing
                T_world_vehicle = vehicle.T_world_vehicle
                one = VehicleMeasurement(estimate.frame_id, t_s, edge, estimate.T_world_ego, T_world_vehicle, standing)
                self._measurements.setdefault((estimate.epoch, edge.vehicle), []).append(one)

    def smooth(self) -> dict[tuple[int, int], dict[int, SE2]]:
        """(epoch, vehicle) -> frame -> T_world_vehicle in that epoch's world, in the frames in which it was seen."""
        return {key: smooth_vehicle(seen, self.config) for key, seen in self._measurements.items()}

    def close(self, epoch: int, vehicle: int) -> dict[int, SE2]:
        """One vehicle's part of `smooth`; its measurements are let go, since no more of them will come."""
        return smooth_vehicle(self._measurements.pop((epoch, vehicle)), self.config)


def smooth_vehicle(seen: Sequence[VehicleMeasurement], config: SmootherConfig) -> dict[int, SE2]:
    """frame -> T_world_vehicle of one vehicle; its yaw is the live one."""
    t_s = np.array([one.t_s for one in seen])
    places, covs = _size_corrected(seen)
    stood = _smooth_standing(np.array([one.standing for one in seen]), np.diff(t_s), config)
    gaps_s = np.maximum(np.diff(t_s, prepend=t_s[0] - config.box_memory_s), 1e-3)
    covs = covs * np.maximum(1.0, config.box_memory_s / gaps_s)[:, None, None]
    found, log_likelihood = _smooth(t_s, places, covs, np.zeros(len(t_s), np.bool_), config)
    still = stood > STANDING_PROBABILITY
    if still.any():
        with_stops, with_stops_log_likelihood = _smooth(t_s, places, covs, still, config)
        if with_stops_log_likelihood + _logit(float(stood[still].mean())) > log_likelihood:
            found = with_stops
    return {
        one.frame_id: SE2(x_m, y_m, one.T_world_vehicle.yaw_rad)
        for one, (x_m, y_m) in zip(seen, found.tolist(), strict=True)
    }


def _size_corrected(seen: Sequence[VehicleMeasurement]) -> tuple[Floats, Floats]:
    """Centres (N, 2) in world, had each been placed with the one height, and (N, 2, 2) without the height's error."""
    places, covs = np.zeros((len(seen), 2)), np.zeros((len(seen), 2, 2))
    log_height = _log_height(seen)
    for k, one in enumerate(seen):
        edge, T = one.edge, one.edge.T_ego_vehicle
        centre = np.array([T.x_m, T.y_m])
        reach_m = max(x for x, _ in corners_of(Dimensions(edge.length_m, edge.width_m, 1.0), T.yaw_rad))
        depth_m = max(T.x_m - reach_m, MIN_DEPTH_M)
        sight_line = centre / max(T.x_m, MIN_DEPTH_M) * depth_m  # how the centre moves with log z
        growth = math.exp(edge.depth_per_height * (log_height - edge.log_height)) - 1.0
        R = SE2(yaw_rad=T.yaw_rad).rotation()
        cov = R @ np.reshape(edge.cov, (3, 3))[:2, :2] @ R.T  # an edge has it in the vehicle's axes
        of_height = (edge.depth_per_height * edge.sigma_log_height) ** 2
        # Whatever else is uncertain stays so: of a cut vehicle most of it lies along another line
        most = (1.0 - MIN_COV_SHARE) / max(float(sight_line @ np.linalg.solve(cov, sight_line)), 1e-9)
        cov = cov - min(of_height, most) * np.outer(sight_line, sight_line)
        R_world_ego = one.T_world_ego.rotation()
        places[k] = one.T_world_ego @ (centre + growth * sight_line)
        covs[k] = R_world_ego @ cov @ R_world_ego.T
    return places, covs


def _log_height(seen: Sequence[VehicleMeasurement]) -> float:
    """The logarithm of a vehicle's height by all frames.

    The last frame's is not always the best: what parallax says of it is not kept, and a vehicle that leaves is cut or
    far. So each frame counts by its information beyond the first one's, which has the class's prior; of the frames
    that know most of it the prior gets as much beside it as there.
    """
    log_height = np.array([one.edge.log_height for one in seen])
    information = np.array([max(one.edge.sigma_log_height, MIN_SIGMA_LOG_HEIGHT) for one in seen]) ** -2.0
    gained = np.maximum(information - information[0], 0.0)
    most = float(gained.max())
    if most <= 0.0:
        return float(log_height[-1])
    reported = information * log_height - information[0] * log_height[0]  # gained times the height that it is of
    of_frames = float(gained @ reported / (gained @ gained))
    return float((information[0] * log_height[0] + most * of_frames) / (information[0] + most))


def _smooth_standing(standing: Floats, gaps_s: Floats, config: SmootherConfig) -> Floats:
    """(N,) the probability that it stood, all measurements given, from what was known of it then (N,)."""
    out = standing.copy()
    for k in range(len(out) - 2, -1, -1):
        starts, stops = (1.0 - math.exp(-gaps_s[k] / t_s) for t_s in (config.stands_for_s, config.moves_for_s))
        joint = np.array([[1.0 - starts, starts], [stops, 1.0 - stops]]) * [[standing[k]], [1.0 - standing[k]]]
        given_next = joint[0] / np.maximum(joint.sum(axis=0), 1e-12)
        out[k] = given_next @ [out[k + 1], 1.0 - out[k + 1]]
    return out


def _smooth(
    t_s: Floats, places: Floats, covs: Floats, still: NDArray[np.bool_], config: SmootherConfig
) -> tuple[Floats, float]:
    """Places (N, 2) by all the others, and the logarithm of how likely they are, each by those before it."""
    n = len(t_s)
    x, P = np.zeros((n, 4)), np.zeros((n, 4, 4))
    x_before, P_before, F = np.zeros((n, 4)), np.zeros((n, 4, 4)), np.tile(np.eye(4), (n, 1, 1))
    gate, log_likelihood = config.gate_sigma**2, 0.0
    for k in range(n):
        if k == 0:
            x[0, :2], P[0, :2, :2] = places[0], covs[0]
            P[0, 2:, 2:] = np.eye(2) * config.birth_mps**2
        else:
            dt_s = t_s[k] - t_s[k - 1]
            F[k, 0, 2] = F[k, 1, 3] = dt_s
            Q = np.kron([[dt_s**3 / 3.0, dt_s**2 / 2.0], [dt_s**2 / 2.0, dt_s]], np.eye(2)) * config.change_mps**2
            x_before[k], P_before[k] = F[k] @ x[k - 1], F[k] @ P[k - 1] @ F[k].T + Q
            gap, S = places[k] - x_before[k, :2], P_before[k, :2, :2] + covs[k]
            distance = float(gap @ np.linalg.solve(S, gap))
            log_likelihood -= 0.5 * (min(distance, 2.0 * gate) + math.log(float(np.linalg.det(S))))
            S = S + covs[k] * (max(1.0, distance / gate) ** 2 - 1.0)
            gain = P_before[k, :, :2] @ np.linalg.inv(S)
            x[k], P[k] = x_before[k] + gain @ gap, P_before[k] - gain @ P_before[k, :2]
        if still[k]:
            gain = P[k, :, 2:] @ np.linalg.inv(P[k, 2:, 2:] + np.eye(2) * config.standing_mps**2)
            x[k], P[k] = x[k] - gain @ x[k, 2:], P[k] - gain @ P[k, 2:]
    for k in range(n - 2, -1, -1):
        x[k] += P[k] @ F[k + 1].T @ np.linalg.solve(P_before[k + 1], x[k + 1] - x_before[k + 1])
    return x[:, :2], log_likelihood


def _logit(probability: float) -> float:
    p = min(max(probability, MIN_PROBABILITY), 1.0 - MIN_PROBABILITY)
    return math.log(p / (1.0 - p))
