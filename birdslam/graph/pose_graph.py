"""The back end: the paper's incremental SE(2) pose graph (Eqs. 2-8), optimised once for each frame.

`PoseGraph.optimise` takes these steps, each in the module of its part of the graph:

1. weights.py weighs the edges by Eq. 4, edges.py leaves out what is none, vehicles.py finds those that tie vehicles of
   the graph to this frame;
2. window.py moves the graph on to the frame: the ego by the CC edge, vehicles with constant velocity;
3. landmarks.py sums the CP edges (Eq. 7), minimum.py finds the minimum of Eq. 8 over CV, VV and CP edges;
4. vehicles.py, landmarks.py and pending_map.py begin and end vehicles and landmarks;
5. marginals.py gives poses, velocities and marginal covariances of the frame.

The equations themselves stand in factors.py. The feedback of each result into the next frame is the paper's
"incremental approach". F of Eq. 8 has CC, CV and VV edges (Eq. 6) and CP edges (Eq. 7), each with the covariance that
its record states (`weights.weighted` says whose), and, with `constant_velocity`, one more factor on each three poses of
a vehicle in a row: the twist (velocity in its own frame) changes little from one interval to the next.
"""

from __future__ import annotations

import cmath
import math

import msgspec
import numpy as np

from birdslam.geometry.constant_twist import rate
from birdslam.geometry.se2 import SE2
from birdslam.graph import vehicle_places
from birdslam.graph.checkpoint import Checkpoint, CheckpointError, Epoch, pack, plain, unpack
from birdslam.graph.edges import PoseEdges, pose_edges
from birdslam.graph.factors import Floats, VvEdge
from birdslam.graph.graph_config import GraphConfig, check_together
from birdslam.graph.landmarks import Landmarks, Sightings, sightings
from birdslam.graph.marginals import vehicle_estimates
from birdslam.graph.minimum import minimise, solver
from birdslam.graph.pending_map import PendingMap
from birdslam.graph.vehicles import SHORTEST_S, Ties, VehicleNodes, cv_edge
from birdslam.graph.weights import WeightsConfig, weighted
from birdslam.graph.window import Window
from birdslam.types import INVALIDATING, BodyId, Estimate, MapUpdate, Measurements, SpeedSource, Status, VehicleEstimate

_NO_PIXELS = frozenset({Status.END_OF_SOURCE, Status.FRAME_UNREADABLE, Status.COASTING})


