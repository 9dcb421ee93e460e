"""Replies that are too large for one message, in parts and whole again."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from birdslam.queries import MapSnapshot, Trajectory, VehiclePath

PART_POINTS = 2_000  # of some 20 B each
PART_POSES = 800  # of some 50 B each


def map_parts(snapshot: MapSnapshot) -> list[MapSnapshot]:
    """The same map in parts that fit a message each."""
    starts = range(0, max(len(snapshot.landmarks_m), len(snapshot.lanes_m), 1), PART_POINTS // 2)
    return [
        msgspec.structs.replace(
            snapshot,
            landmarks_m=snapshot.landmarks_m[start : start + PART_POINTS // 2],
            lanes_m=snapshot.lanes_m[start : start + PART_POINTS // 2],
            lane_ids=snapshot.lane_ids[start : start + PART_POINTS // 2],
        )
        for start in starts
    ]


def whole_map(parts: Sequence[MapSnapshot]) -> MapSnapshot:
    """What `map_parts` took apart."""
    return msgspec.structs.replace(
        parts[-1],
        landmarks_m=tuple(point for part in parts for point in part.landmarks_m),
        lanes_m=tuple(point for part in parts for point in part.lanes_m),
        lane_ids=tuple(lane for part in parts for lane in part.lane_ids),
    )


def trajectory_parts(trajectory: Trajectory) -> list[Trajectory]:
    """The same in parts: the ego's poses first, then the vehicles' paths, each of them whole."""
    ego = trajectory.ego
    egos = [ego[start : start + PART_POSES] for start in range(0, max(len(ego), 1), PART_POSES)]
    parts = [msgspec.structs.replace(trajectory, ego=poses, vehicles=()) for poses in egos]
    paths: list[VehiclePath] = []
    for path in trajectory.vehicles:
        if paths and sum(len(p.poses) for p in paths) + len(path.poses) > PART_POSES:
            parts.append(msgspec.structs.replace(trajectory, ego=(), vehicles=tuple(paths)))
            paths = []
        paths.append(path)
    return [*parts, msgspec.structs.replace(trajectory, ego=(), vehicles=tuple(paths))] if paths else parts


def whole_trajectory(parts: Sequence[Trajectory]) -> Trajectory:
    """What `trajectory_parts` took apart."""
    return msgspec.structs.replace(
        parts[-1],
        ego=tuple(pose for part in parts for pose in part.ego),
        vehicles=tuple(path for part in parts for path in part.vehicles),
    )
