"""The atlas: trajectories and map of a whole drive, beside the graph's window, in bounded memory.

Octaves: each has half the resolution of the one before. What exceeds the size of an octave moves to the next one and
leaves the last one. So each `add` has a constant cost; by default the atlas covers over 500 km.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import chain, repeat
from typing import Annotated

import msgspec

from birdslam.geometry.se2 import SE2, wrap
from birdslam.queries import MapSnapshot, TimedPose, Trajectory, VehiclePath
from birdslam.types import Estimate, MapUpdate, VehicleEstimate

Positive = Annotated[float, msgspec.Meta(gt=0.0)]
Count = Annotated[int, msgspec.Meta(ge=1)]
Points = Iterable[tuple[float, float]]

_MAX_M = 1e7  # of a valid point's coordinates
_MAX_KEY_POSE_NS = 10**9  # between two key poses of a vehicle


class AtlasConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Resolution and length of the stored drive. By default a snapshot of either record is below 1 MiB."""

    key_pose_m: Positive = 0.5  # distance between key poses in the finest octave
    key_pose_rad: Positive = 0.1  # or rotation between them
    key_poses: Count = 1024  # in each octave
    octaves: Count = 10  # of poses: each has half the resolution of the one before
    vehicles: Count = 64  # number of paths; those out of view for longest are dropped first
    vehicle_poses: Count = 64  # of each vehicle, the newest
    map_cell_m: Positive = 0.25  # of the map, in the finest octave
    map_cells: Count = 4096  # in each octave, of landmarks and of lanes each
    map_octaves: Count = 5  # of the map: each has half the resolution of the one before
    epochs: Count = 2  # the current one, and the one before, which may still get map updates


class Atlas:
    """`add` takes the graph's output for each frame; `trajectory` and `map` return it as records."""

    def __init__(self, config: AtlasConfig) -> None:
        self._config = config
        self._by_epoch: dict[int, _Epoch] = {}  # the newest last
        self._newest: _Epoch | None = None

    @property
    def epochs(self) -> tuple[int, ...]:
        """The stored epochs, oldest first."""
        return tuple(self._by_epoch)

    def add(self, estimate: Estimate, map_update: MapUpdate | None = None) -> None:
        """Adds a frame. An invalid estimate adds no pose."""
        world = self._newest = self._epoch_of(estimate.epoch)
        if estimate.valid:
            world.add_poses(estimate)
        if map_update is not None:
            self._epoch_of(map_update.epoch).add_points(map_update)

    def trajectory(self, last_s: float | None = None, epoch: int | None = None) -> Trajectory | None:
        """The key poses of the last `last_s` of source time, or all; of the newest epoch by default.

        None for an unknown epoch.
        """
        world = self._newest if epoch is None else self._by_epoch.get(epoch)
        return None if world is None else world.trajectory(last_s)

    def map(self, epoch: int | None = None) -> MapSnapshot | None:
        """The whole map of the newest epoch by default. None for an unknown epoch."""
        world = self._newest if epoch is None else self._by_epoch.get(epoch)
        return None if world is None else world.map()

    def _epoch_of(self, epoch: int) -> _Epoch:
        world = self._by_epoch.get(epoch)
        if world is None:
            world = self._by_epoch[epoch] = _Epoch(self._config, epoch)
            while len(self._by_epoch) > self._config.epochs:
                del self._by_epoch[next(iter(self._by_epoch))]
        return world


class _Epoch:
    """The trajectories and the map in the world of one epoch."""

    def __init__(self, config: AtlasConfig, epoch: int) -> None:
        self._config = config
        self._epoch = epoch
        self._frame_id = self._map_frame_id = 0
        self._t_ns = 0
        self._ego = _EgoPath(config)
        self._paths: dict[int, _VehiclePath] = {}  # by vehicle, the one out of view for longest first
        self._landmarks, self._lanes = _MapCells(config), _MapCells(config)

    def add_poses(self, estimate: Estimate) -> None:
        """Adds the poses of the ego and the vehicles of a frame."""
        frame_id, t_ns = self._frame_id, self._t_ns = estimate.frame_id, estimate.t_source_ns
        self._ego.add(TimedPose(frame_id, t_ns, estimate.T_world_ego))
        for v in estimate.vehicles:
            if v.age_ns == 0:
                path = self._paths.pop(v.vehicle, None) or _VehiclePath(v, deque(maxlen=self._config.vehicle_poses))
                path.add(v, TimedPose(frame_id, t_ns, v.T_world_vehicle), self._config)
                self._paths[v.vehicle] = path
        while len(self._paths) > self._config.vehicles:
            del self._paths[next(iter(self._paths))]

    def add_points(self, update: MapUpdate) -> None:
        """Adds the map's new points."""
        self._map_frame_id = update.frame_id
        self._landmarks.add(update.landmarks_m)
        self._lanes.add(update.lanes_m, update.lane_ids)

    def trajectory(self, last_s: float | None) -> Trajectory:
        since_ns = -math.inf if last_s is None else self._t_ns - last_s * 1e9
        paths = []
        for vehicle, path in sorted(self._paths.items()):
            poses = tuple(pose for pose in path.in_order() if pose.t_source_ns >= since_ns)
            if poses:
                v = path.newest
                sizes = {"label": v.label, "length_m": v.length_m, "width_m": v.width_m}
                paths.append(VehiclePath(vehicle=vehicle, poses=poses, **sizes))  # type: ignore[arg-type]
        return Trajectory(
            epoch=self._epoch,
            frame_id=self._frame_id,
            t_source_ns=self._t_ns,
            ego=tuple(pose for pose in self._ego.in_order() if pose.t_source_ns >= since_ns),
            vehicles=tuple(paths),
        )

    def map(self) -> MapSnapshot:
        lanes_m, lane_ids = self._lanes.in_order()
        return MapSnapshot(
            epoch=self._epoch,
            frame_id=self._map_frame_id,
            landmarks_m=self._landmarks.in_order()[0],
            lanes_m=lanes_m,
            cell_m=self._config.map_cell_m,
            lane_ids=lane_ids if any(lane >= 0 for lane in lane_ids) else (),
        )


