"""Replies to planners' queries for the whole trajectory or map; frames and units as in types.py."""

from __future__ import annotations

import msgspec

from birdslam.geometry.se2 import SE2
from birdslam.types import Approach, BodyId, Estimate, FrameId, check_finite, check_points


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
    """The trajectories: key poses in world of `epoch`, oldest first, including the newest pose.

    Older poses are farther apart (see atlas.AtlasConfig).
    """

    epoch: int
    frame_id: FrameId  # of the newest estimate
    t_source_ns: int
    ego: tuple[TimedPose, ...] = ()
    vehicles: tuple[VehiclePath, ...] = ()  # those seen in that time


class MapSnapshot(msgspec.Struct, frozen=True, kw_only=True):
    """The map: all its points, in world of `epoch`, one per cell."""

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


class NearbyUser(msgspec.Struct, frozen=True, kw_only=True):
    """A road user relative to the ego: its pose and closest approach."""

    vehicle: BodyId  # its number
    label: str  # its class
    T_ego_vehicle: SE2
    approach: Approach
    age_ns: int = 0  # source time since it was last seen


class Nearby(msgspec.Struct, frozen=True, kw_only=True):
    """All road users of the newest estimate, `nearby` ones first, then by time: an aid, not a safety function."""

    epoch: int
    frame_id: FrameId
    t_source_ns: int
    t_capture_ns: int
    valid: bool
    users: tuple[NearbyUser, ...] = ()


def nearby(estimate: Estimate) -> Nearby:
    """The road users of an estimate in the order of their closest approach."""
    users = [
        NearbyUser(
            vehicle=user.vehicle,
            label=user.label,
            T_ego_vehicle=estimate.T_world_ego.between(user.T_world_vehicle),
            approach=user.approach,
            age_ns=user.age_ns,
        )
        for user in estimate.road_users
        if user.approach is not None
    ]
    users.sort(key=lambda user: (not user.approach.nearby, user.approach.time_s, user.approach.distance_m))
    return Nearby(
        epoch=estimate.epoch,
        frame_id=estimate.frame_id,
        t_source_ns=estimate.t_source_ns,
        t_capture_ns=estimate.t_capture_ns,
        valid=estimate.valid,
        users=tuple(users),
    )
