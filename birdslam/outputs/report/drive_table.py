"""Reads the results of a drive for the report: frames, tracks and map in one plane."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from birdslam.geometry.arrays import Bools, Floats, Ints
from birdslam.geometry.se2 import SE2
from birdslam.outputs.drive_files import FRAME_COLUMNS, FRAMES_FILE, ResultsError
from birdslam.outputs.placed import PLACES_FILE

PEOPLE = frozenset({"pedestrian", "person", "cyclist", "rider", "bicycle"})
FILES = {  # downloads of the page
    "ego.tum.txt": "ego trajectory, TUM format",
    "ego.kitti.txt": "camera poses, KITTI format",
    "ego.final.tum.txt": "final ego trajectory, TUM format",
    "map.tum.txt": "trajectory in the map, TUM format",
    "ego.gpx": "trajectory on Earth, GPX",
    "ego.geojson": "trajectory on Earth, GeoJSON",
    "frames.csv": "position, speed, sigma and statuses of each frame",
    "map.geojson": "lane lines and road edges",
    "road.geojson": "lane lines and road edges on Earth, GeoJSON",
    "tracks.geojson": "trajectories of other vehicles on Earth, GeoJSON",
}
MAX_FILE_BYTES = 1_500_000  # larger files are not in the page
MAX_TRACKS, MIN_TRACK_ROWS = 150, 5  # a shorter track is mostly a false alarm
MAX_MAP_POINTS = 6000
MAX_EARTH_LINES = 400  # road lines, and tracks


@dataclass(frozen=True)
class TrackTable:
    """One road user: number and class, times (N,) in s and positions (N, 2) in the plane."""

    name: str
    label: str
    t_s: Floats
    xy_m: Floats

    @property
    def is_person(self) -> bool:
        """Whether it is a pedestrian or a cyclist."""
        return self.label in PEOPLE


@dataclass(frozen=True)
class EarthTable:
    """The drive on Earth: times (K,) in s, latitude and longitude (K, 2) in degrees, lines (M, 2)."""

    t_s: Floats
    degrees: Floats
    road_deg: list[Floats]
    tracks_deg: list[Floats]

    def at(self, t_s: Floats) -> Floats:
        """Interpolates latitude and longitude (N, 2) at these times."""
        return np.column_stack([np.interp(t_s, self.t_s, column) for column in self.degrees.T])


@dataclass(frozen=True)
class DriveTable:
    """Per frame: number, time in s, position (N, 2), heading, speed, scale sigma, validity and statuses.

    The plane is the world of the first epoch. Each epoch starts at the last pose of the previous one.
    """

    name: str
    frame: Ints
    t_s: Floats
    xy_m: Floats
    yaw_rad: Floats
    speed_mps: Floats  # NaN at the start of an epoch
    scale_sigma_rel: Floats
    valid: Bools
    statuses: list[tuple[str, ...]]
    tracks: list[TrackTable]
    lanes_m: Floats  # (M, 2)
    lines: list[tuple[str, Floats]]  # kind and vertices (K, 2) of each line
    earth: EarthTable | None  # None without GNSS
    files: dict[str, str]  # text of the existing FILES
    landmarks_m: Floats
    summary: dict[str, Any]
    camera: str  # in the format of a camera file; "": unknown

    @property
    def step_s(self) -> float:
        """The median interval between two frames."""
        return float(np.median(np.diff(self.t_s))) if len(self.t_s) > 1 else 0.1

    def intervals(self, is_set: Bools) -> list[tuple[int, int]]:
        """Returns begin and end (exclusive) of each run of true values in `is_set` (N,)."""
        edges = np.flatnonzero(np.diff(np.concatenate([[False], is_set, [False]])))
        return [(int(begin), int(end)) for begin, end in edges.reshape(-1, 2)]


def read_drive(directory: Path) -> DriveTable:
    """Reads an output directory of `birdslam run`. Raises ResultsError if results are missing or damaged."""
    try:
        summary = json.loads((directory / "summary.json").read_text(encoding="utf-8"))
        with (directory / FRAMES_FILE).open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
        if not rows or tuple(rows[0]) != FRAME_COLUMNS:
            raise ResultsError(f"{directory / FRAMES_FILE}: has no frames")
        numbers = np.array([[float(row[name] or "nan") for name in FRAME_COLUMNS[:9]] for row in rows])
        to_plane = _epochs(numbers)
        poses = [to_plane[int(row[2])] @ SE2(*row[3:6]) for row in numbers]
        lanes, landmarks = (_map_points(directory / "map.csv", kind, to_plane) for kind in ("lane", "landmark"))
        tracks = _tracks(directory / "tracks", to_plane, numbers[0, 1])
        return DriveTable(
            name=directory.resolve().name,
            frame=numbers[:, 0].astype(np.int64),
            t_s=numbers[:, 1] - numbers[0, 1],
            xy_m=np.array([(pose.x_m, pose.y_m) for pose in poses]),
            yaw_rad=np.array([pose.yaw_rad for pose in poses]),
            speed_mps=numbers[:, 6],
            scale_sigma_rel=numbers[:, 7],
            valid=numbers[:, 8] > 0.5,
            statuses=[tuple(row["status"].split()) for row in rows],
            tracks=sorted(tracks, key=lambda track: -len(track.t_s))[:MAX_TRACKS],
            lanes_m=lanes,
            lines=_lines(directory / "map.geojson", to_plane),
            earth=_earth(directory, numbers[0, 1]),
            files=_files(directory),
            landmarks_m=landmarks,
            summary=summary,
            camera=_camera(directory / "camera.toml", summary),
        )
    except FileNotFoundError as error:
        raise ResultsError(f"{directory}: no results of `birdslam run` ({error.filename} is missing)") from None
    except OSError as error:
        raise ResultsError(f"{directory}: {error.strerror}: {error.filename}") from None
    except (ValueError, KeyError, TypeError) as error:
        raise ResultsError(f"{directory}: the results are damaged: {error}") from None


def _epochs(numbers: Floats) -> dict[int, SE2]:
    """Returns the transform from the world of each epoch to the plane."""
    out: dict[int, SE2] = {}
    last = SE2()
    for row in numbers:
        epoch, pose = int(row[2]), SE2(*row[3:6])
        if epoch not in out:
            out[epoch] = last @ pose.inverse() if out else SE2()
        last = out[epoch] @ pose
    return out


def _map_points(path: Path, kind: str, to_plane: dict[int, SE2]) -> Floats:
    with path.open(encoding="ascii", newline="") as file:
        of_epoch: dict[int, list[tuple[float, float]]] = {}
        for row in csv.DictReader(file):
            if row["kind"] == kind and int(row["epoch"]) in to_plane:
                of_epoch.setdefault(int(row["epoch"]), []).append((float(row["x_m"]), float(row["y_m"])))
    points = [to_plane[epoch] @ np.array(xy) for epoch, xy in of_epoch.items()]
    every = max(1, -(-sum(map(len, points)) // MAX_MAP_POINTS))
    return np.vstack([np.zeros((0, 2)), *points])[::every]


def _lines(path: Path, to_plane: dict[int, SE2]) -> list[tuple[str, Floats]]:
    if not path.is_file():
        return []
    out = []
    for feature in json.loads(path.read_text(encoding="utf-8"))["features"]:
        about, points = feature["properties"], np.array(feature["geometry"]["coordinates"], np.float64)
        if about["epoch"] in to_plane and points.ndim == 2 and points.shape[1] == 2:
            out.append((str(about["kind"]), to_plane[about["epoch"]] @ points))
    return out


def _earth(directory: Path, begin_s: float) -> EarthTable | None:
    path = directory / PLACES_FILE
    if not path.is_file():
        return None
    with path.open(encoding="ascii", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["latitude_deg"]]
    if not rows:
        return None
    table = np.array([[float(row[name]) for name in ("t_s", "latitude_deg", "longitude_deg")] for row in rows])
    road, tracks = (_earth_lines(directory / f"{name}.geojson") for name in ("road", "tracks"))
    return EarthTable(table[:, 0] - begin_s, table[:, 1:], road, tracks)


def _earth_lines(path: Path) -> list[Floats]:
    """Reads latitude and longitude (M, 2) of each line of a GeoJSON file."""
    if not path.is_file():
        return []
    features = json.loads(path.read_text(encoding="utf-8"))["features"]
    return [np.array(each["geometry"]["coordinates"], np.float64)[:, ::-1] for each in features[:MAX_EARTH_LINES]]


def _camera(path: Path, summary: dict[str, Any]) -> str:
    """Returns the camera file of the drive, or the camera of its configuration."""
    if path.is_file():
        return path.read_text(encoding="utf-8")
    configuration = summary.get("configuration")
    camera = configuration.get("camera") if isinstance(configuration, dict) else None
    if not isinstance(camera, dict):
        return ""
    return "".join(f"{name} = {json.dumps(value)}\n" for name, value in camera.items() if value is not None)


def _files(directory: Path) -> dict[str, str]:
    there = {name: directory / name for name in FILES}
    return {
        name: path.read_text(encoding="utf-8")
        for name, path in there.items()
        if path.is_file() and path.stat().st_size <= MAX_FILE_BYTES
    }


def _tracks(directory: Path, to_plane: dict[int, SE2], begin_s: float) -> Iterator[TrackTable]:
    for path in sorted(directory.glob("*.tum.txt")):
        if path.name.endswith(".final.tum.txt"):
            continue
        epoch, label, t_s, xy_m = min(to_plane), "", [], []
        for line in path.read_text(encoding="ascii", errors="replace").splitlines():
            if line.startswith("# epoch "):
                epoch = int(line.split()[2].rstrip(":"))
            elif line.startswith("# class "):
                label = line.removeprefix("# class ").partition(",")[0]
            elif line and not line.startswith("#") and epoch in to_plane:
                t, x, y = (float(word) for word in line.split()[:3])
                placed = to_plane[epoch] @ SE2(x, y, 0.0)
                t_s.append(t - begin_s)
                xy_m.append((placed.x_m, placed.y_m))
        if len(t_s) >= MIN_TRACK_ROWS:
            yield TrackTable(path.name.removesuffix(".tum.txt"), label, np.array(t_s), np.array(xy_m))
