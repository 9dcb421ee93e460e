"""Records that answer planners' queries for the whole trajectory or map; frames and units as in types.py."""

from __future__ import annotations

import msgspec

from birdslam.geometry.se2 import SE2
from birdslam.types import BodyId, FrameId, check_finite, check_points


class TimedPose(msgspec.Struct, frozen=True, array_like=True):
    """A body's pose in world at one frame."""

    frame_id: FrameId
    t_source_ns: int
    T_world_body: SE2  # where it was


class VehiclePath(msgspec.Struct, frozen=True, kw_only=True):
    """One vehicle's poses, oldest first."""

    vehicle: BodyId
    poses: tuple[TimedPose, ...]
    label: str = "car"
    length_m: float = 4.0
    width_m: float = 1.7


class Trajectory(msgspec.Struct, frozen=True, kw_only=True):
    """The trajectories: key poses in world of `epoch`, oldest first, always with the newest.

    Older poses are farther apart (see atlas.AtlasConfig).
    """

    epoch: int
    frame_id: FrameId  # of the newest estimate
    t_source_ns: int
    ego: tuple[TimedPose, ...] = ()
    vehicles: tuple[VehiclePath, ...] = ()  # those seen in that time


class MapSnapshot(msgspec.Struct, frozen=True, kw_only=True):
    """The map: all its points, in world of `epoch`, thinned to one in a cell."""

    epoch: int
    frame_id: FrameId  # of the newest update
    landmarks_m: tuple[tuple[float, float], ...] = ()  # road points
    lanes_m: tuple[tuple[float, float], ...] = ()  # points of lane lines
    cell_m: float = 0.25  # side of a cell near the car; older ones are larger
    lane_ids: tuple[int, ...] = ()  # the lane of each of `lanes_m`, -1: none; empty: all none

    def __post_init__(self) -> None:
        if len(self.lane_ids) not in (0, len(self.lanes_m)):
            raise ValueError(f"lane_ids has {len(self.lane_ids)} entries for {len(self.lanes_m)} points of lanes_m")
        check_finite(self, "cell_m")
        check_points(self, *self.landmarks_m, *self.lanes_m)
