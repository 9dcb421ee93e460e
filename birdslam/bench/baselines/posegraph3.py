"""The batch pose graph in SE(3) that `batch_se3`, `nair` and `cubeslam` share: all frames of a log at once, by gtsam.

Poses are `ego_pose(SE2, Attitude)`: the log's planar edges with the odometry's height and tilt put back; vehicles stand
level on the road. gtsam's tangent of Pose3 is (roll, pitch, yaw, x, y, z).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import msgspec
import numpy as np

from birdslam.bench.baselines.trajectories import Trajectories
from birdslam.geometry.arrays import Floats
from birdslam.geometry.se2 import SE2
from birdslam.graph.weights import WeightsConfig, weighted
from birdslam.trajectory import ego_pose, inverse, split_pose
from birdslam.types import Attitude, LandmarkEdge, LandmarkKind, Measurements, VehicleEdge


class BatchConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """`metric`: the odometry's scale is believed; else it is one unknown of the graph, whatever the log says."""

    metric: bool = True
    landmarks: bool = False
    # 1-sigma (m, m, rad) by which a vehicle's motion differs from that over the frame before; None: VV edges instead
    steady_motion: tuple[float, float, float] | None = None
    weights: WeightsConfig = WeightsConfig(mode="paper")
    sigma_level_rad: float = 0.02  # of a vehicle's pitch and roll against the ego's road, which SE(2) edges don't state
    sigma_level_m: float = 0.2
    sigma_start: float = 1e-4  # of the first pose (m, rad), which is the world
    iterations: int = 500  # at the most; `Convergence` says whether they were enough


_UNKNOWN_REL = 0.3  # 1-sigma of an unknown position, as a share of its range
_WIDE_SCALE = 1e3  # 1-sigma of an unknown scale, so that a log without any vehicle can be solved
_SCALE_STEP = 1e-4  # for its derivative
_SCALE_TOLERANCE = 1e-7  # of it
_LARGEST_STEP = 0.01  # m or rad: farther no node may want to go from an answer that is one


@dataclass(frozen=True)
class Convergence:
    """How the solver ended. `step` is the farthest (m or rad) that one more Gauss-Newton step would take any node."""

    iterations: int
    at_cap: bool
    step: float

    @property
    def converged(self) -> bool:
        """Whether the answer is the minimum."""
        return not self.at_cap and self.step < _LARGEST_STEP


def optimise_batch(log: Sequence[Measurements], config: BatchConfig) -> Trajectories:
    """The trajectories that minimise the graph, laid on the road. An empty log gives none."""
    found, ended = solve_batch(log, config, check=True)
    return replace(found, converged=ended.converged)


def solve_batch(
    log: Sequence[Measurements], config: BatchConfig, check: bool = False
) -> tuple[Trajectories, Convergence]:
    """The same, and how the solver ended; without `check` the step is not taken, and is NaN."""
    log = [weighted(_placed(m), config.weights) for m in log]
    builder = _Builder(config)
    for m in log:
        builder.add_frame(m, 1.0 if config.metric else _mean_step_m(log))
    if config.landmarks:
        builder.add_landmarks([edge for m in log for edge in m.cp if edge.frame in builder.poses])
    if config.steady_motion is not None:
        builder.add_steady_motion(np.array(config.steady_motion))
    return builder.solve(check)


def _placed(m: Measurements) -> Measurements:
    """Without CV edges whose own covariance says that the vehicle's place is unknown, which the paper's weights can't.

    One such edge (0005, a box cut to a sliver: 235 +- 100 m) turns its vehicle about, and no solver converges.
    """

    def is_known(edge: VehicleEdge) -> bool:
        range_m = math.hypot(edge.T_ego_vehicle.x_m, edge.T_ego_vehicle.y_m)
        return math.sqrt(edge.cov[0] + edge.cov[4]) < _UNKNOWN_REL * range_m

    return msgspec.structs.replace(m, cv=tuple(edge for edge in m.cv if is_known(edge)))


def _mean_step_m(log: Sequence[Measurements]) -> float:
    """What a scale-ambiguous odometry takes for its scale: here the mean step."""
    steps = [np.hypot(m.cc.T_from_to.x_m, m.cc.T_from_to.y_m) for m in log if m.cc is not None]
    return max(float(np.mean(steps)), 1e-3) if steps else 1.0


