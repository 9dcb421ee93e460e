"""The back end: the paper's incremental SE(2) pose graph (Eqs. 2-8), one update for each frame.

`PoseGraph` keeps the books: which edges have both ends in the window, epochs and statuses. `window.Window` solves. The
feedback of each result into the next step is the paper's "incremental approach".

What the graph minimises is F of Eq. 8: CC, CV and VV edges (Eq. 6) and CP edges (Eq. 7), each with the covariance that
its record states (`weights.weighted` says whose), and, with `constant_velocity`, one more factor on each three poses of
a vehicle in a row: the twist (velocity in its own frame) changes little from one interval to the next.
"""

from __future__ import annotations

import math
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.planar import rates
from birdslam.geometry.se2 import SE2
from birdslam.graph.checkpoint import Checkpoint, CheckpointError, Epoch, pack, plain, unpack
from birdslam.graph.edges import PoseEdges, pose_edges
from birdslam.graph.landmarks import Landmarks, PendingMap, Sightings, sightings
from birdslam.graph.marginals import vehicle_estimates
from birdslam.graph.vehicles import Traffic
from birdslam.graph.weights import WeightsConfig, weighted
from birdslam.graph.window import KEY_NODE, Edges, Window
from birdslam.types import INVALIDATING, Estimate, MapUpdate, Measurements, Status, VehicleEstimate

Floats = NDArray[np.float64]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]
NotNegative = Annotated[float, msgspec.Meta(ge=0.0)]
Count = Annotated[int, msgspec.Meta(ge=1)]

_NO_PIXELS = frozenset({Status.END_OF_SOURCE, Status.FRAME_UNREADABLE, Status.COASTING})
_SHORTEST_S = 1e-3  # source clocks that stand still or run backwards
_NO_CP = np.zeros((2, 2))
_NO_EDGES = np.zeros((0, 3)), np.zeros((0, 3, 3))


class GraphConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The back end's own numbers."""

    # Ego poses kept beside the newest. One frame in so many is a key frame: landmarks tie it to the key frame before
    ego_nodes: Annotated[int, msgspec.Meta(ge=1, le=64)] = 4
    # Vehicles
    constant_velocity: bool = True  # False: only VV edges tie the poses of a vehicle, as in Eq. 6
    change_forward_mps: Positive = 2.0  # 1-sigma by which a vehicle's velocity changes within a second
    change_sideways_mps: Positive = 0.5
    change_turn_radps: Positive = 0.3
    birth_forward_mps: Positive = 12.0  # 1-sigma of the velocity of a vehicle seen for the first time
    birth_sideways_mps: Positive = 2.0
    birth_turn_radps: Positive = 0.5
    forget_s: Positive = 1.0  # a vehicle out of sight is predicted on for so long
    max_vehicles: Count = 32  # the longest out of sight go first
    detection_gate_sigma: Positive = 4.0  # Mahalanobis distance past which a detection weighs less; twice it: nothing
    detection_contradictions: Count = 5  # so many left out in a row begin the vehicle anew
    # Static map
    landmark_gate_sigma: Positive = 3.0
    landmark_common_m: NotNegative = 0.15  # 1-sigma of what is common to all landmarks of a frame (scale, pitch)
    landmark_least_frames: Count = 2  # key frames that a landmark was seen in, to be put on the map
    max_landmarks: Count = 512
    max_pending_landmarks: Count = 10_000  # waiting for `map_update`
    max_pending_frames: Count = 1_000  # whose lane points wait for `map_update`
    # What is common to many CC edges in a row, and so moves all that is in sight against the world's origin alone
    scale_memory_m: Positive = 20.0  # the way over which the error of the metric scale lasts
    # Frames without a picture
    blind_mps: Positive = 1.0  # 1-sigma by which the ego's velocity may differ from the last one measured
    blind_radps: Positive = 0.1


