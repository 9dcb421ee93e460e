"""What every method gives: where the ego and the vehicles were, frame by frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.types import Estimate, Measurements


@dataclass(frozen=True)
class Trajectories:
    """`ego[frame]` and `vehicles[vehicle][frame]`, poses in world; a vehicle's only at frames in which it was seen."""

    ego: dict[int, SE2] = field(default_factory=dict)
    vehicles: dict[int, dict[int, SE2]] = field(default_factory=dict)
    converged: bool = True  # False: of a solver that ended short of its minimum

    def put_vehicle(self, vehicle: int, frame: int, pose: SE2) -> None:
        self.vehicles.setdefault(vehicle, {})[frame] = pose


class Method(Protocol):
    """Whatever makes trajectories of a log: a module of this package, or a back end of ours."""

    def run(self, log: Sequence[Measurements], camera: Camera) -> Trajectories: ...


class LiveTrajectories:
    """Collects the live estimates of a pose graph as they come; a new epoch goes on where the last one ended."""

    def __init__(self) -> None:
        self.result = Trajectories()
        self.T_first_world: dict[int, SE2] = {}  # of each epoch's world
        self._last = SE2()

    def add(self, estimate: Estimate) -> None:
        T_first_world = self.T_first_world.get(estimate.epoch)
        if T_first_world is None:
            T_first_world = self._last @ estimate.T_world_ego.inverse()
            self.T_first_world[estimate.epoch] = T_first_world
        self._last = T_first_world @ estimate.T_world_ego
        self.result.ego[estimate.frame_id] = self._last
        for vehicle in estimate.vehicles:
            if vehicle.age_ns == 0:
                pose = T_first_world @ vehicle.T_world_vehicle
                self.result.put_vehicle(vehicle.vehicle, estimate.frame_id, pose)


def dead_reckoned(log: Sequence[Measurements]) -> Trajectories:
    """CC edges chained and CV edges put on top: where every optimisation starts."""
    out = Trajectories()
    pose = SE2()
    for m in log:
        if m.cc is not None and m.cc.from_frame in out.ego:
            pose = out.ego[m.cc.from_frame] @ m.cc.T_from_to
        out.ego[m.frame_id] = pose
        for edge in m.cv:
            out.put_vehicle(edge.vehicle, edge.frame, pose @ edge.T_ego_vehicle)
    return out
