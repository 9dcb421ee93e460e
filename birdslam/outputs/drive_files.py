"""Writes the results of a drive, line by line. FILES lists them.

Row k of `ego.kitti.txt` is the camera pose `T_first_k`; a frame without an estimate repeats the previous pose. TUM
files hold the ego and the footprint centre of each vehicle in world. At a new epoch, TUM files contain a comment and
the ego poses continue at the last pose.
"""

from __future__ import annotations

import math
from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self, TextIO

import msgspec
import numpy as np
import scipy.spatial.transform  # noqa: F401  # slow import: before the first frame, not with it (trajectory.py)

from birdslam.geometry.camera import Camera
from birdslam.outputs.bev_picture import draw
from birdslam.outputs.final_trajectories import EGO_FILES
from birdslam.outputs.line_map import LineMap
from birdslam.outputs.placed import AROUND_FILES, PLACES_FILE, ROAD_IN_MAP, write_around
from birdslam.outputs.plain_words import DriveCounts, LengthsBy, readme, verdict
from birdslam.outputs.scene_recorder import MAX_POSES, MAX_TRACKS, SceneRecorder, Thinned
from birdslam.trajectory import CameraTrajectory, JoinedTrajectory, Transform, ego_pose, kitti_row, tum_row
from birdslam.types import INVALIDATING, Attitude, Estimate, MapUpdate, Status, VehicleEstimate

MAX_FILLED_FRAMES = 10_000  # a longer gap in the frame numbers is a new source, not dropped frames
FRAMES_FILE = "frames.csv"
FRAME_COLUMNS = ("frame", "t_s", "epoch", "x_m", "y_m", "yaw_rad", "speed_mps", "scale_sigma_rel", "valid", "status")
FILES = {  # descriptions for README.txt
    "summary.json": "all counts, the configuration and the versions",
    "bev.png": "the drive from above",
    "ego.tum.txt": "the trajectory of the car: time, position and attitude of each valid frame, in metres",
    "frames.csv": "position, speed, scale sigma, validity and statuses of each frame",
    "report.html": "a page with all results, for any browser",
    "ego.kitti.txt": "the camera poses in KITTI format",
    "ego.final.tum.txt": "the final trajectory of the car, after the drive",
    "tracks": "the trajectory of each other vehicle, as ego.tum.txt; ID.final.tum.txt is smoothed",
    "map.csv": "points of the road and of the lanes, in metres",
    "map.geojson": "lane lines and road edges as polylines, in metres",
    PLACES_FILE: "the position of the car in the map and on Earth, one row per metre, after the drive",
    ROAD_IN_MAP: "map.geojson and map.csv in map coordinates",
    "road.geojson": "lane lines and road edges in WGS 84, also as road.gpx and road.kml",
    "tracks.geojson": "the trajectories of other vehicles in WGS 84, also as tracks.gpx and tracks.kml",
    "camera.toml": "the camera estimated by the first pass, for `--camera`",
    "logs": "the log of each process",
}


class ResultsError(ValueError):
    """Results can't be read or written. The message names the path and the reason."""


def claim_directory(directory: Path) -> None:
    """Creates the directory and checks that it is writable. Raises ResultsError."""
    probe = directory / ".writable"
    try:
        directory.mkdir(parents=True, exist_ok=True)
        probe.touch()
        probe.unlink()
    except OSError as error:
        reason = "is a file" if directory.is_file() else error.strerror
        raise ResultsError(f"output directory {directory}: {reason}") from None


def write_json(path: Path, report: object) -> None:
    """Writes structs, or lists of them, as indented JSON."""
    path.write_bytes(msgspec.json.format(msgspec.json.encode(report), indent=2) + b"\n")


