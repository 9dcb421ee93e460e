"""Results of a drive, written line by line as the estimates come.

`ego.kitti.txt`: camera poses `T_first_i`, row k is frame k (a frame without an estimate keeps the pose before it).
`ego.tum.txt`, `tracks/ID.tum.txt`: the ego, and the footprint's centre of each vehicle seen, in world. `map.csv`: road
landmarks and lane points in world, with their epoch and lane (-1: of none). `frames.csv`: a line a frame, with its
statuses. `summary.json`: counts. `bev.png`: all of it from above. `README.txt`: how far to believe it, and what each
file is. Where a new epoch begins TUM files carry a comment; KITTI rows go on from the last pose.
"""

from __future__ import annotations

import math
from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self, TextIO

import msgspec
import numpy as np
import scipy.spatial.transform  # noqa: F401  # at the start of a drive, not with its first frame (trajectory.py)

from birdslam.geometry.camera import Camera
from birdslam.outputs.bev_picture import draw
from birdslam.outputs.final_trajectories import EGO_FILES
from birdslam.outputs.line_map import LineMap
from birdslam.outputs.placed import AROUND_FILES, PLACES_FILE, ROAD_IN_MAP, write_around
from birdslam.outputs.plain_words import DriveCounts, LengthsBy, readme, verdict
from birdslam.outputs.scene_recorder import MAX_POSES, MAX_TRACKS, SceneRecorder, Thinned
from birdslam.trajectory import CameraTrajectory, JoinedTrajectory, Transform, ego_pose, kitti_row, tum_row
from birdslam.types import INVALIDATING, Attitude, Estimate, MapUpdate, Status, VehicleEstimate

FILLED_FRAMES = 10_000  # a longer gap in the frame numbers is a new source, not dropped frames
FRAMES_FILE = "frames.csv"
FRAME_COLUMNS = ("frame", "t_s", "epoch", "x_m", "y_m", "yaw_rad", "speed_mps", "scale_sigma_rel", "valid", "status")
FILES = {  # what README.txt says of each that is there
    "summary.json": "all counts, the configuration and the versions",
    "bev.png": "the drive from above",
    "ego.tum.txt": "the car's way: time, place and attitude in metres, a line a frame",
    "frames.csv": "a line a frame: place, speed, how sure a metre is, whether it is valid, and each status",
    "report.html": "all of it to look at, in any browser",
    "ego.kitti.txt": "the same as KITTI has it: the camera's poses",
    "ego.final.tum.txt": "the car's way, smoothed when the drive was over",
    "tracks": "the way of each other vehicle, as ego.tum.txt; ID.final.tum.txt: smoothed",
    "map.csv": "points of the road and of the lanes, in metres",
    "map.geojson": "lane lines and road edges as polylines, in metres",
    PLACES_FILE: "where the car was in the map and on Earth, a line a metre, as all is known in the end",
    ROAD_IN_MAP: "map.geojson and map.csv in the map's metres",
    "road.geojson": "the road's lines on Earth; road.gpx and road.kml too",
    "tracks.geojson": "the ways of other vehicles on Earth; tracks.gpx and tracks.kml too",
    "camera.toml": "the camera as the first pass found it, for `--camera` next time",
    "logs": "what each process said",
}


class ResultsError(ValueError):
    """Results can't be written; the message names the directory and says why."""


def claim_directory(directory: Path) -> None:
    """Make the directory and see that it can be written to. Raises ResultsError where not."""
    probe = directory / ".writable"
    try:
        directory.mkdir(parents=True, exist_ok=True)
        probe.touch()
        probe.unlink()
    except OSError as error:
        reason = "is a file" if directory.is_file() else error.strerror
        raise ResultsError(f"output directory {directory}: {reason}") from None


def write_json(path: Path, report: object) -> None:
    """Writes structs, or lists of them, for people to read too."""
    path.write_bytes(msgspec.json.format(msgspec.json.encode(report), indent=2) + b"\n")


