"""The vehicles of the pose graph: who is alive, when it was seen, and which of its detections to believe."""

from __future__ import annotations

from dataclasses import dataclass

from birdslam.types import VehicleEdge


@dataclass(slots=True)
class Vehicle:
    """One vehicle; its pose and velocity are the window's, in the row at which it stands in `Traffic.vehicles`."""

    vehicle: int
    node_frame: int = -1  # of its newest pose
    node_ns: int = 0
    seen_ns: int = 0
    frames: int = 0  # that it was seen in
    agreed: int = 0  # detections that fitted since it was last begun
    contradicted: int = 0  # detections in a row that did not
    label: str = "car"
    length_m: float = 0.0
    width_m: float = 0.0
    delay_ns: int = 0  # of the sight at seen_ns


class Traffic:
    """The vehicles in the order of the window's rows."""

    def __init__(self, forget_s: float, capacity: int, contradictions: int) -> None:
        self._forget_s = forget_s
        self._capacity = capacity
        self._contradictions = contradictions
        self.vehicles: list[Vehicle] = []
        self.row_of: dict[int, int] = {}

    def take_up(self, vehicles: list[Vehicle]) -> None:
        """Goes on with the vehicles of an earlier process, in the order of the window's rows."""
        self.vehicles = vehicles
        self.row_of = {v.vehicle: row for row, v in enumerate(vehicles)}

    def see(
        self, edges: list[VehicleEdge], tied: list[int], wild: list[int], t_ns: int
    ) -> tuple[list[int] | None, list[int]]:
        """Books this frame's CV edges and forgets who is long out of sight.

        Of the edges, `tied` are those that corrected a vehicle or, `wild`, contradicted it and were left out. Returns
        the rows that stay, in their new order, -1 for a vehicle that is new (None: all stay and none is new), and which
        edges begin a vehicle: one that nothing ties to an earlier pose, or one that was contradicted in a row as often
        as it had been agreed with before (or often enough), so that a vehicle born of a wild detection soon dies.
        """
        born = []
        begun = [k for k in range(len(edges)) if k not in tied] if len(tied) < len(edges) else []
        for k, edge in enumerate(edges):
            row = self.row_of.get(edge.vehicle)
            if row is None:
                born.append(v := Vehicle(edge.vehicle))
            else:
                v = self.vehicles[row]
            if k not in wild:
                v.agreed, v.contradicted = v.agreed + 1, 0
            else:
                v.contradicted += 1
                if v.contradicted >= min(v.agreed, self._contradictions):
                    begun.append(k)
            v.seen_ns, v.frames, v.label = t_ns, v.frames + 1, edge.label
            v.length_m, v.width_m, v.delay_ns = edge.length_m, edge.width_m, edge.delay_ns
        known = len(self.vehicles)
        alive = [row for row, v in enumerate(self.vehicles) if (t_ns - v.seen_ns) * 1e-9 <= self._forget_s]
        if not born and len(alive) == known:
            return None, begun
        everyone = [*self.vehicles, *born]
        rows = [*alive, *range(known, len(everyone))]
        if len(rows) > self._capacity:  # the freshest stay, the first of them first
            rows = sorted(sorted(rows, key=lambda row: (-everyone[row].seen_ns, row))[: self._capacity])
        self.vehicles = [everyone[row] for row in rows]
        self.row_of = {v.vehicle: row for row, v in enumerate(self.vehicles)}
        begun = [k for k in begun if edges[k].vehicle in self.row_of]
        return [row if row < known else -1 for row in rows], begun

    def begin(self, vehicle: int, frame: int, t_ns: int) -> int:
        """The row of a vehicle whose first pose is in this frame."""
        row = self.row_of[vehicle]
        v = self.vehicles[row]
        v.node_frame, v.node_ns, v.agreed, v.contradicted = frame, t_ns, 1, 0
        return row
