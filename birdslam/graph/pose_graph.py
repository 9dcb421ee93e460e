"""The back end: the incremental SE(2) pose graph of the paper (Eqs. 2-8), optimized once per frame.

`PoseGraph.optimise` weights the edges (Eq. 4), propagates the window, linearizes the factors, minimizes their sum
(Eq. 8), adds and removes vehicles and landmarks, and returns the marginals. Each factor is a module of factors/.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.se2 import SE2
from birdslam.graph.around.hidden_road import hidden_fans
from birdslam.graph.around.lane_users import lane_users
from birdslam.graph.around.people import people_estimates
from birdslam.graph.camera_scale import with_camera_scale
from birdslam.graph.checkpoint import Checkpoint, CheckpointError, Epoch, pack, packed, plain, unpack, unpacked
from birdslam.graph.edges import PoseEdges, pose_edges
from birdslam.graph.factors.constant_velocity import twist_growth
from birdslam.graph.factors.factor import Factor, GraphFrame, Linearised
from birdslam.graph.factors.standard import standard_factors
from birdslam.graph.factors.vehicle_detection import VehicleDetections
from birdslam.graph.graph_config import GraphConfig, check_together
from birdslam.graph.marginals import vehicle_estimates
from birdslam.graph.minimum import minimise, solver
from birdslam.graph.pending_map import PendingMap
from birdslam.graph.vehicles import MIN_INTERVAL_S, VehicleNodes, cv_edges
from birdslam.graph.weights import WeightsConfig, weighted
from birdslam.graph.window import Window
from birdslam.lanes.occupancy import with_users
from birdslam.lanes.traffic import Traffic, initial_state
from birdslam.types import (
    INVALIDATING,
    Estimate,
    FollowedPerson,
    Lanes,
    MapUpdate,
    Measurements,
    SpeedSource,
    Status,
    VehicleEstimate,
)

_NO_MOTION = SE2()
DEFAULT_CAMERA_HEIGHT_M = 1.5  # if a record does not state it
_NO_PIXELS = frozenset({Status.END_OF_SOURCE, Status.FRAME_UNREADABLE, Status.COASTING})


class PoseGraph:
    """Deterministic, and bounded in time and memory; no content of a record raises an exception."""

    def __init__(
        self, config: GraphConfig, weights: WeightsConfig, epoch: int = 0, factors: Sequence[Factor] | None = None
    ) -> None:
        """`factors` default to `standard_factors(config, weights)`; this graph owns them.

        Raises ValueError as `check_together`, and for two factors of one name.
        """
        self.config = config
        self.weights = weights
        self.epoch = epoch
        self.factors = tuple(standard_factors(config, weights) if factors is None else factors)
        self.outliers: dict[str, Sequence[int]] = {}  # of the newest frame: factor name -> indices of its edges
        self._predicting = [f for f in self.factors if type(f).predict is not Factor.predict]
        self._linearising = [f for f in self.factors if type(f).linearise is not Factor.linearise]
        self._concluding = [f for f in self.factors if type(f).conclude is not Factor.conclude]
        check_together(config, weights)
        if len({factor.name for factor in self.factors}) < len(self.factors):
            raise ValueError(f"two factors of one name: {', '.join(factor.name for factor in self.factors)}")
        self._map = PendingMap(config.max_pending_landmarks, config.max_pending_frames)
        self._twist_growth = twist_growth(config)
        self._birth = np.diag(np.square([config.birth_forward_mps, config.birth_sideways_mps, config.birth_turn_radps]))
        # The decision stationary or moving needs a measured velocity covariance, which Eq. 6 alone does not have
        self._birth_det = float(self._birth[0, 0] * self._birth[1, 1]) if config.constant_velocity else None
        self._camera_sigma_rel = 0.0  # of the last frame that states one
        self._together = config.vehicles_move_ego or any(factor.ties_vehicles for factor in self.factors)
        if self._together:
            solver()
        self.window: Window | None = None  # None before the first frame
        self._people: tuple[FollowedPerson, ...] = ()  # in the ego frame of the newest frame
        self._traffic = Traffic(initial_state(config.drives_on))

    def optimise(self, measurements: Measurements, records: Sequence[object] = ()) -> Estimate:
        """Adds the edges of one frame and returns its poses, velocities and covariances.

        `records` are further measurements of this frame, for the caller's own factors. A frame without a CC edge to a
        pose of the window begins a new epoch.
        """
        m = weighted(measurements, self.weights)  # Eq. 4
        self._camera_sigma_rel = m.camera_sigma_rel or self._camera_sigma_rel
        if m.cc is None and not _NO_PIXELS.isdisjoint(m.status):
            return with_camera_scale(self._coast(m), self._camera_sigma_rel)
        window, edges = self.window, pose_edges(m)
        follows = window is not None and self._follows(m, window, edges)
        reset = window is not None and not follows
        if window is None or not follows:
            window = self._begin(m, reset)
        frame = self._associate(m, edges, records)
        if follows:
            self._predict(frame, window)
        self._minimise(frame, window)  # Eq. 8
        self._update_vehicles(frame, window)
        for factor in self._concluding:
            factor.conclude(frame, window)
        self._map.add(m.frame_id, frame.settled, window.world, m.lanes)
        if not window.is_finite:  # corrupt measurements: restart rather than publish
            window, reset = self._begin(m, True), True
        status = (*m.status, Status.GRAPH_RESET) if reset else m.status
        self._people = m.people
        vehicles = self._vehicle_estimates(m, window)
        estimate = self._estimate(m, status, window.ego_cov, vehicles, self._ego_mps)
        if m.road_lanes is not None:
            estimate = msgspec.structs.replace(estimate, lanes=self._lanes(m.road_lanes, window, vehicles))
        return with_camera_scale(estimate, self._camera_sigma_rel)

    def map_update(self) -> MapUpdate | None:
        """Returns the additions to the map since the last call, in world; None if there are none."""
        return self._map.take()

    # --- checkpoint, restore, restart ---

    def checkpoint(self) -> bytes:
        """Returns the state of the graph between two frames, for `restore`."""
        started = None
        if self.window is not None:
            started = Epoch(
                window=self.window.state(),
                vehicles=self._vehicles.nodes,
                factors={f.name: packed(f.state()) for f in self.factors if f.state_type is not None},
                t_ns=self._t_ns,
                t_before_ns=self._t_before_ns,
                motion=self._motion,
                people=list(self._people),
                traffic=self._traffic.state(),
            )
        return pack(Checkpoint(settings=self.settings, epoch=self.epoch, started=started, pending=self._map.state()))

    @property
    def settings(self) -> dict[str, object]:
        """The settings that a checkpoint and the restored graph must have in common."""
        return plain(graph=self.config, weights=self.weights) | {"factors": [factor.name for factor in self.factors]}

    @staticmethod
    def restore(
        data: bytes, config: GraphConfig, weights: WeightsConfig, factors: Sequence[Factor] | None = None
    ) -> PoseGraph:
        """Returns the graph of a `checkpoint`; its further estimates equal those of the original graph, byte by byte.

        Raises CheckpointError for truncated data, for data of another kind, and for other settings.
        """
        graph = PoseGraph(config, weights, factors=factors)
        checkpoint = unpack(data, graph.settings)
        graph.epoch, started = checkpoint.epoch, checkpoint.started
        graph._map.resume(checkpoint.pending, checkpoint.epoch)
        if started is None:
            return graph
        try:
            graph.window = Window.from_state(started.window, graph._together)
            for factor in graph.factors:
                if factor.state_type is not None:
                    factor.resume(unpacked(started.factors.get(factor.name, b""), factor.state_type))
        except CheckpointError:
            raise
        except ValueError as error:
            raise CheckpointError(f"is inconsistent: {error}") from None
        if len(started.vehicles) != len(graph.window.velocity):
            raise CheckpointError(f"is inconsistent: {len(started.vehicles)} vehicles, but not those of the window")
        graph._vehicles = VehicleNodes(config.forget_s, config.max_vehicles, config.detection_contradictions)
        graph._vehicles.resume(started.vehicles)
        graph._t_ns, graph._t_before_ns, graph._motion = started.t_ns, started.t_before_ns, started.motion
        graph._people = tuple(started.people)
        graph._traffic = Traffic(started.traffic)
        return graph

    def _begin(self, m: Measurements, reset: bool) -> Window:
        config = self.config
        self.epoch += int(reset)
        self.window = Window(config.ego_nodes, m.frame_id, self._together)
        self._vehicles = VehicleNodes(config.forget_s, config.max_vehicles, config.detection_contradictions)
        for factor in self.factors:
            factor.begin()
        self._t_ns = self._t_before_ns = m.t_source_ns  # of the newest pose and of the previous one
        self._motion = SE2()  # between them
        self._map.begin(self.epoch)
        return self.window

    def _follows(self, m: Measurements, window: Window, edges: PoseEdges) -> bool:
        """Whether the CC edge of this frame starts at a pose of the window."""
        cc = edges.cc
        return (
            cc is not None
            and cc.to_frame == m.frame_id
            and m.frame_id > window.frame
            and window.has_pose(cc.from_frame)
        )

    # --- the steps of a frame ---

    def _associate(self, m: Measurements, edges: PoseEdges, records: Sequence[object]) -> GraphFrame:
        """Associates the edges of the frame with vehicles of the window."""
        associations = self._vehicles.associate(edges, m.frame_id, m.t_source_ns, self.config.constant_velocity)
        zero_velocity = self.config.zero_velocity_update and Status.STANDSTILL in m.status
        passed_s = max((m.t_source_ns - self._t_ns) * 1e-9, 0.0)
        return GraphFrame(m, edges, records, self._vehicles, associations, zero_velocity, passed_s)

    def _predict(self, frame: GraphFrame, window: Window) -> None:
        """Propagates the window to this frame."""
        cc = frame.edges.cc
        assert cc is not None  # only a frame that follows is predicted
        self._motion = frame.motion = window.motion_since_newest(cc.T_from_to, cc.from_frame)
        for factor in self._predicting:
            factor.predict(frame, window)
        self._t_before_ns, self._t_ns = self._t_ns, frame.measurements.t_source_ns

    def _minimise(self, frame: GraphFrame, window: Window) -> None:
        """Minimizes Eq. 8 over the edges of this frame."""
        terms: dict[str, Linearised] = {}
        alone: list[Linearised] = []  # terms that do not correct the ego
        joint: list[Linearised] = []
        for factor in self._linearising:
            term = factor.linearise(frame, window)
            if term is not None and math.isfinite(np.add.reduce(term.residual, axis=None)):
                terms[factor.name] = term
                leaves_ego = factor.of_vehicles and not self.config.vehicles_move_ego
                (alone if leaves_ego else joint).append(term)
        minimise(window, alone, joint, frame.zero_velocity)
        self.outliers = {name: term.outliers for name, term in terms.items()}

    def _update_vehicles(self, frame: GraphFrame, window: Window) -> None:
        """Removes vehicles not seen for long, and adds new ones and those that were outliers too often."""
        m, cv, known = frame.measurements, frame.edges.cv, frame.associations.known
        outliers = [known[i] for i in self.outliers.get(VehicleDetections.name, ())]
        rows, started = self._vehicles.update(cv, known, outliers, m.t_source_ns)
        if rows is not None:
            window.select(rows)
        if started:
            begins = [self._vehicles.begin(cv[k].vehicle, m.frame_id, m.t_source_ns) for k in started]
            seen = cv_edges(begins, [cv[k] for k in started])
            lasting = math.sqrt(self.config.lasting_share) * seen.factors
            window.place_vehicles(seen, self._birth_covs(seen.covs[:, 2, 2]), lasting, seen.sigma_rel)

    def _birth_covs(self, yaw_variances: Floats) -> Floats:
        """Returns the twist covariances (k, 3, 3) of new vehicles, whose mean twist is zero.

        The twist is expressed in axes with an uncertain yaw, which adds to its variances.
        """
        out = np.tile(self._birth, (len(yaw_variances), 1, 1))
        out[:, 0, 0] += yaw_variances * self._birth[1, 1]
        out[:, 1, 1] += yaw_variances * self._birth[0, 0]
        return out

    # --- the newest frame's estimates ---

    def _coast(self, m: Measurements) -> Estimate:
        """Returns the estimate of a frame without an image: the last pose, with a covariance that grows with time.

        A frame that was skipped (COASTING) is predicted with the last motion.
        """
        window, config = self.window, self.config
        if window is None:
            return self._estimate(m, (*m.status, Status.NOT_INITIALISED), np.zeros((3, 3)), ())
        m = msgspec.structs.replace(m, speed_sources=m.speed_sources or (SpeedSource.CARRIED,))
        since_s = max((m.t_source_ns - self._t_ns) * 1e-9, 0.0)
        twist = self._motion.log() / max((self._t_ns - self._t_before_ns) * 1e-9, MIN_INTERVAL_S)
        change = np.array([config.blind_mps, config.blind_mps, config.blind_radps])
        way = SE2()
        if Status.COASTING in m.status:
            way = SE2.exp(twist * since_s)
        else:
            change += np.abs(twist)
        back = way.inverse().adjoint()
        cov = back @ window.ego_cov @ back.T + np.diag(np.square(change * since_s))
        vehicles = self._vehicle_estimates(m, window)
        return self._estimate(m, m.status, cov, vehicles, self._ego_mps, since_s, way)

    @property
    def _ego_mps(self) -> complex:
        """The ego's velocity in its own axes, from the last motion."""
        since_s = (self._t_ns - self._t_before_ns) * 1e-9
        return complex(self._motion.x_m, self._motion.y_m) / max(since_s, MIN_INTERVAL_S)

    def _lanes(self, lanes: Lanes, window: Window, vehicles: tuple[VehicleEstimate, ...]) -> Lanes:
        """Returns the lanes of the front end with the road users in them."""
        passed_s = max((self._t_ns - self._t_before_ns) * 1e-9, MIN_INTERVAL_S)
        users = lane_users(window, self._vehicles.nodes, vehicles, self._people)
        return with_users(lanes, users, self._motion.x_m / passed_s, self._traffic)

    def _vehicle_estimates(self, m: Measurements, window: Window) -> tuple[VehicleEstimate, ...]:
        return vehicle_estimates(
            window, self._vehicles.nodes, m.t_source_ns, self._twist_growth, self._ego_mps, self._birth_det
        )

    def _estimate(
        self,
        m: Measurements,
        status: tuple[Status, ...],
        cov: Floats,
        vehicles: tuple[VehicleEstimate, ...],
        ego_mps: complex = 0j,
        since_s: float = 0.0,
        way: SE2 = _NO_MOTION,
    ) -> Estimate:
        """Builds the estimate `since_s` after the newest pose of the window; `way` is the ego's motion since then."""
        numbers = cov.ravel().tolist()
        numbers[::4] = [max(variance, 0.0) for variance in numbers[::4]]  # rounding may make a zero variance negative
        before = SE2() if self.window is None else self.window.world
        world = before if way is _NO_MOTION else before @ way
        return Estimate(
            epoch=self.epoch,
            frame_id=m.frame_id,
            t_source_ns=m.t_source_ns,
            t_capture_ns=m.t_capture_ns,
            t_utc_ns=m.t_utc_ns,
            T_world_ego=world,
            cov=tuple(numbers),
            valid=INVALIDATING.isdisjoint(status),
            vehicles=vehicles,
            attitude=m.attitude,
            ground=m.ground,
            scale_sigma_rel=m.scale_sigma_rel,
            status=tuple(dict.fromkeys(status)),
            speed_sources=m.speed_sources,
            people=people_estimates(self._people, since_s, before, cov, ego_mps, way),
            hidden=hidden_fans(vehicles, world, DEFAULT_CAMERA_HEIGHT_M if m.ground is None else m.ground.height_m),
        )