class _Builder:
    def __init__(self, config: BatchConfig) -> None:
        self.config = config
        self.graph, self.values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self.poses: dict[int, Floats] = {}  # where the optimisation starts
        self._attitudes: dict[int, Attitude] = {}
        self._seen: dict[int, set[int]] = {}  # vehicle -> frames
        self._sights: dict[int, dict[int, SE2]] = {}  # frame -> vehicle -> T_ego_vehicle
        self._last: int | None = None
        self._unscaled: list[tuple[int, int, Floats, gtsam.noiseModel.Base]] = []  # CC edges whose unit is not known

    def add_frame(self, m: Measurements, unit_m: float) -> None:
        key = gtsam.symbol("x", m.frame_id)
        attitude = m.attitude
        if m.cc is not None and m.cc.from_frame in self.poses:
            T = m.cc.T_from_to
            before = ego_pose(SE2(), self._attitudes[m.cc.from_frame])
            step = inverse(before) @ ego_pose(T, attitude)
            step[:3, 3] /= unit_m
            pose = self.poses[m.cc.from_frame] @ step
            noise = _noise6(np.array(m.cc.cov).reshape(3, 3), _diagonal(m.cc.cov))
            start = gtsam.symbol("x", m.cc.from_frame)
            if self.config.metric:
                self.graph.add(gtsam.BetweenFactorPose3(start, key, gtsam.Pose3(step), noise))
            else:
                self._unscaled.append((start, key, step, noise))
        else:
            pose = np.eye(4) if self._last is None else self.poses[self._last]
            sigma = self.config.sigma_start if self._last is None else 1.0
            noise = gtsam.noiseModel.Isotropic.Sigma(6, sigma)
            self.graph.add(gtsam.PriorFactorPose3(key, gtsam.Pose3(pose), noise))
        self.poses[m.frame_id], self._attitudes[m.frame_id], self._last = pose, attitude, m.frame_id
        self.values.insert(key, gtsam.Pose3(pose))
        level = np.array([self.config.sigma_level_rad, self.config.sigma_level_rad, self.config.sigma_level_m]) ** 2
        for cv in m.cv:
            node = _vehicle_key(cv.vehicle, cv.frame)
            edge = ego_pose(cv.T_ego_vehicle, Attitude())
            self.values.insert(node, gtsam.Pose3(pose @ edge))
            noise = _noise6(np.array(cv.cov).reshape(3, 3), level)
            self.graph.add(gtsam.BetweenFactorPose3(key, node, gtsam.Pose3(edge), noise))
            self._seen.setdefault(cv.vehicle, set()).add(cv.frame)
            self._sights.setdefault(cv.frame, {})[cv.vehicle] = cv.T_ego_vehicle
        for vv in m.vv if self.config.steady_motion is None else ():
            if {vv.from_frame, vv.to_frame} <= self._seen.get(vv.vehicle, set()):
                start, end = (_vehicle_key(vv.vehicle, frame) for frame in (vv.from_frame, vv.to_frame))
                edge = ego_pose(vv.T_from_to, Attitude())
                noise = _noise6(np.array(vv.cov).reshape(3, 3), _diagonal(vv.cov))
                self.graph.add(gtsam.BetweenFactorPose3(start, end, gtsam.Pose3(edge), noise))

    def add_landmarks(self, edges: Sequence[LandmarkEdge]) -> None:
        """Road points seen at least twice, each a node (Eq. 3 with the landmark's place unknown)."""
        sightings: dict[tuple[LandmarkKind, int], list[LandmarkEdge]] = {}
        for edge in edges:
            sightings.setdefault((edge.kind, edge.landmark), []).append(edge)
        for landmark, seen in sightings.items():
            if len(seen) < 2:
                continue
            node = landmark_key(*landmark)
            first = self.poses[seen[0].frame]
            self.values.insert(node, first[:3, :3] @ np.array([seen[0].x_m, seen[0].y_m, 0.0]) + first[:3, 3])
            for edge in seen:
                at = np.array([edge.x_m, edge.y_m, 0.0])
                range_m, sigma_m = float(np.linalg.norm(at)), float(np.sqrt(edge.cov[0]))
                noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([sigma_m / range_m, sigma_m / range_m, sigma_m]))
                key = gtsam.symbol("x", edge.frame)
                self.graph.add(gtsam.BearingRangeFactor3D(key, node, gtsam.Unit3(at), range_m, noise))
                if self.config.weights.cp_vehicles is not None:
                    self._add_landmark_of_vehicles(node, edge, self.config.weights.cp_vehicles)

    def _add_landmark_of_vehicles(self, node: int, edge: LandmarkEdge, weight: float) -> None:
        """The CP edges of the vehicles that the frame sees (Eq. 7), by the difference of its two sights.

        gtsam has no such edge that leaves the vehicle's yaw alone, as Eq. 3 does: this one bears on it too.
        """
        for vehicle, T_ego_vehicle in self._sights.get(edge.frame, {}).items():
            at = np.append(T_ego_vehicle.inverse() @ np.array([edge.x_m, edge.y_m]), 0.0)
            range_m, sigma_m = max(float(np.linalg.norm(at)), 1e-3), weight**-0.5
            noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([sigma_m / range_m, sigma_m / range_m, sigma_m]))
            key = _vehicle_key(vehicle, edge.frame)
            self.graph.add(gtsam.BearingRangeFactor3D(key, node, gtsam.Unit3(at), range_m, noise))

    def add_steady_motion(self, sigmas: Floats) -> None:
        """Ties each three poses of a vehicle at frames in a row."""
        level = np.array([self.config.sigma_level_rad, self.config.sigma_level_rad, self.config.sigma_level_m]) ** 2
        noise = _noise6(np.diag(sigmas**2), level)
        for vehicle, frames in self._seen.items():
            for frame in sorted(frames):
                if {frame + 1, frame + 2} <= frames:
                    keys = [_vehicle_key(vehicle, frame + k) for k in range(3)]
                    self.graph.add(gtsam.CustomFactor(noise, keys, _changed_motion))

    def solve(self, check: bool) -> tuple[Trajectories, Convergence]:
        """The minimum over all poses, and over the scale where that is unknown."""
        out = Trajectories()
        if not self.poses:
            return out, Convergence(0, False, 0.0)
        graph, solution, used = self._scaled(1.0), self.values, 0
        scale, before = 1.0, None  # the one that is tried, and the one tried before with the slope of the cost there
        while used < self.config.iterations:
            optimizer = self._optimizer(graph, solution, self.config.iterations - used)
            solution = optimizer.optimize()
            used += optimizer.iterations()
            if not self._unscaled:
                break
            slope = self._slope(scale, solution)
            change = 0.1 * scale if before is None else -slope * (scale - before[0]) / (slope - before[1])  # secant
            if abs(change) < _SCALE_TOLERANCE * abs(scale):
                break
            scale, before = scale + change, (scale, slope)
            graph = self._scaled(scale)
        step = math.nan
        if check:
            step = float(np.abs(graph.linearize(solution).optimize().vector()).max())
        convergence = Convergence(used, used >= self.config.iterations, step)
        for frame in self.poses:
            out.ego[frame] = split_pose(solution.atPose3(gtsam.symbol("x", frame)).matrix())[0]
        for vehicle, frames in self._seen.items():
            for frame in sorted(frames):
                pose = solution.atPose3(_vehicle_key(vehicle, frame)).matrix()
                out.put_vehicle(vehicle, frame, split_pose(pose)[0])
        return out, convergence

    def _optimizer(self, graph: gtsam.NonlinearFactorGraph, start: gtsam.Values, most: int) -> gtsam.DoglegOptimizer:
        # Not Levenberg-Marquardt: what is far off moves every node after it, which its damping forbids to each
        params = gtsam.DoglegParams()
        params.setMaxIterations(most)
        # A tolerance of 1e-8 ends 2 cm (0020) and 6 cm (0004) short of the minimum; this one, 0.9 and 0.5 cm
        params.setRelativeErrorTol(1e-10)
        return gtsam.DoglegOptimizer(graph, start, params)

    def _scaled(self, scale: float) -> gtsam.NonlinearFactorGraph:
        """The graph with CC edges of this scale."""
        graph = gtsam.NonlinearFactorGraph(self.graph)
        graph.push_back(self._motions(scale))
        return graph

    def _motions(self, scale: float) -> gtsam.NonlinearFactorGraph:
        graph = gtsam.NonlinearFactorGraph()
        for start, end, step, noise in self._unscaled:
            T = step.copy()
            T[:3, 3] *= scale
            graph.add(gtsam.BetweenFactorPose3(start, end, gtsam.Pose3(T), noise))
        return graph

    def _slope(self, scale: float, solution: gtsam.Values) -> float:
        """The derivative by the scale of the least cost: where the poses are best, that of the CC edges alone."""
        ahead, behind = (self._motions(scale + side * _SCALE_STEP).error(solution) for side in (1.0, -1.0))
        return float((ahead - behind) / (2.0 * _SCALE_STEP) + (scale - 1.0) / _WIDE_SCALE**2)


