"""Smoothed trajectories of vehicles after a drive, with their final sizes. The ego trajectory is the live one.

A better height moves each measurement along its line of sight:

    log z = log z_then + (d log z / d log h) (log h - log h_then)

Then an RTS smoother (Rauch, Tung and Striebel 1965) of constant velocity with stops runs over the measurements.
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
from birdslam.road_users.placement.localisation import Dimensions, corners_of
from birdslam.types import Estimate, Measurements, VehicleEdge

Floats = NDArray[np.float64]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]

MIN_STATIONARY_PROBABILITY = 0.5  # from which a vehicle is treated as stationary
MIN_COV_RATIO = 0.1  # remaining fraction of a measurement's variance along the line of sight
MIN_DEPTH_M = 1.0
MIN_SIGMA_LOG_HEIGHT = 1e-3
UNKNOWN_PROBABILITY = 0.5  # of being stationary, without a graph
MIN_PROBABILITY = 1e-3  # and 1 minus the maximum


class SmootherConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Parameters of the motion model and of the measurement errors."""

    change_mps: Positive = 2.0  # 1-sigma of the change of velocity within a second
    birth_mps: Positive = 12.0  # 1-sigma of the velocity at the first observation
    standing_mps: Positive = 0.05  # 1-sigma of the velocity of a stationary vehicle
    stands_for_s: Positive = 60.0  # mean duration of a stop
    moves_for_s: Positive = 15.0
    box_memory_s: Positive = 0.3  # correlation time of the errors of boxes
    gate_sigma: Positive = 4.0  # gate above which the noise of a measurement is raised


@dataclass(frozen=True)
class VehicleMeasurement:
    """A vehicle in one frame: its CV edge, the ego pose, and the live pose of the vehicle.

    `standing` is the probability that it was stationary, by the data up to then.
    """

    frame_id: int
    t_s: float
    edge: VehicleEdge
    T_world_ego: SE2
    T_world_vehicle: SE2
    standing: float


class RtsSmoother:
    """Calls: add() per frame with its live estimate; smooth() at any time.

    State of each vehicle: x, y (m) and vx, vy (m/s) of its centre in the world of its epoch. Measurements: the places
    (m) of its CV edges, corrected for its final size. Reader: evaluation (final trajectories).
    """

    def __init__(self, config: SmootherConfig) -> None:
        self.config = config
        self._measurements: dict[tuple[int, int], list[VehicleMeasurement]] = {}  # by epoch and vehicle

    def add(self, measurements: Measurements, estimate: Estimate) -> None:
        """Adds one frame's edges and the estimated poses."""
        estimated = {v.vehicle: v for v in estimate.vehicles}
        t_s = estimate.t_source_ns * 1e-9
        for edge in measurements.cv:
            if (vehicle := estimated.get(edge.vehicle)) is not None:
                standing = edge.standing if vehicle.standing == UNKNOWN_PROBABILITY else vehicle.standing
                T_world_vehicle = vehicle.T_world_vehicle
                one = VehicleMeasurement(estimate.frame_id, t_s, edge, estimate.T_world_ego, T_world_vehicle, standing)
                self._measurements.setdefault((estimate.epoch, edge.vehicle), []).append(one)

    def smooth(self) -> dict[tuple[int, int], dict[int, SE2]]:
        """(epoch, vehicle) -> frame -> T_world_vehicle in the world of the epoch, at frames with observations."""
        return {key: smooth_vehicle(seen, self.config) for key, seen in self._measurements.items()}

    def close(self, epoch: int, vehicle: int) -> dict[int, SE2]:
        """`smooth` for one vehicle; drops its measurements."""
        return smooth_vehicle(self._measurements.pop((epoch, vehicle)), self.config)


def smooth_vehicle(seen: Sequence[VehicleMeasurement], config: SmootherConfig) -> dict[int, SE2]:
    """frame -> T_world_vehicle of one vehicle; the yaw is the live one."""
    t_s = np.array([one.t_s for one in seen])
    places, covs = _size_corrected(seen)
    stationary = _smooth_standing(np.array([one.standing for one in seen]), np.diff(t_s), config)
    gaps_s = np.maximum(np.diff(t_s, prepend=t_s[0] - config.box_memory_s), 1e-3)
    covs = covs * np.maximum(1.0, config.box_memory_s / gaps_s)[:, None, None]
    found, log_likelihood = _smooth(t_s, places, covs, np.zeros(len(t_s), np.bool_), config)
    is_stationary = stationary > MIN_STATIONARY_PROBABILITY
    if is_stationary.any():
        with_stops, with_stops_log_likelihood = _smooth(t_s, places, covs, is_stationary, config)
        if with_stops_log_likelihood + _logit(float(stationary[is_stationary].mean())) > log_likelihood:
            found = with_stops
    return {
        one.frame_id: SE2(x_m, y_m, one.T_world_vehicle.yaw_rad)
        for one, (x_m, y_m) in zip(seen, found.tolist(), strict=True)
    }