class PoseGraph:
    """Bounded in time and memory; deterministic; raises nothing for what a record may say."""

    def __init__(self, config: GraphConfig, weights: WeightsConfig, epoch: int = 0) -> None:
        """Raises ValueError as `check_together`."""
        self.config = config
        self.weights = weights
        self.epoch = epoch
        check_together(config, weights)
        self._map = PendingMap(config.max_pending_landmarks, config.max_pending_frames)
        self._changes = config.change_forward_mps**2, config.change_sideways_mps**2, config.change_turn_radps**2
        self._birth = np.diag(np.square([config.birth_forward_mps, config.birth_sideways_mps, config.birth_turn_radps]))
        # Whether a vehicle stands is judged by its velocity's covariance: Eq. 6 alone has none that was measured
        self._birth_det = float(self._birth[0, 0] * self._birth[1, 1]) if config.constant_velocity else None
        self._window: Window | None = None
        solver()

    def optimise(self, measurements: Measurements) -> Estimate:
        """One frame's edges in; the newest frame's poses, velocities and covariances out.

        A frame that no CC edge ties to a pose of the window begins a new epoch.
        """
        m = weighted(measurements, self.weights)  # Eq. 4
        if m.cc is None and not _NO_PIXELS.isdisjoint(m.status):
            return self._coast(m)
        window, edges = self._window, pose_edges(m)
        follows = window is not None and self._follows(m, window, edges)
        reset = window is not None and not follows
        if window is None or not follows:
            window = self._begin(m, reset)
        ties = self._vehicles.tie(edges, m.frame_id, m.t_source_ns, self.config.constant_velocity)
        if follows:
            self._move_on(m, window, edges, ties)  # CC, and the vehicles' constant velocity
        every = self.config.landmark_anchor == "first_sight"
        seen = sightings(m.cp) if every or window.is_keyframe else None
        outliers = self._minimise(m, window, ties, seen)  # Eq. 8
        self._renew_vehicles(m, window, edges, ties, outliers)
        if seen is not None and edges.cv and self.weights.cp_vehicles is not None:
            self._tie_vehicles(m, window, edges, seen, self.weights.cp_vehicles)
        self._renew_map(m, window, seen)
        if not window.is_finite:  # numbers that no road has: begin anew rather than publish them
            window, reset = self._begin(m, True), True
        status = (*m.status, Status.GRAPH_RESET) if reset else m.status
        return self._estimate(m, status, window.ego_cov, self._vehicle_estimates(m, window))

    def vehicles_in_ego(self) -> dict[BodyId, tuple[SE2, Floats]]:
        """T_ego_vehicle with its covariance (3, 3) in ego, of the vehicles that the newest frame tells of.

        It has nothing of the ego's error in world, which the covariances of an estimate have.
        """
        window, out = self._window, {}
        if window is None:
            return {}
        for row, v in enumerate(self._vehicles.nodes):
            if v.seen_ns == self._t_ns:
                k, states = window.nodes + row, window.layout.poses[row]
                at, yaw_rad = window.at[k], cmath.phase(window.heading[k])
                by_size = v.lasting_rel * np.array([at.real, at.imag, 0.0])  # see marginals.py
                cov = window.P[np.ix_(states, states)] + np.outer(by_size, by_size)
                out[v.vehicle] = SE2(at.real, at.imag, yaw_rad), cov
        return out

    def map_update(self) -> MapUpdate | None:
        """What the map gained since the last call, in world; None where it gained nothing."""
        return self._map.take()

    # --- the life of the graph ---

    def checkpoint(self) -> bytes:
        """The graph as it stands between two frames, for `restore`."""
        begun = None
        if self._window is not None:
            begun = Epoch(
                window=self._window.state(),
                vehicles=self._vehicles.nodes,
                landmarks=self._landmarks.state(),
                t_ns=self._t_ns,
                t_before_ns=self._t_before_ns,
                motion=self._motion,
                lasting_m=self._lasting_m,
                lasting_turn_rad=self._lasting_turn_rad,
            )
        settings = plain(graph=self.config, weights=self.weights)
        return pack(Checkpoint(settings=settings, epoch=self.epoch, begun=begun, pending=self._map.state()))

    @staticmethod
    def restore(data: bytes, config: GraphConfig, weights: WeightsConfig) -> PoseGraph:
        """The graph of a `checkpoint`, which goes on with the very bytes that the one it was taken of would give.

        Raises CheckpointError, which says why, for bytes that are torn, no checkpoint, or one of other settings.
        """
        checkpoint = unpack(data, plain(graph=config, weights=weights))
        graph = PoseGraph(config, weights, checkpoint.epoch)
        begun = checkpoint.begun
        graph._map.resume(checkpoint.pending, checkpoint.epoch)
        if begun is None:
            return graph
        try:
            graph._window = Window.from_state(begun.window)
            graph._landmarks = Landmarks.from_state(begun.landmarks, config.max_landmarks, config.landmark_anchor)
        except ValueError as error:
            raise CheckpointError(f"does not fit together: {error}") from None
        if len(begun.vehicles) != len(graph._window.velocity):
            raise CheckpointError(f"does not fit together: {len(begun.vehicles)} vehicles are not the window's")
        graph._vehicles = VehicleNodes(config.forget_s, config.max_vehicles, config.detection_contradictions)
        graph._vehicles.resume(begun.vehicles)
        graph._t_ns, graph._t_before_ns, graph._motion = begun.t_ns, begun.t_before_ns, begun.motion
        graph._lasting_m, graph._lasting_turn_rad = begun.lasting_m, begun.lasting_turn_rad
        return graph

    def _begin(self, m: Measurements, reset: bool) -> Window:
        config = self.config
        self.epoch += int(reset)
        self._window = Window(config.ego_nodes, m.frame_id)
        self._vehicles = VehicleNodes(config.forget_s, config.max_vehicles, config.detection_contradictions)
        self._landmarks = Landmarks(config.max_landmarks, config.landmark_anchor)
        self._t_ns = self._t_before_ns = m.t_source_ns  # of the newest pose and of the one before
        self._motion = SE2()  # between them
        self._lasting_m = 0.0  # the way that the present error of the scale is common to, its older parts less
        self._lasting_turn_rad = 0.0  # and the turn
        self._map.begin(self.epoch)
        return self._window

    def _follows(self, m: Measurements, window: Window, edges: PoseEdges) -> bool:
        """Whether this frame's CC edge ties it to a pose of the window."""
        cc = edges.cc
        return (
            cc is not None and cc.to_frame == m.frame_id and m.frame_id > window.frame and window.knows(cc.from_frame)
        )

    # --- the steps of a frame ---

    def _move_on(self, m: Measurements, window: Window, edges: PoseEdges, ties: Ties) -> None:
        """The window on to this frame: the ego by the CC edge, vehicles with their twists, for the error of the scale.

        Without `constant_velocity` a vehicle's twist in this interval is what its VV edge says, whatever it was before.
        """
        cc, vv = edges.cc, ties.vv
        assert cc is not None  # the frame follows
        growth = self._changes
        if not self.config.constant_velocity:
            growth = (0.0, 0.0, 0.0)
            if vv:
                self._retwist(window, vv)
        stands = self._stands(m)
        cov = np.zeros((3, 3)) if stands else np.reshape(cc.cov, (3, 3))
        self._motion = window.propagate(cc.T_from_to, cov, cc.from_frame, m.frame_id, ties.dt_s, growth)
        self._landmarks.turn(self._motion.yaw_rad)
        self._t_before_ns, self._t_ns = self._t_ns, m.t_source_ns
        if not stands:
            self._drift(window, m.scale_sigma_rel)

    def _retwist(self, window: Window, edges: list[VvEdge]) -> None:
        """The twists of the interval that led to this frame are what the VV edges say of it."""
        twists = [rate(complex(e.motion.x_m, e.motion.y_m), e.motion.yaw_rad, e.dt_s) for e in edges]
        intervals_s = np.array([e.dt_s for e in edges])
        covs = np.array([e.cov for e in edges]).reshape(-1, 3, 3) / np.square(intervals_s)[:, None, None]
        window.retwist([e.row for e in edges], twists, covs)

    def _drift(self, window: Window, scale_sigma_rel: float) -> None:
        """The error of the metric scale lasts, so that of a step is the same as that of the way before it.

        With a covariance sigma^2 exp(-way / scale_memory_m) between steps, each adds twice its own with all before,
        which are taken to lie in its own direction: in a bend that is too much along the way, too little across it. So
        it is with the direction of travel, across, and with the turn. An odometry that states no sigma of its scale is
        no camera's, and none of its errors lasts.
        """
        step, turn_rad = complex(self._motion.x_m, self._motion.y_m), self._motion.yaw_rad
        if self.config.scale_memory_m and (length_m := abs(step)) and scale_sigma_rel:
            config, along = self.config, step / length_m
            common_m2 = 2.0 * self._lasting_m * length_m
            window.drift(along, scale_sigma_rel**2 * common_m2, config.lasting_direction_rad**2 * common_m2)
            # A turn back takes the error of the turn before it away again: left out, for a variance that never falls
            window.turn_drift(2.0 * config.lasting_turn_rel**2 * max(self._lasting_turn_rad * turn_rad, 0.0))
            keep = math.exp(-length_m / config.scale_memory_m)
            self._lasting_m = keep * self._lasting_m + length_m
            self._lasting_turn_rad = keep * self._lasting_turn_rad + turn_rad

    def _minimise(self, m: Measurements, window: Window, ties: Ties, seen: Sightings | None) -> list[int]:
        """Eq. 8 over this frame's edges; which of the CV edges of `ties` are outliers."""
        config, cp = self.config, None
        if seen is not None:
            cp = self._landmarks.sum_of_edges(  # Eq. 7
                seen,
                window,
                config.landmark_gate_sigma**2,
                config.landmark_common_m**2,
            )
        vv = ties.vv if config.constant_velocity else []  # else they have set the twists
        gate = config.detection_gate_sigma**2
        return minimise(window, ties.cv, vv, cp, gate, self._stands(m), config.ends_alike)

    def _stands(self, m: Measurements) -> bool:
        """Whether the ego holds its pose."""
        return self.config.hold_at_standstill and Status.STANDSTILL in m.status

    def _renew_vehicles(
        self, m: Measurements, window: Window, edges: PoseEdges, ties: Ties, outliers: list[int]
    ) -> None:
        """Forgets who is long out of sight, and begins who is new or was an outlier too often."""
        rows, begun = self._vehicles.book(edges.cv, ties.known, [ties.known[i] for i in outliers], m.t_source_ns)
        if rows is not None:
            window.select(rows)
        for k in begun:
            row = self._vehicles.begin(edges.cv[k].vehicle, m.frame_id, m.t_source_ns)
            seen = cv_edge(row, edges.cv[k])
            window.place(row, seen.at, seen.heading, seen.cov, self._birth_cov(seen.cov[-1]))

    def _tie_vehicles(self, m: Measurements, window: Window, edges: PoseEdges, seen: Sightings, weight: float) -> None:
        """The CP edges of the vehicles that the frame sees, each of information `weight` (Eqs. 4 and 7)."""
        of = {self._vehicles.row(edge.vehicle): edge.T_ego_vehicle for edge in edges.cv}
        of.pop(-1, None)
        places = [complex(T.x_m, T.y_m) for T in of.values()]
        residuals, count = self._landmarks.vehicle_residuals(seen, window, [*of], places)
        if of and count:
            vehicle_places.correct(window, [*of], residuals, 1.0 / (weight * count), self._stands(m))

    def _birth_cov(self, yaw_variance: float) -> Floats:
        """(3, 3) of the twist of a vehicle seen for the first time, at rest for all that is known.

        A yaw that is off turns the velocity: the twist is in axes that are off by it, so its variances grow by that.
        """
        out = self._birth.copy()
        out[0, 0] += yaw_variance * self._birth[1, 1]
        out[1, 1] += yaw_variance * self._birth[0, 0]
        return out

    def _renew_map(self, m: Measurements, window: Window, seen: Sightings | None) -> None:
        """Ties a keyframe's landmarks to it; settled landmarks and the frame's lane points go on the map."""
        settled = [] if seen is None else self._landmarks.tie(seen, window, self.config.landmark_least_frames)
        self._map.add(m.frame_id, settled, window.world, m.lanes)

    # --- the newest frame's estimates ---

    def _coast(self, m: Measurements) -> Estimate:
        """A frame without a picture: the last pose, as uncertain as the time since then makes it.

        One that nobody looked at is told by the last motion, which may have changed meanwhile.
        """
        window, config = self._window, self.config
        if window is None:
            return self._estimate(m, (*m.status, Status.NOT_INITIALISED), np.zeros((3, 3)), ())
        m = msgspec.structs.replace(m, speed_sources=m.speed_sources or (SpeedSource.CARRIED,))
        since_s = max((m.t_source_ns - self._t_ns) * 1e-9, 0.0)
        twist = self._motion.log() / max((self._t_ns - self._t_before_ns) * 1e-9, SHORTEST_S)
        change = np.array([config.blind_mps, config.blind_mps, config.blind_radps])
        way = SE2()
        if Status.COASTING in m.status:
            way = SE2.exp(twist * since_s)
        else:
            change += np.abs(twist)
        back = way.inverse().adjoint()
        cov = back @ window.ego_cov @ back.T + np.diag(np.square(change * since_s))
        estimate = self._estimate(m, m.status, cov, self._vehicle_estimates(m, window))
        return msgspec.structs.replace(estimate, T_world_ego=window.world @ way)

    def _vehicle_estimates(self, m: Measurements, window: Window) -> tuple[VehicleEstimate, ...]:
        since_s = (self._t_ns - self._t_before_ns) * 1e-9
        ego_mps = complex(self._motion.x_m, self._motion.y_m) / max(since_s, SHORTEST_S)
        return vehicle_estimates(window, self._vehicles.nodes, m.t_source_ns, self._changes, ego_mps, self._birth_det)

    def _estimate(
        self, m: Measurements, status: tuple[Status, ...], cov: Floats, vehicles: tuple[VehicleEstimate, ...]
    ) -> Estimate:
        numbers = cov.ravel().tolist()
        numbers[::4] = [max(variance, 0.0) for variance in numbers[::4]]  # where all is known, rounding has either sign
        return Estimate(
            epoch=self.epoch,
            frame_id=m.frame_id,
            t_source_ns=m.t_source_ns,
            t_capture_ns=m.t_capture_ns,
            t_utc_ns=m.t_utc_ns,
            T_world_ego=SE2() if self._window is None else self._window.world,
            cov=tuple(numbers),
            valid=INVALIDATING.isdisjoint(status),
            vehicles=vehicles,
            attitude=m.attitude,
            ground=m.ground,
            scale_sigma_rel=m.scale_sigma_rel,
            status=tuple(dict.fromkeys(status)),
            speed_sources=m.speed_sources,
        )
