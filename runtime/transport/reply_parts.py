"""Splits replies that are too large for one message into parts, and joins them."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from birdslam.queries import MapSnapshot, Trajectory, VehiclePath

PART_POINTS = 2_000  # of some 20 B each
PART_POSES = 800  # of some 50 B each


def map_parts(snapshot: MapSnapshot) -> list[MapSnapshot]:
    """Splits a map into parts that each fit into a message."""
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
    """Joins the parts of `map_parts`."""
    return msgspec.structs.replace(
        parts[-1],
        landmarks_m=tuple(point for part in parts for point in part.landmarks_m),
        lanes_m=tuple(point for part in parts for point in part.lanes_m),
        lane_ids=tuple(lane for part in parts for lane in part.lane_ids),
    )


def trajectory_parts(trajectory: Trajectory) -> list[Trajectory]:
    """Splits a trajectory: first the ego's poses, then the vehicles' paths, each path undivided."""
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
    """Joins the parts of `trajectory_parts`."""
    return msgspec.structs.replace(
        parts[-1],
        ego=tuple(pose for part in parts for pose in part.ego),
        vehicles=tuple(path for part in parts for path in part.vehicles),
    )