def _size_corrected(seen: Sequence[VehicleMeasurement]) -> tuple[Floats, Floats]:
    """Centres (N, 2) in world for one common height, and covariances (N, 2, 2) without the error of the height."""
    places, covs = np.zeros((len(seen), 2)), np.zeros((len(seen), 2, 2))
    log_height = _log_height(seen)
    for k, one in enumerate(seen):
        edge, T = one.edge, one.edge.T_ego_vehicle
        centre = np.array([T.x_m, T.y_m])
        reach_m = max(x for x, _ in corners_of(Dimensions(edge.length_m, edge.width_m, 1.0), T.yaw_rad))
        depth_m = max(T.x_m - reach_m, MIN_DEPTH_M)
        sight_line = centre / max(T.x_m, MIN_DEPTH_M) * depth_m  # derivative of the centre by log z
        growth = math.exp(edge.depth_per_height * (log_height - edge.log_height)) - 1.0
        R = SE2(yaw_rad=T.yaw_rad).rotation()
        cov = R @ np.reshape(edge.cov, (3, 3))[:2, :2] @ R.T  # the covariance of an edge is in the vehicle's axes
        of_height = (edge.depth_per_height * edge.sigma_log_height) ** 2
        # Keep other errors: those of a cut vehicle are mostly along another line
        max_information = (1.0 - MIN_COV_RATIO) / max(float(sight_line @ np.linalg.solve(cov, sight_line)), 1e-9)
        cov = cov - min(of_height, max_information) * np.outer(sight_line, sight_line)
        R_world_ego = one.T_world_ego.rotation()
        places[k] = one.T_world_ego @ (centre + growth * sight_line)
        covs[k] = R_world_ego @ cov @ R_world_ego.T
    return places, covs


def _log_height(seen: Sequence[VehicleMeasurement]) -> float:
    """Log height of a vehicle from all frames.

    Each frame is weighted by its information beyond the first frame, which has the prior of the class. The last frame
    is not always the best: the height by growth is not kept, and a leaving vehicle is cut or far.
    """
    log_height = np.array([one.edge.log_height for one in seen])
    information = np.array([max(one.edge.sigma_log_height, MIN_SIGMA_LOG_HEIGHT) for one in seen]) ** -2.0
    gained = np.maximum(information - information[0], 0.0)
    max_information = float(gained.max())
    if max_information <= 0.0:
        return float(log_height[-1])
    reported = information * log_height - information[0] * log_height[0]  # gained information times its height
    of_frames = float(gained @ reported / (gained @ gained))
    return float((information[0] * log_height[0] + max_information * of_frames) / (information[0] + max_information))


def _smooth_standing(standing: Floats, gaps_s: Floats, config: SmootherConfig) -> Floats:
    """(N,) smoothed probability of being stationary, from the filtered one (N,)."""
    out = standing.copy()
    for k in range(len(out) - 2, -1, -1):
        starts, stops = (1.0 - math.exp(-gaps_s[k] / t_s) for t_s in (config.stands_for_s, config.moves_for_s))
        joint = np.array([[1.0 - starts, starts], [stops, 1.0 - stops]]) * [[standing[k]], [1.0 - standing[k]]]
        given_next = joint[0] / np.maximum(joint.sum(axis=0), 1e-12)
        out[k] = given_next @ [out[k + 1], 1.0 - out[k + 1]]
    return out


def _smooth(
    t_s: Floats, places: Floats, covs: Floats, is_stationary: NDArray[np.bool_], config: SmootherConfig
) -> tuple[Floats, float]:
    """Smoothed places (N, 2), and the log likelihood of the innovations."""
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
        if is_stationary[k]:
            gain = P[k, :, 2:] @ np.linalg.inv(P[k, 2:, 2:] + np.eye(2) * config.standing_mps**2)
            x[k], P[k] = x[k] - gain @ x[k, 2:], P[k] - gain @ P[k, 2:]
    for k in range(n - 2, -1, -1):
        x[k] += P[k] @ F[k + 1].T @ np.linalg.solve(P_before[k + 1], x[k + 1] - x_before[k + 1])
    return x[:, :2], log_likelihood


def _logit(probability: float) -> float:
    p = min(max(probability, MIN_PROBABILITY), 1.0 - MIN_PROBABILITY)
    return math.log(p / (1.0 - p))