def _is_apart(a: SE2, b: SE2, min_m: float, min_rad: float) -> bool:
    return math.hypot(a.x_m - b.x_m, a.y_m - b.y_m) >= min_m or abs(wrap(a.yaw_rad - b.yaw_rad)) >= min_rad


class _EgoPath:
    """The ego's key poses, in octaves."""

    def __init__(self, config: AtlasConfig) -> None:
        self._config = config
        self._octaves: list[deque[TimedPose]] = [deque() for _ in range(config.octaves)]  # the finest first
        self._newest: TimedPose | None = None

    def add(self, pose: TimedPose) -> None:
        self._newest = pose
        coarser, config = 1.0, self._config
        for octave in self._octaves:
            apart = config.key_pose_m * coarser, config.key_pose_rad * coarser
            if octave and not _is_apart(octave[-1].T_world_body, pose.T_world_body, *apart):
                return
            octave.append(pose)
            if len(octave) <= config.key_poses:
                return
            pose, coarser = octave.popleft(), 2.0 * coarser

    def in_order(self) -> list[TimedPose]:
        poses = list(chain.from_iterable(reversed(self._octaves)))
        if self._newest is not None and (not poses or poses[-1] != self._newest):
            poses.append(self._newest)
        return poses


@dataclass(slots=True)
class _VehiclePath:
    """One vehicle's newest key poses."""

    newest: VehicleEstimate
    poses: deque[TimedPose]
    last: TimedPose | None = None

    def add(self, v: VehicleEstimate, pose: TimedPose, config: AtlasConfig) -> None:
        self.newest, self.last = v, pose
        before = self.poses[-1] if self.poses else None
        if (
            before is None
            or pose.t_source_ns - before.t_source_ns >= _MAX_KEY_POSE_NS
            or _is_apart(before.T_world_body, pose.T_world_body, config.key_pose_m, config.key_pose_rad)
        ):
            self.poses.append(pose)

    def in_order(self) -> list[TimedPose]:
        poses = list(self.poses)
        return poses if self.last is None or self.last == poses[-1] else [*poses, self.last]


@dataclass(slots=True)
class _MapCells:
    """Mean points of the road in each cell, with the newest lane id (-1: none), in octaves of the cell size."""

    config: AtlasConfig
    octaves: list[dict[tuple[int, int], tuple[float, float, int, int]]] = field(init=False)  # sums, count, id

    def __post_init__(self) -> None:
        self.octaves = [{} for _ in range(self.config.map_octaves)]

    def add(self, points_m: Points, ids: Iterable[int] = ()) -> None:
        config = self.config
        for (x_m, y_m), own in zip(points_m, chain(ids, repeat(-1)), strict=False):
            if abs(x_m) + abs(y_m) > _MAX_M:
                continue
            sums, side_m = (x_m, y_m, 1, own), config.map_cell_m
            for cells in self.octaves:
                x, y, n, lane = sums
                key = math.floor(x / n / side_m), math.floor(y / n / side_m)
                before = cells.pop(key, None)  # re-inserted below as the newest
                if before is not None:
                    newest = lane if lane >= 0 else before[3]
                    sums = before[0] + x, before[1] + y, before[2] + n, newest
                cells[key] = sums
                if len(cells) <= config.map_cells:
                    break
                sums, side_m = cells.pop(next(iter(cells))), 2.0 * side_m

    def in_order(self) -> tuple[tuple[tuple[float, float], ...], tuple[int, ...]]:
        """The points, oldest first, and their ids."""
        cells = [sums for octave in reversed(self.octaves) for sums in octave.values()]
        return tuple((x / n, y / n) for x, y, n, _ in cells), tuple(lane for *_, lane in cells)
