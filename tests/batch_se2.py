"""The reference of the paper's incremental SE(2) graph: Eq. 8 over all frames of a log at once, by gtsam.

It has the same CC, CV and VV edges with the same covariances as the incremental graph, the same constant-velocity
factor where that has one, and CP edges of the ego with a node for each landmark. It has no gate: an outlier counts like
any other edge. Nothing is marginalised and every edge is linearised at the optimum, future frames included.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import gtsam
import numpy as np

from birdslam.bench.baselines.posegraph3 import landmark_key
from birdslam.bench.baselines.trajectories import Trajectories, dead_reckoned
from birdslam.geometry.arrays import Floats
from birdslam.geometry.planar import between, compose, log
from birdslam.geometry.se2 import SE2
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.weights import WeightsConfig, weighted
from birdslam.types import LandmarkEdge, LandmarkKind, Measurements, VehicleEdge

_SIGMA_START = 1e-7  # of the first pose (m, rad), which is the world
_SIGMA_RESTART = 1.0  # of a pose that no edge ties to an earlier one
_SIGMA_FREE_RAD = 1e3  # a landmark has no yaw
_ITERATIONS = 50
_TOLERANCE = 1e-12
_STEP = 1e-5  # for derivatives


@dataclass(frozen=True)
class Solution:
    """gtsam's answer. `vehicles[vehicle]` are the frames in which it has a pose, oldest first."""

    factors: gtsam.NonlinearFactorGraph
    values: gtsam.Values
    frames: list[int]
    vehicles: dict[int, list[int]] = field(default_factory=dict)

    def ego(self, frame: int) -> SE2:
        """T_world_ego."""
        return self._pose(ego_key(frame))

    def vehicle(self, vehicle: int, frame: int) -> SE2:
        """T_world_vehicle."""
        return self._pose(vehicle_key(vehicle, frame))

    def _pose(self, key: int) -> SE2:
        pose = self.values.atPose2(key)
        return SE2(pose.x(), pose.y(), pose.theta())


def solve(measurements: Sequence[Measurements], graph: GraphConfig, weights: WeightsConfig) -> Solution:
    """The minimum of Eq. 8 over all edges, from dead reckoning. An empty log gives an empty solution."""
    used = [weighted(m, weights) for m in measurements]
    builder = _Builder(graph, dead_reckoned(used))
    for m in used:
        builder.add(m)
    builder.add_landmarks([edge for m in used for edge in m.cp if edge.frame == m.frame_id])
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(_TOLERANCE)
    params.setAbsoluteErrorTol(_TOLERANCE)
    params.setMaxIterations(_ITERATIONS)
    values = builder.values
    if builder.frames:
        values = gtsam.LevenbergMarquardtOptimizer(builder.factors, values, params).optimize()
    return Solution(builder.factors, values, builder.frames, builder.vehicles)


def ego_key(frame: int) -> int:
    """Of the ego's pose in a frame."""
    return int(gtsam.symbol("x", frame))


def vehicle_key(vehicle: int, frame: int) -> int:
    """Of a vehicle's pose in a frame."""
    return int(gtsam.symbol("v", vehicle * 10_000_000 + frame))