class Recorder:
    """Writes the results of one drive to a directory, with bounded memory. Replaces earlier results there.

    Camera poses are relative to the calibrated ground plane of the camera, as `Estimate.attitude` is. As a context
    manager, it closes the files of a failed run; `finish` ends a complete run. Raises ResultsError if the directory is
    not writable.
    """

    def __init__(self, directory: Path, camera: Camera) -> None:
        claim_directory(directory)
        self._directory, self._camera = directory, camera
        self._tracks_directory = directory / "tracks"
        self._files = ExitStack()
        try:
            self._tracks_directory.mkdir(exist_ok=True)
            later = (
                directory / name
                for name in ("summary.json", "bev.png", "README.txt", "report.html", *EGO_FILES.values(), *AROUND_FILES)
            )
            for old in (*self._tracks_directory.glob("*.tum.txt"), *later):
                old.unlink(missing_ok=True)
            names = ("ego.kitti.txt", "ego.tum.txt", "map.csv", FRAMES_FILE)
            self._kitti, self._tum, self._map, self._table = map(self._open, names)
            self._lines = LineMap(directory / "map.geojson")
            self._files.callback(self._lines.close)
        except OSError as error:
            self.close()
            raise ResultsError(f"output directory {directory}: {error.strerror}: {error.filename}") from None
        self._tum.write("# t_s x_m y_m z_m qx qy qz qw: the ego (the camera's foot on the road) in world\n")
        self._map.write("epoch,kind,x_m,y_m,lane\n")
        self._table.write(",".join(FRAME_COLUMNS) + "\n")
        self.statuses: Counter[str] = Counter()
        self.speed_sources: Counter[str] = Counter()
        self._trajectory, self._ego = CameraTrajectory(camera.ground), JoinedTrajectory()
        self._next_row = 0
        self._frames = self._invalid = 0
        self._ends_unreadable = False  # the newest image was damaged or missing
        self._invalid_by: Counter[str] = Counter()
        self._path_m = self._valid_path_m = 0.0
        self._sigmas = Thinned(1, MAX_POSES)  # of the scale, in valid frames
        self._last: Estimate | None = None
        self._epoch: int | None = None
        self._epoch_count = 0
        self._scene = SceneRecorder()
        self._tracks: dict[int, tuple[str, int]] = {}  # class comment and epoch of the most recent vehicles
        self._track_count = 0

    def _open(self, name: str) -> TextIO:
        return self._files.enter_context((self._directory / name).open("w", encoding="ascii", buffering=1))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *failure: object) -> None:
        self.close()

    def close(self) -> None:
        """Closes the files and keeps their content. `finish` calls it too."""
        self._files.close()

    def add(self, estimate: Estimate) -> None:
        """Adds the estimate of one frame. The last record of a run, END_OF_SOURCE, is not a frame and adds no row."""
        if Status.END_OF_SOURCE in estimate.status:
            return
        if estimate.epoch != self._epoch:
            self._begin_epoch(estimate)
        elif self._last is not None:
            step = self._last.T_world_ego.between(estimate.T_world_ego)
            self._path_m += math.hypot(step.x_m, step.y_m)
            self._valid_path_m += math.hypot(step.x_m, step.y_m) * estimate.valid
        self._frames += 1
        self._invalid += not estimate.valid
        self._invalid_by.update(status.value for status in estimate.status if status in INVALIDATING)
        if estimate.valid:
            self._sigmas.add(estimate.scale_sigma_rel)
        self.statuses.update(status.value for status in estimate.status)
        self.speed_sources.update(source.value for source in estimate.speed_sources)
        self._ends_unreadable = Status.FRAME_UNREADABLE in estimate.status
        self._table.write(self._frame_row(estimate) + "\n")
        pose = ego_pose(estimate.T_world_ego, estimate.attitude)
        row = tum_row(estimate.t_source_ns, self._ego.add(estimate.epoch, pose))
        self._tum.write(f"{row}\n" if estimate.valid else f"# not valid: {row}\n")
        self._write_row(estimate, pose)
        self._scene.add(estimate)
        self._lines.add(estimate, self._scene.T_picture_world)
        for vehicle in estimate.road_users:
            if vehicle.age_ns == 0:
                self._write_vehicle(estimate, vehicle)
        self._last = estimate

    def add_map(self, update: MapUpdate) -> None:
        """Adds new points of the map."""
        for kind, points, lanes in (("landmark", update.landmarks_m, ()), ("lane", update.lanes_m, update.lane_ids)):
            self._map.writelines(
                f"{update.epoch},{kind},{x_m:.3f},{y_m:.3f},{lane}\n"
                for (x_m, y_m), lane in zip(points, lanes or (-1,) * len(points), strict=True)
            )
        if update.epoch == self._epoch:  # the picture has the transform of the newest epoch only
            self._scene.add_map(update)

    def finish(self, summary: dict[str, Any], lengths_by: LengthsBy | None = None) -> list[str]:
        """Writes summary.json, bev.png and README.txt, and closes the files. Returns the sentences of the verdict.

        Entries of `summary` override the counts of the recorder; numbers that are not finite become null. `lengths_by`
        states the source of camera height and lens; None takes the sigma of the camera.
        """
        self.close()
        sigmas = self._sigmas.array()
        counts: dict[str, Any] = {
            "frames": self._frames,
            "invalid_frames": self._invalid,
            "invalid_by": dict(sorted(self._invalid_by.items())),
            "path_m": round(self._path_m, 3),
            "valid_path_m": round(self._valid_path_m, 3),
            "scale_sigma_rel": round(float(np.median(sigmas)), 5) if len(sigmas) else None,
            "camera_sigma_rel": self._camera.scale_sigma_rel,
            "tracks": self._track_count,
            "epochs": self._epoch_count,
            "statuses": dict(sorted(self.statuses.items())),
            "ends_unreadable": self._ends_unreadable,
            "speed_sources": dict(sorted(self.speed_sources.items())),
        }
        known = {name: counts[name] for name in DriveCounts.__dataclass_fields__ if name in counts}
        sentences = verdict(DriveCounts(**known, lengths_by=lengths_by or self._stated()))
        encoded = msgspec.json.encode({**counts, "verdict": sentences, **summary}, enc_hook=_plain)
        (self._directory / "summary.json").write_bytes(msgspec.json.format(encoded, indent=2) + b"\n")
        write_around(self._directory)  # after the primary files: derived files can be written again
        name, lines = self._directory.resolve().name, tuple(self._lines.drawn())
        counted = {"path_m": self._path_m, "frames": self._frames, "track_count": self._track_count}
        scene = self._scene.scene(name=name, sigma_rel=self._camera.scale_sigma_rel, lines=lines, **counted)
        draw(scene, self._directory / "bev.png")
        there = {name: what for name, what in FILES.items() if (self._directory / name).exists()}
        text = readme(name, sentences, there)
        (self._directory / "README.txt").write_text(text, encoding="utf-8")
        return sentences

    def _frame_row(self, estimate: Estimate) -> str:
        T, last, speed = estimate.T_world_ego, self._last, ""
        if last is not None and last.epoch == estimate.epoch and estimate.t_source_ns > last.t_source_ns:
            step = last.T_world_ego.between(T)
            speed = f"{math.hypot(step.x_m, step.y_m) * 1e9 / (estimate.t_source_ns - last.t_source_ns):.3f}"
        status = " ".join(one.value for one in estimate.status)
        return (
            f"{estimate.frame_id},{estimate.t_source_ns * 1e-9:.6f},{estimate.epoch},{T.x_m:.3f},{T.y_m:.3f},"
            f"{T.yaw_rad:.5f},{speed},{estimate.scale_sigma_rel:.4f},{int(estimate.valid)},{status}"
        )

    def _stated(self) -> LengthsBy:
        """Returns the lengths of a camera that states its sigma, but not the source of it."""
        sigma_rel = self._camera.scale_sigma_rel
        return LengthsBy(height_sigma_rel=sigma_rel)

    def _begin_epoch(self, estimate: Estimate) -> None:
        if self._last is not None:
            self._tum.write(f"# epoch {estimate.epoch}: a new world frame begins; its poses continue at the last one\n")
        self._epoch = estimate.epoch
        self._epoch_count += 1

    def _write_row(self, estimate: Estimate, T_world_ego: Transform) -> None:
        if 0 < estimate.frame_id - self._next_row <= MAX_FILLED_FRAMES:
            held = kitti_row(self._trajectory.last)
            self._kitti.writelines(held + "\n" for _ in range(estimate.frame_id - self._next_row))
        self._kitti.write(kitti_row(self._trajectory.add(estimate.epoch, T_world_ego)) + "\n")
        self._next_row = estimate.frame_id + 1

    def _write_vehicle(self, estimate: Estimate, vehicle: VehicleEstimate) -> None:
        path = self._tracks_directory / f"{vehicle.vehicle}.tum.txt"
        known, lines = self._tracks.pop(vehicle.vehicle, None), []
        if known is None and not path.exists():
            self._track_count += 1
            lines.append(f"# track {vehicle.vehicle}: t_s x_m y_m z_m qx qy qz qw of its footprint's centre in world")
            lines.append("# z is the height of the road under the ego; the height under the vehicle is not estimated")
        if known is not None and known[1] != estimate.epoch:
            lines.append(f"# epoch {estimate.epoch}: a new world frame begins")
        described = f"# class {vehicle.label}, length_m {vehicle.length_m:.1f}, width_m {vehicle.width_m:.1f}"
        if known is None or described != known[0]:
            lines.append(described)
        pose = ego_pose(vehicle.T_world_vehicle, Attitude(z_m=estimate.attitude.z_m))
        lines.append(tum_row(estimate.t_source_ns, pose))
        with path.open("a", encoding="ascii", errors="backslashreplace") as file:  # not kept open: too many descriptors
            file.write("\n".join(lines) + "\n")
        self._tracks[vehicle.vehicle] = described, estimate.epoch  # insertion order: the most recent is last
        if len(self._tracks) > MAX_TRACKS:
            del self._tracks[next(iter(self._tracks))]


def _plain(value: object) -> object:
    """Converts numpy numbers and arrays, and paths, for JSON."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    return str(value)
