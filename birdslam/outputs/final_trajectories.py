"""Writes the final trajectories of a drive, which use later measurements as well.

`tracks/ID.final.tum.txt` is one vehicle, smoothed (road_users/rts_smoother.py). `ego.final.*` copies the live ego
poses: without loop closures, later measurements hardly change a pose outside the window of the graph.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TextIO

from birdslam.road_users.rts_smoother import RtsSmoother, SmootherConfig
from birdslam.trajectory import ego_pose, tum_row
from birdslam.types import Attitude, Estimate, MapUpdate, Measurements, VehicleEdge

EGO_FILES = {"ego.tum.txt": "ego.final.tum.txt", "ego.kitti.txt": "ego.final.kitti.txt"}
TRACK_SUFFIX = ".final.tum.txt"


def last_seen(log: Iterable[Measurements]) -> dict[int, int]:
    """Returns the last frame with an edge, by vehicle."""
    return {edge.vehicle: measurements.frame_id for measurements in log for edge in measurements.cv}


class FinalTracks:
    """Smooths and writes each vehicle after its last frame. Frames are in order.

    `last_frames` are the results of `last_seen`. Memory holds only the vehicles that appear again.
    """

    def __init__(
        self,
        directory: Path,
        last_frames: Mapping[int, int],
        config: SmootherConfig = SmootherConfig(),  # noqa: B008
    ) -> None:
        """`directory` is the existing directory of the live tracks. Methods raise OSError."""
        self._directory = directory
        self._last_frames = last_frames
        self._smoother = RtsSmoother(config)
        self._epoch: int | None = None
        self._open: dict[int, _OpenTrack] = {}
        self._written: set[int] = set()
        self._measurements: Measurements | None = None  # of the next estimate

    @property
    def vehicles(self) -> int:
        """The number of final trajectories so far."""
        return len(self._written)

    def take(self, record: Measurements | Estimate | MapUpdate) -> None:
        """Takes the next record of a drive: for each frame the Measurements, then the Estimate."""
        if isinstance(record, Measurements):
            self._measurements = record
        elif isinstance(record, Estimate):
            measurements = self._measurements
            if measurements is not None and measurements.frame_id == record.frame_id:
                self.add(measurements, record)

    def add(self, measurements: Measurements, estimate: Estimate) -> None:
        """Adds the edges and the estimate of one frame."""
        if estimate.epoch != self._epoch:
            self._close(list(self._open))
            self._epoch = estimate.epoch
        self._smoother.add(measurements, estimate)
        known = {vehicle.vehicle for vehicle in estimate.vehicles}
        for edge in measurements.cv:
            if edge.vehicle in known:
                track = self._open.setdefault(edge.vehicle, _OpenTrack(estimate.epoch))
                track.seen[estimate.frame_id] = estimate.t_source_ns, estimate.attitude.z_m
                track.last = edge
        self._close([v for v in self._open if self._last_frames.get(v, -1) <= estimate.frame_id])

    def finish(self) -> None:
        """Writes the remaining vehicles."""
        self._close(list(self._open))

    def _close(self, vehicles: Iterable[int]) -> None:
        for vehicle in vehicles:
            track = self._open.pop(vehicle)
            path = self._directory / f"{vehicle}{TRACK_SUFFIX}"
            with path.open(
                "a" if vehicle in self._written else "w", encoding="ascii", errors="backslashreplace"
            ) as file:
                self._write(file, vehicle, track)
            self._written.add(vehicle)

    def _write(self, file: TextIO, vehicle: int, track: _OpenTrack) -> None:
        if vehicle in self._written:
            file.write(f"# epoch {track.epoch}: a new world frame begins\n")
        else:
            file.write(f"# track {vehicle}, smoothed: t_s x_m y_m z_m qx qy qz qw of its footprint's centre in world\n")
            file.write("# z is the height of the road under the ego; the height under the vehicle is not estimated\n")
        if track.last is not None:
            edge = track.last
            file.write(f"# class {edge.label}, length_m {edge.length_m:.1f}, width_m {edge.width_m:.1f}\n")
        for frame, T_world_vehicle in self._smoother.close(track.epoch, vehicle).items():
            t_ns, z_m = track.seen[frame]
            file.write(tum_row(t_ns, ego_pose(T_world_vehicle, Attitude(z_m=z_m))) + "\n")


class _OpenTrack:
    def __init__(self, epoch: int) -> None:
        self.epoch = epoch
        self.seen: dict[int, tuple[int, float]] = {}  # frame -> source time (ns), road height (m)
        self.last: VehicleEdge | None = None


def write_final_ego(directory: Path) -> None:
    """Writes the final trajectory of the ego next to the live one. Raises OSError."""
    for live, final in EGO_FILES.items():
        shutil.copyfile(directory / live, directory / final)