class Recorder:
    """Writes the results of one drive to a directory as they come; bounded in memory whatever its length.

    The mount of `trajectory.py` is the camera's calibrated ground plane, as for who integrates `Estimate.attitude`.
    A context, so that its files are closed where a run fails; `finish` ends a run that did not.
    Raises ResultsError where the directory can't be written to; results of an earlier run in it are replaced.
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
                old.unlink(missing_ok=True)  # stale tracks beside new ones would be taken for this run's
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
        self._ends_unreadable = False  # the newest picture was damaged or missing
        self._invalid_by: Counter[str] = Counter()
        self._path_m = self._valid_path_m = 0.0
        self._sigmas = Thinned(1, MAX_POSES)  # of the scale, in valid frames
        self._last: Estimate | None = None
        self._epoch: int | None = None
        self._epoch_count = 0
        self._scene = SceneRecorder()
        self._tracks: dict[int, tuple[str, int]] = {}  # of the vehicles seen last: the comment on its class, its epoch
        self._track_count = 0

    def _open(self, name: str) -> TextIO:
        return self._files.enter_context((self._directory / name).open("w", encoding="ascii", buffering=1))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *failure: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the files; what was added stays in them. `finish` does it too."""
        self._files.close()

    def add(self, estimate: Estimate) -> None:
        """One frame's estimate. The last record of a run, END_OF_SOURCE, is no frame and leaves no row."""
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
        self._tum.write(tum_row(estimate.t_source_ns, self._ego.add(estimate.epoch, pose)) + "\n")
        self._write_row(estimate, pose)
        self._scene.add(estimate)
        self._lines.add(estimate, self._scene.T_picture_world)
        for vehicle in estimate.road_users:
            if vehicle.age_ns == 0:
                self._write_vehicle(estimate, vehicle)
        self._last = estimate

    def add_map(self, update: MapUpdate) -> None:
        """What the map gained."""
        for kind, points, lanes in (("landmark", update.landmarks_m, ()), ("lane", update.lanes_m, update.lane_ids)):
            self._map.writelines(
                f"{update.epoch},{kind},{x_m:.3f},{y_m:.3f},{lane}\n"
                for (x_m, y_m), lane in zip(points, lanes or (-1,) * len(points), strict=True)
            )
        if update.epoch == self._epoch:  # of an older epoch: its place is not known any more
            self._scene.add_map(update)

    def finish(self, summary: dict[str, Any], lengths_by: LengthsBy | None = None) -> list[str]:
        """Write summary.json (`summary` over the recorder's own counts; a number that is not finite becomes null),
        bev.png and README.txt, and close the files; gives the verdict on the drive (plain_words.py), a sentence each.

        `lengths_by`: what the camera's height and lens rest on; None: what is stated of them.
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
        write_around(self._directory)  # what is made of other files comes after what is nowhere else
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
        """Of a camera whose file says how sure it is, but not why."""
        sigma_rel = self._camera.scale_sigma_rel
        return LengthsBy(height_sigma_rel=sigma_rel)

    def _begin_epoch(self, estimate: Estimate) -> None:
        if self._last is not None:
            self._tum.write(f"# epoch {estimate.epoch}: a new world frame begins; its poses continue at the last one\n")
        self._epoch = estimate.epoch
        self._epoch_count += 1

    def _write_row(self, estimate: Estimate, T_world_ego: Transform) -> None:
        if 0 < estimate.frame_id - self._next_row <= FILLED_FRAMES:
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
            lines.append("# z is the height of the road under the ego: a vehicle's own is not estimated")
        if known is not None and known[1] != estimate.epoch:
            lines.append(f"# epoch {estimate.epoch}: a new world frame begins")
        described = f"# class {vehicle.label}, length_m {vehicle.length_m:.1f}, width_m {vehicle.width_m:.1f}"
        if known is None or described != known[0]:
            lines.append(described)
        pose = ego_pose(vehicle.T_world_vehicle, Attitude(z_m=estimate.attitude.z_m))
        lines.append(tum_row(estimate.t_source_ns, pose))
        with path.open("a", encoding="ascii", errors="backslashreplace") as file:  # so many tracks, so few descriptors
            file.write("\n".join(lines) + "\n")
        self._tracks[vehicle.vehicle] = described, estimate.epoch  # the one seen last stands last
        if len(self._tracks) > MAX_TRACKS:
            del self._tracks[next(iter(self._tracks))]


def _plain(value: object) -> object:
    """What JSON does not know: numpy's numbers and arrays, paths."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    return str(value)
