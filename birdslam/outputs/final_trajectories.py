"""The final trajectories of a drive, beside the live ones: poses as they are known once the drive is over.

`tracks/ID.final.tum.txt`: one vehicle by the RTS smoother (vehicles/rts_smoother.py). `ego.final.*`:
the ego's live poses again, as in the evaluation: no loop is closed, so that hardly anything seen later bears on a pose
that has left the graph's window. Of vehicles the sizes are learned over time, and where one stops or turns is known
best from both sides.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TextIO

from birdslam.trajectory import ego_pose, tum_row
from birdslam.types import Attitude, Estimate, MapUpdate, Measurements, VehicleEdge
from birdslam.vehicles.rts_smoother import RtsSmoother, SmootherConfig

EGO_FILES = {"ego.tum.txt": "ego.final.tum.txt", "ego.kitti.txt": "ego.final.kitti.txt"}
TRACK_SUFFIX = ".final.tum.txt"


def last_seen(log: Iterable[Measurements]) -> dict[int, int]:
    """Vehicle -> the last frame with an edge of it."""
    return {edge.vehicle: measurements.frame_id for measurements in log for edge in measurements.cv}


class FinalTracks:
    """Smooths and writes each vehicle as soon as its last frame has come; in memory are those that are still to come.

    Frames come in order. `last_frames` is the last frame with an edge of each vehicle (`last_seen`): however long the
    drive, memory holds those vehicles alone that come again.
    """

    def __init__(
        self,
        directory: Path,
        last_frames: Mapping[int, int],
        config: SmootherConfig = SmootherConfig(),  # noqa: B008
    ) -> None:
        """`directory` is that of the live tracks; it is there. Raises OSError where a file can't be written."""
        self._directory = directory
        self._last_frames = last_frames
        self._smoother = RtsSmoother(config)
        self._epoch: int | None = None
        self._open: dict[int, _OpenTrack] = {}
        self._written: set[int] = set()
        self._measurements: Measurements | None = None  # of the estimate to come

    @property
    def vehicles(self) -> int:
        """How many have a final trajectory by now."""
        return len(self._written)

    def take(self, record: Measurements | Estimate | MapUpdate) -> None:
        """The next record of a drive: of each frame the Measurements, then its Estimate."""
        if isinstance(record, Measurements):
            self._measurements = record
        elif isinstance(record, Estimate):
            measurements = self._measurements
            if measurements is not None and measurements.frame_id == record.frame_id:
                self.add(measurements, record)

    def add(self, measurements: Measurements, estimate: Estimate) -> None:
        """One frame's edges, and where they left everybody."""
        if estimate.epoch != self._epoch:
            self._close(list(self._open))  # their world has ended
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
        """Writes the rest."""
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
            file.write("# z is the height of the road under the ego: a vehicle's own is not estimated\n")
        if track.last is not None:
            edge = track.last
            file.write(f"# class {edge.label}, length_m {edge.length_m:.1f}, width_m {edge.width_m:.1f}\n")
        for frame, T_world_vehicle in self._smoother.close(track.epoch, vehicle).items():
            t_ns, z_m = track.seen[frame]
            file.write(tum_row(t_ns, ego_pose(T_world_vehicle, Attitude(z_m=z_m))) + "\n")


class _OpenTrack:
    def __init__(self, epoch: int) -> None:
        self.epoch = epoch
        self.seen: dict[int, tuple[int, float]] = {}  # frame -> source time (ns), the road's height (m)
        self.last: VehicleEdge | None = None


def write_final_ego(directory: Path) -> None:
    """The ego's final trajectory beside its live one. Raises OSError where that can't be."""
    for live, final in EGO_FILES.items():
        shutil.copyfile(directory / live, directory / final)
