"""The vehicles of the pose graph: their bookkeeping, data association, addition and removal."""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.graph.edges import CvEdges, PoseEdges, VvEdges
from birdslam.graph.factors.lasting_error import line_of_sight_factor
from birdslam.types import Moves, VehicleEdge

PATH_HALF_WIDTH_M = 1.75  # half a lane
BESIDE_M = 15.0  # vehicles at a larger lateral distance are on another road or parked: standing.py
MAX_LOG_HEIGHT = 2.0  # of a vehicle
MIN_DISTANCE_M = 1e-9  # of a vehicle from the ego
MIN_INTERVAL_S = 1e-3  # for source clocks that stop or step back


@dataclass(slots=True)
class VehicleNode:
    """One vehicle. Its index in `VehicleNodes.nodes` is its row in the window, which has its pose and twist."""

    vehicle: int
    node_frame: int = -1  # frame of its newest pose
    node_ns: int = 0
    seen_ns: int = 0
    frames: int = 0  # number of frames with a detection
    agreed: int = 0  # inliers since it was added or restarted
    contradicted: int = 0  # consecutive outliers
    label: str = "car"
    length_m: float = 0.0
    width_m: float = 0.0
    delay_ns: int = 0  # delay of the detection at seen_ns
    standing_seen: float | None = None  # probability of being stationary, from the last edge; None: not stated
    in_path: bool = False  # in the ego's path, by its last edge
    beside: bool = False  # farther aside than BESIDE_M at its first edge
    size_bias_rel: float = 0.0  # relative 1-sigma of its distance due to its size, common to all frames
    standing: float | None = None  # probability of being stationary, from all evidence; None: no evidence
    moves: Moves = Moves.UNDECIDED
    is_fixed: bool = False  # by the stationary model: its position in world has no process noise
    height_m: float = 0.0  # 0: unknown
    sigma_height_m: float = 0.0


@dataclass(slots=True)
class Associations:
    """The edges of a frame to vehicles of the window, and the interval over which each vehicle is predicted."""

    known: list[int]  # indices of the frame's CV edges in `cv`
    cv: CvEdges
    vv: VvEdges
    dt_s: Floats  # (M,) since each vehicle's newest pose; 0: no pose in this frame


def cv_edges(rows: list[int], edges: Sequence[VehicleEdge]) -> CvEdges:
    """Returns the edges, in ego, to the vehicles in these rows of the window."""
    ats, headings, table = [], [], []
    for edge in edges:  # for a few vehicles faster than arrays
        T, (xx, xy, xt, _, yy, yt, _, _, tt) = edge.T_ego_vehicle, edge.cov
        at, heading = complex(T.x_m, T.y_m), cmath.rect(1.0, T.yaw_rad)
        mean, deviator = 0.5 * (xx + yy), complex(0.5 * (xx - yy), xy) * (heading * heading)
        xx, xy, yy, with_yaw = mean + deviator.real, deviator.imag, mean - deviator.real, complex(xt, yt) * heading
        xt, yt, distance_m = with_yaw.real, with_yaw.imag, max(abs(at), MIN_DISTANCE_M)
        along, across = line_of_sight_factor(at / distance_m, mean, deviator)
        ats.append(at)
        headings.append(heading)
        factor = along.real, across.real, along.imag, across.imag
        sigma_rel = abs(along) / distance_m, abs(across) / distance_m
        table.append((xx, xy, xt, xy, yy, yt, xt, yt, tt, *factor, *sigma_rel))
    numbers = np.array(table, np.float64).reshape(-1, 15)
    return CvEdges(
        rows,
        np.array(ats, np.complex128),
        np.array(headings, np.complex128),
        numbers[:, :9].reshape(-1, 3, 3),
        numbers[:, 9:13].reshape(-1, 2, 2),
        numbers[:, 13:],
    )


NO_CV = cv_edges([], ())
NO_VV = VvEdges([], np.zeros(0), np.zeros(0, np.complex128), np.zeros(0), np.zeros((0, 3, 3)))