class PoseGraph:
    """`update` is one step. Bounded in time and memory; deterministic; raises nothing for what a record may say."""

    def __init__(self, config: GraphConfig, weights: WeightsConfig, epoch: int = 0) -> None:
        self.config = config
        self.weights = weights
        self.epoch = epoch
        self._map = PendingMap(config.max_pending_landmarks, config.max_pending_frames)
        self._changes = np.square([config.change_forward_mps, config.change_sideways_mps, config.change_turn_radps])
        self._birth = np.diag(np.square([config.birth_forward_mps, config.birth_sideways_mps, config.birth_turn_radps]))
        self._window: Window | None = None

    def update(self, measurements: Measurements) -> Estimate:
        """One frame's edges in; the newest frame's poses, velocities and covariances out."""
        m = weighted(measurements, self.weights)
        if m.cc is None and not _NO_PIXELS.isdisjoint(m.status):
            return self._repeat(m)
        window, edges = self._window, pose_edges(m)
        follows = window is not None and self._follows(m, window, edges)
        reset = window is not None and not follows
        if window is None or not follows:
            window = self._begin(m, reset)
        self._step(m, window, edges, follows)
        if not math.isfinite(window.P.trace()):  # numbers that no road has: begin anew rather than publish them
            window, reset = self._begin(m, True), True
        status = (*m.status, Status.GRAPH_RESET) if reset else m.status
        return self._record(m, status, window.P[:3, :3], self._others(m, window))

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
                vehicles=self._traffic.vehicles,
                landmarks=self._landmarks.state(),
                t_ns=self._t_ns,
                t_before_ns=self._t_before_ns,
                motion=self._motion,
                lasting_m=self._lasting_m,
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
        graph._map.take_up(checkpoint.pending, checkpoint.epoch)
        if begun is None:
            return graph
        try:
            graph._window = Window.taken_up(begun.window)
            graph._landmarks = Landmarks.taken_up(begun.landmarks, config.max_landmarks)
        except ValueError as error:
            raise CheckpointError(f"does not fit together: {error}") from None
        if len(begun.vehicles) != len(graph._window.velocity):
            raise CheckpointError(f"does not fit together: {len(begun.vehicles)} vehicles are not the window's")
        graph._traffic = Traffic(config.forget_s, config.max_vehicles, config.detection_contradictions)
        graph._traffic.take_up(begun.vehicles)
        graph._t_ns, graph._t_before_ns, graph._motion = begun.t_ns, begun.t_before_ns, begun.motion
        graph._lasting_m = begun.lasting_m
        return graph

    def _begin(self, m: Measurements, reset: bool) -> Window:
        config = self.config
        self.epoch += int(reset)
        self._window = Window(config.ego_nodes, m.frame_id)
        self._traffic = Traffic(config.forget_s, config.max_vehicles, config.detection_contradictions)
        self._landmarks = Landmarks(config.max_landmarks)
        self._t_ns = self._t_before_ns = m.t_source_ns  # of the newest pose and of the one before
        self._motion = SE2()  # between them
        self._lasting_m = 0.0  # the way that the present error of the scale is common to, its older parts less
        self._map.begin(self.epoch)
        return self._window

    def _follows(self, m: Measurements, window: Window, edges: PoseEdges) -> bool:
        """Whether this frame's CC edge ties it to a pose of the window."""
        cc = edges.cc
        return (
            cc is not None and cc.to_frame == m.frame_id and m.frame_id > window.frame and window.knows(cc.from_frame)
        )

    # --- one frame's edges ---

    def _step(self, m: Measurements, window: Window, edges: PoseEdges, follows: bool) -> None:
        """Moves the window on to this frame, if it follows another, and takes the frame's edges in."""
        config, traffic = self.config, self._traffic
        vehicles, row_of = traffic.vehicles, traffic.row_of
        rows_seen = [row_of.get(e.vehicle, -1) for e in edges.cv]
        known = [k for k, row in enumerate(rows_seen) if row >= 0]
        linked = [k for k, e in enumerate(edges.vv) if self._links(e.vehicle, e.from_frame)]
        rows_linked = [row_of[edges.vv[k].vehicle] for k in linked]
        vv_rows = np.array(rows_linked, dtype=np.int64)
        vv_poses, vv_covs = edges.poses[edges.vv_at], edges.covs[edges.vv_at]
        if len(linked) < len(edges.vv):
            vv_poses, vv_covs = vv_poses[linked], vv_covs[linked]
        hold = Status.STANDSTILL in m.status

        # Every vehicle that an edge of this frame ties to its last pose gets a new one here
        tied = set(rows_linked)
        if config.constant_velocity:
            tied.update([rows_seen[k] for k in known])
        else:
            known = [k for k in known if rows_seen[k] in tied]
        passed_s = [0.0] * len(vehicles)
        for row in tied:
            v = vehicles[row]
            passed_s[row] = max((m.t_source_ns - v.node_ns) * 1e-9, _SHORTEST_S)
            v.node_frame, v.node_ns = m.frame_id, m.t_source_ns
        dt_s = np.array(passed_s)
        vv_dt_s = dt_s[vv_rows]
        growth = dt_s[:, None] * self._changes if config.constant_velocity else np.zeros((len(vehicles), 3))
        if linked and not config.constant_velocity:  # the twist of this interval is what VV says, whatever it was
            window.retwist(vv_rows, *rates(vv_poses, vv_dt_s), vv_covs / np.square(vv_dt_s)[:, None, None])
            vv_rows, vv_dt_s, (vv_poses, vv_covs) = vv_rows[:0], vv_dt_s[:0], _NO_EDGES
        if follows and edges.cc is not None:
            cov = np.zeros((3, 3)) if hold else edges.covs[0]
            self._motion = window.predict(edges.cc.T_from_to, cov, edges.cc.from_frame, m.frame_id, dt_s, growth)
            self._t_before_ns, self._t_ns = self._t_ns, m.t_source_ns
            if not hold:
                self._drift(window, m.scale_sigma_rel)

        key_frame = window.next_node == KEY_NODE
        seen = sightings(m.cp) if key_frame else None
        cp_gap, cp_cov = (None, _NO_CP) if seen is None else self._cp(seen, window)
        cv_poses, cv_covs = edges.poses[edges.cv_at], edges.covs[edges.cv_at]
        some = slice(None) if len(known) == len(edges.cv) else known
        now = Edges(
            cv_rows=np.array([rows_seen[k] for k in known], dtype=np.int64),
            cv_poses=cv_poses[some],
            cv_covs=cv_covs[some],
            vv_rows=vv_rows,
            vv_dt_s=vv_dt_s,
            vv_motions=vv_poses,
            vv_covs=vv_covs,
            cp_gap=cp_gap,
            cp_cov=cp_cov,
        )
        wild = window.correct(now, config.detection_gate_sigma**2, hold)

        rows, begun = traffic.see(edges.cv, known, [known[i] for i in wild], m.t_source_ns)
        if rows is not None:
            window.select(np.array(rows, dtype=np.int64))
        if begun:
            at = [traffic.begin(edges.cv[k].vehicle, m.frame_id, m.t_source_ns) for k in begun]
            window.place(np.array(at, dtype=np.int64), cv_poses[begun], cv_covs[begun], self._born(cv_covs[begun]))
        settled = [] if seen is None else self._landmarks.see(seen, window, config.landmark_least_frames)
        self._map.add(m.frame_id, settled, window.world, m.lanes)

    def _drift(self, window: Window, scale_sigma_rel: float) -> None:
        """The error of the metric scale lasts, so that of a step is the same as that of the way before it.

        With a covariance sigma^2 exp(-way / scale_memory_m) between steps, each adds twice its own with all before,
        which are taken to lie in its own direction: in a bend that is too much along the way, too little across it.
        """
        step = complex(self._motion.x_m, self._motion.y_m)
        if length_m := abs(step):
            window.drift(step / length_m, 2.0 * scale_sigma_rel**2 * self._lasting_m * length_m)
            self._lasting_m = math.exp(-length_m / self.config.scale_memory_m) * self._lasting_m + length_m

    def _born(self, covs: Floats) -> Floats:
        """(k, 3, 3) of the twists of vehicles first seen with `covs` (k, 3, 3), at rest for all that is known.

        A yaw that is off turns the velocity: of the twist, which is told in axes that are off, both share the doubt.
        """
        out = np.tile(self._birth, (len(covs), 1, 1))
        out[:, 0, 0] += covs[:, 2, 2] * self._birth[1, 1]
        out[:, 1, 1] += covs[:, 2, 2] * self._birth[0, 0]
        return out

    def _links(self, vehicle: int, from_frame: int) -> bool:
        """Whether a VV edge starts at the vehicle's newest pose."""
        row = self._traffic.row_of.get(vehicle)
        return row is not None and self._traffic.vehicles[row].node_frame == from_frame

    def _cp(self, seen: Sightings, window: Window) -> tuple[Floats | None, Floats]:
        """The sum of the CP edges (2,), (2, 2), with what the sum over a frame's landmarks does not average away."""
        edge = self._landmarks.edge(seen, window, self.config.landmark_gate_sigma**2)
        if edge is None:
            return None, _NO_CP
        gap, mean, d = edge
        mean += self.config.landmark_common_m**2
        return np.array([gap.real, gap.imag]), np.array([[mean + d.real, d.imag], [d.imag, mean - d.real]])

    # --- the newest frame's estimates ---

    def _repeat(self, m: Measurements) -> Estimate:
        """A frame without a picture: the last pose, as uncertain as the time since then makes it."""
        window, config = self._window, self.config
        if window is None:
            return self._record(m, (*m.status, Status.NOT_INITIALISED), np.zeros((3, 3)), ())
        since_s = max((m.t_source_ns - self._t_ns) * 1e-9, 0.0)
        rate = np.abs(self._motion.log()) / max((self._t_ns - self._t_before_ns) * 1e-9, _SHORTEST_S)
        rate += np.array([config.blind_mps, config.blind_mps, config.blind_radps])
        cov = window.P[:3, :3] + np.diag(np.square(rate * since_s))
        return self._record(
            m, m.status, cov, vehicle_estimates(window, self._traffic.vehicles, m.t_source_ns, self._changes)
        )

    def _others(self, m: Measurements, window: Window) -> tuple[VehicleEstimate, ...]:
        return vehicle_estimates(window, self._traffic.vehicles, m.t_source_ns, self._changes)

    def _record(
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
        )