def landmark_key(kind: LandmarkKind, landmark: int) -> int:
    """Returns the key of the position of a landmark; each kind has its own ids."""
    return int(gtsam.symbol("l" if kind is LandmarkKind.ROAD_POINT else "m", landmark))


def _vehicle_key(vehicle: int, frame: int) -> int:
    return int(gtsam.symbol("v", vehicle * 1_000_000 + frame))


def _diagonal(cov: tuple[float, ...]) -> Floats:
    """Variances of (roll, pitch, z) as good as those that the planar edge states: the paper weighs all axes alike."""
    return np.array([cov[8], cov[8], cov[0]])


def _noise6(cov: Floats, level: Floats) -> gtsam.noiseModel.Base:
    """A planar covariance (x, y, yaw) and variances of (roll, pitch, z), in gtsam's order."""
    full = np.zeros((6, 6))
    full[np.ix_([3, 4, 2], [3, 4, 2])] = cov
    full[[0, 1, 5], [0, 1, 5]] = level
    return gtsam.noiseModel.Gaussian.Covariance(full)


def _changed_motion(factor: gtsam.CustomFactor, values: gtsam.Values, H: list[Floats] | None) -> Floats:
    """Error of three poses in a row: the second motion as seen from the first."""
    a, b, c = (values.atPose3(key) for key in list(factor.keys()))
    H_a, H_b, K_b, K_c, M_ab, M_bc = (np.zeros((6, 6), order="F") for _ in range(6))
    first, second = a.between(b, H_a, H_b), b.between(c, K_b, K_c)
    change = first.between(second, M_ab, M_bc)
    if H is not None:  # the change is small: its logarithm is nearly flat
        H[0], H[1], H[2] = M_ab @ H_a, M_ab @ H_b + M_bc @ K_b, M_bc @ K_c
    return np.asarray(gtsam.Pose3.Logmap(change))