class VehicleNodes:
    """The vehicles in the order of the window's rows."""

    def __init__(self, forget_s: float, capacity: int, contradictions: int) -> None:
        self._forget_s = forget_s
        self._capacity = capacity
        self._contradictions = contradictions
        self.nodes: list[VehicleNode] = []
        self._row: dict[int, int] = {}

    def resume(self, nodes: list[VehicleNode]) -> None:
        """Restores the vehicles of a checkpoint, in the order of the rows of the window."""
        self.nodes = nodes
        self._row = {v.vehicle: row for row, v in enumerate(nodes)}

    def associate(self, edges: PoseEdges, frame: int, t_ns: int, constant_velocity: bool) -> Associations:
        """Selects the edges of the frame to vehicles of the window; each of these vehicles gets a pose in this frame.

        A VV edge must start at the newest pose of its vehicle. Without `constant_velocity` only a VV edge connects
        consecutive poses of a vehicle (Eq. 6).
        """
        rows = [self._row.get(e.vehicle, -1) for e in edges.cv]
        known = [k for k, row in enumerate(rows) if row >= 0]
        linked = []
        for k, e in enumerate(edges.vv):
            row = self._row.get(e.vehicle)
            if row is not None and self.nodes[row].node_frame == e.from_frame:
                linked.append((row, k))
        reached = {row for row, _ in linked}
        if constant_velocity:
            reached.update([rows[k] for k in known])
        else:
            known = [k for k in known if rows[k] in reached]
        dt_s = np.zeros(len(self.nodes))
        for row in reached:
            v = self.nodes[row]
            dt_s[row] = max((t_ns - v.node_ns) * 1e-9, MIN_INTERVAL_S)
            v.node_frame, v.node_ns = frame, t_ns
        cv, vv = NO_CV, NO_VV
        if known:
            cv = cv_edges([rows[k] for k in known], [edges.cv[k] for k in known])
        if linked:
            by_vv, of_vv = [row for row, _ in linked], _some(edges.vv_numbers, [k for _, k in linked])
            at, covs = of_vv[:, 0] + 1j * of_vv[:, 1], of_vv[:, 3:].reshape(-1, 3, 3)
            vv = VvEdges(by_vv, dt_s[by_vv], at, of_vv[:, 2], covs)
        return Associations(known, cv, vv, dt_s)

    def row(self, vehicle: int) -> int:
        """Returns the row of a vehicle in the window; -1 if there is none."""
        return self._row.get(vehicle, -1)

    def update(
        self, edges: list[VehicleEdge], known: list[int], outliers: list[int], t_ns: int
    ) -> tuple[list[int] | None, list[int]]:
        """Updates the vehicles by the CV edges of this frame, and removes those not seen for `forget_s`.

        `known` are the edges to vehicles of the window, `outliers` those of them that were rejected. Returns the rows
        that are kept, in their new order, with -1 for a new vehicle (None: no change), and the edges that start or
        restart a vehicle. A vehicle restarts after as many consecutive outliers as it had inliers before, or after
        `contradictions`, so that a track that started with an outlier ends soon.
        """
        born = []
        started = [k for k in range(len(edges)) if k not in known] if len(known) < len(edges) else []
        for k, edge in enumerate(edges):
            row = self._row.get(edge.vehicle)
            if row is None:
                born.append(v := VehicleNode(edge.vehicle, beside=abs(edge.T_ego_vehicle.y_m) > BESIDE_M))
            else:
                v = self.nodes[row]
            if k not in outliers:
                v.agreed, v.contradicted = v.agreed + 1, 0
            else:
                v.contradicted += 1
                if v.contradicted >= min(v.agreed, self._contradictions):
                    started.append(k)
            v.seen_ns, v.frames, v.label = t_ns, v.frames + 1, edge.label
            v.length_m, v.width_m, v.delay_ns = edge.length_m, edge.width_m, edge.delay_ns
            v.standing_seen = edge.standing or None  # 0: not stated
            v.size_bias_rel = abs(edge.depth_per_height) * edge.sigma_log_height
            if edge.sigma_log_height > 0.0:
                v.height_m = math.exp(min(edge.log_height, MAX_LOG_HEIGHT))
                v.sigma_height_m = v.height_m * min(edge.sigma_log_height, 1.0)
            v.in_path = abs(edge.T_ego_vehicle.y_m) < PATH_HALF_WIDTH_M
        before = len(self.nodes)
        alive = [row for row, v in enumerate(self.nodes) if (t_ns - v.seen_ns) * 1e-9 <= self._forget_s]
        if not born and len(alive) == before:
            return None, started
        everyone = [*self.nodes, *born]
        rows = [*alive, *range(before, len(everyone))]
        if len(rows) > self._capacity:  # keep those seen last
            rows = sorted(sorted(rows, key=lambda row: (-everyone[row].seen_ns, row))[: self._capacity])
        self.nodes = [everyone[row] for row in rows]
        self._row = {v.vehicle: row for row, v in enumerate(self.nodes)}
        started = [k for k in started if edges[k].vehicle in self._row]
        return [row if row < before else -1 for row in rows], started

    def begin(self, vehicle: int, frame: int, t_ns: int) -> int:
        """Starts a vehicle at this frame and returns its row."""
        row = self._row[vehicle]
        v = self.nodes[row]
        v.node_frame, v.node_ns, v.agreed, v.contradicted = frame, t_ns, 1, 0
        return row


def _some(numbers: Floats, rows: Sequence[int]) -> Floats:
    return numbers if len(rows) == len(numbers) else numbers[rows]
