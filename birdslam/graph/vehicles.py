"""The vehicles of the pose graph: which are in it, which edges tie them to it, and which detections are outliers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.graph.costs import rotated
from birdslam.graph.edges import CvEdges, PoseEdges, VvEdges
from birdslam.graph.factors.lasting_error import sight_factors
from birdslam.types import Moves, VehicleEdge

PATH_HALF_WIDTH_M = 1.75  # half a lane, as in vehicles/state/parallax.py
BESIDE_M = 15.0  # farther aside is another road, or none: see standing.py
MAX_LOG_HEIGHT = 2.0  # of what is no vehicle
SHORTEST_S = 1e-3  # source clocks that stand still or run backwards


@dataclass(slots=True)
class VehicleNode:
    """One vehicle; its pose and velocity are the window's, in the row at which it stands in `VehicleNodes.nodes`."""

    vehicle: int
    node_frame: int = -1  # of its newest pose
    node_ns: int = 0
    seen_ns: int = 0
    frames: int = 0  # that it was seen in
    agreed: int = 0  # detections that fitted since it was last begun
    contradicted: int = 0  # outliers in a row
    label: str = "car"
    length_m: float = 0.0
    width_m: float = 0.0
    delay_ns: int = 0  # of the detection at seen_ns
    standing_seen: float | None = None  # the probability that it stands, by its last edge; None: that did not say
    in_path: bool = False  # of the ego, by its last edge
    beside: bool = False  # on another road, or on none, by its first edge
    size_bias_rel: float = 0.0  # 1-sigma of its distance by its size's error, a fraction: the same in all frames
    standing: float | None = None  # the probability by all that is known; None: of that nothing
    moves: Moves = Moves.UNDECIDED
    height_m: float = 0.0  # 0: not known
    sigma_height_m: float = 0.0


@dataclass(slots=True)
class Associations:
    """The edges of a frame to vehicles of the window, and for how long each vehicle drives on."""

    known: list[int]  # which of the frame's CV edges `cv` has
    cv: CvEdges
    vv: VvEdges
    dt_s: Floats  # (M,) since each vehicle's newest pose; 0: it gets no pose in this frame


def cv_edges(rows: list[int], numbers: Floats) -> CvEdges:
    """The edges to the vehicles in these rows of the window, all in ego, from their `numbers` (k, 12)."""
    at, heading = numbers[:, 0] + 1j * numbers[:, 1], np.exp(1j * numbers[:, 2])
    covs = rotated(numbers[:, 3:].reshape(-1, 3, 3), heading)
    return CvEdges(rows, at, heading, covs, sight_factors(at, covs))


NO_CV = cv_edges([], np.zeros((0, 12)))
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
        """Goes on with the vehicles of an earlier process, in the order of the window's rows."""
        self.nodes = nodes
        self._row = {v.vehicle: row for row, v in enumerate(nodes)}

    def associate(self, edges: PoseEdges, frame: int, t_ns: int, constant_velocity: bool) -> Associations:
        """Which edges of the frame have both ends in the window; each vehicle that they reach gets a pose there.

        A VV edge has to start at the vehicle's newest pose. Without `constant_velocity` nothing but a VV edge ties a
        vehicle's new pose to the one before (Eq. 6).
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
            dt_s[row] = max((t_ns - v.node_ns) * 1e-9, SHORTEST_S)
            v.node_frame, v.node_ns = frame, t_ns
        cv, vv = NO_CV, NO_VV
        if known:
            cv = cv_edges([rows[k] for k in known], _some(edges.cv_numbers, known))
        if linked:
            by_vv, of_vv = [row for row, _ in linked], _some(edges.vv_numbers, [k for _, k in linked])
            at, covs = of_vv[:, 0] + 1j * of_vv[:, 1], of_vv[:, 3:].reshape(-1, 3, 3)
            vv = VvEdges(by_vv, dt_s[by_vv], at, of_vv[:, 2], covs)
        return Associations(known, cv, vv, dt_s)

    def row(self, vehicle: int) -> int:
        """Of a vehicle in the window; -1: it is not there."""
        return self._row.get(vehicle, -1)

    def update(
        self, edges: list[VehicleEdge], known: list[int], outliers: list[int], t_ns: int
    ) -> tuple[list[int] | None, list[int]]:
        """Takes up what this frame's CV edges say of vehicles, and forgets who is long out of sight.

        Of the edges, `known` are those that corrected a vehicle or, being `outliers`, contradicted it and were left
        out. Returns the rows that stay, in their new order, -1 for a vehicle that is new (None: all stay and none is
        new), and which edges begin a vehicle: one that nothing ties to an earlier pose, or one that was contradicted in
        a row as often as it had been agreed with before (or often enough), so that a vehicle that began with an outlier
        soon ends.
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
            v.standing_seen = edge.standing or None  # 0: nobody said
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
        if len(rows) > self._capacity:  # the freshest stay, the first of them first
            rows = sorted(sorted(rows, key=lambda row: (-everyone[row].seen_ns, row))[: self._capacity])
        self.nodes = [everyone[row] for row in rows]
        self._row = {v.vehicle: row for row, v in enumerate(self.nodes)}
        started = [k for k in started if edges[k].vehicle in self._row]
        return [row if row < before else -1 for row in rows], started

    def begin(self, vehicle: int, frame: int, t_ns: int) -> int:
        """The row of a vehicle whose first pose is in this frame."""
        row = self._row[vehicle]
        v = self.nodes[row]
        v.node_frame, v.node_ns, v.agreed, v.contradicted = frame, t_ns, 1, 0
        return row


def _some(numbers: Floats, rows: Sequence[int]) -> Floats:
    return numbers if len(rows) == len(numbers) else numbers[rows]