class _Builder:
    def __init__(self, graph: GraphConfig, start: Trajectories) -> None:
        self.graph = graph
        self.factors, self.values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self.frames: list[int] = []
        self.vehicles: dict[int, list[int]] = {}
        self._start = start
        self._t_ns: dict[int, int] = {}
        self._first_yaw: dict[int, float] = {}  # variance of a vehicle's yaw when it was first seen

    def add(self, m: Measurements) -> None:
        key, pose = ego_key(m.frame_id), _pose(self._start.ego[m.frame_id])
        self.values.insert(key, pose)
        if m.cc is not None and m.cc.from_frame in self._t_ns:
            self.factors.add(_between(ego_key(m.cc.from_frame), key, m.cc.T_from_to, m.cc.cov))
        else:
            sigma = _SIGMA_RESTART if self.frames else _SIGMA_START
            self.factors.add(gtsam.PriorFactorPose2(key, pose, gtsam.noiseModel.Isotropic.Sigma(3, sigma)))
        self.frames.append(m.frame_id)
        self._t_ns[m.frame_id] = m.t_source_ns
        for edge in m.cv:
            self._add_sight(key, edge)
        for link in m.vv:
            seen = self.vehicles.get(link.vehicle, [])
            if link.from_frame in seen and link.to_frame in seen:
                start, end = vehicle_key(link.vehicle, link.from_frame), vehicle_key(link.vehicle, link.to_frame)
                self.factors.add(_between(start, end, link.T_from_to, link.cov))

    def _add_sight(self, ego: int, edge: VehicleEdge) -> None:
        node = vehicle_key(edge.vehicle, edge.frame)
        self.factors.add(_between(ego, node, edge.T_ego_vehicle, edge.cov))
        self.values.insert(node, _pose(self._start.vehicles[edge.vehicle][edge.frame]))
        frames = self.vehicles.setdefault(edge.vehicle, [])
        frames.append(edge.frame)
        recent = frames[-3:]
        if self.graph.constant_velocity and len(recent) > 1:
            t_s = np.array([self._t_ns[frame] for frame in recent]) * 1e-9
            keys = [vehicle_key(edge.vehicle, frame) for frame in recent]
            self.factors.add(_steady(keys, np.diff(t_s), self._first_yaw[edge.vehicle], self.graph))
        else:
            self._first_yaw.setdefault(edge.vehicle, edge.cov[8])

    def add_landmarks(self, edges: Sequence[LandmarkEdge]) -> None:
        """Eq. 3 with the landmark's place unknown; one that is seen once says nothing."""
        seen: dict[tuple[LandmarkKind, int], list[LandmarkEdge]] = {}
        for edge in edges:
            seen.setdefault((edge.kind, edge.landmark), []).append(edge)
        for landmark, sights in seen.items():
            if len(sights) < 2:
                continue
            node, first = landmark_key(*landmark), sights[0]
            self.values.insert(node, _pose(self._start.ego[first.frame] @ SE2(first.x_m, first.y_m)))
            for edge in sights:
                cov = np.diag([0.0, 0.0, _SIGMA_FREE_RAD**2])
                cov[:2, :2] = np.reshape(edge.cov, (2, 2))
                T = SE2(edge.x_m, edge.y_m)
                self.factors.add(_between(ego_key(edge.frame), node, T, tuple(cov.ravel().tolist())))


def _pose(T: SE2) -> gtsam.Pose2:
    return gtsam.Pose2(T.x_m, T.y_m, T.yaw_rad)


def _between(start: int, end: int, T: SE2, cov: tuple[float, ...]) -> gtsam.BetweenFactorPose2:
    noise = gtsam.noiseModel.Gaussian.Covariance(np.reshape(cov, (3, 3)))
    return gtsam.BetweenFactorPose2(start, end, _pose(T), noise)


def _steady(keys: list[int], dt_s: Floats, yaw_variance: float, config: GraphConfig) -> gtsam.CustomFactor:
    """The twist of the last interval is that of the one before, or in the first interval 0, give or take."""
    change = np.array([config.change_forward_mps, config.change_sideways_mps, config.change_turn_radps])
    variance = np.square(change) * dt_s[-1]
    if len(keys) == 2:
        birth = np.square([config.birth_forward_mps, config.birth_sideways_mps, config.birth_turn_radps])
        variance += birth + yaw_variance * np.array([birth[1], birth[0], 0.0])

    def change_of(poses: list[Floats]) -> Floats:
        motions = [log(between(a, b)[None])[0] / dt for (a, b), dt in zip(pairwise(poses), dt_s, strict=True)]
        return motions[-1] - (motions[0] if len(motions) == 2 else 0.0)

    def error(this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Floats] | None) -> Floats:
        found = [values.atPose2(key) for key in keys]
        poses = [np.array([p.x(), p.y(), p.theta()]) for p in found]
        if jacobians is not None:
            for k in range(len(poses)):
                jacobians[k] = np.empty((3, 3), order="F")
                for axis, step in enumerate(np.eye(3) * _STEP):
                    ahead, behind = ([*poses[:k], compose(poses[k], s * step), *poses[k + 1 :]] for s in (1.0, -1.0))
                    jacobians[k][:, axis] = (change_of(ahead) - change_of(behind)) / (2.0 * _STEP)
        return change_of(poses)

    return gtsam.CustomFactor(gtsam.noiseModel.Diagonal.Variances(variance), keys, error)
