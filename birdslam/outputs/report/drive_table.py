"""A drive's results as its directory has them, for the report: frames, tracks and map in one plane."""

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

PEOPLE = frozenset({"pedestrian", "person", "cyclist", "rider", "bicycle"})
FILES = {  # what the page hands out, where it is there
    "ego.tum.txt": "the ego's way, TUM lines",
    "ego.kitti.txt": "the ego's way, KITTI rows",
    "ego.final.tum.txt": "smoothed, TUM lines",
    "map.tum.txt": "the way in the map, TUM lines",
    "ego.gpx": "the way on Earth, GPX",
    "ego.geojson": "the way on Earth, GeoJSON",
    "frames.csv": "a line a frame",
    "map.geojson": "the road's lines",
    "road.geojson": "the road's lines on Earth, GeoJSON",
    "tracks.geojson": "other vehicles' ways on Earth, GeoJSON",
}
MOST_FILE_BYTES = 1_500_000  # of one that the page holds
MOST_TRACKS, FEWEST_ROWS = 150, 5  # a track of fewer frames is mostly a false alarm
MOST_MAP_POINTS = 6000


@dataclass(frozen=True)
class TrackTable:
    """One road user: its number and class, times (N,) in s and places (N, 2) in the plane."""

    name: str
    label: str
    t_s: Floats
    xy_m: Floats

    @property
    def is_person(self) -> bool:
        """Whether it is a pedestrian or a cyclist."""
        return self.label in PEOPLE


@dataclass(frozen=True)
class DriveTable:
    """Of each frame: its number, time in s, place (N, 2), heading, speed, 1-sigma of a metre, validity, statuses.

    The plane is the world of the first epoch; where an epoch begins, it begins where the one before was left.
    """

    name: str
    frame: Ints
    t_s: Floats
    xy_m: Floats
    yaw_rad: Floats
    speed_mps: Floats  # NaN where an epoch begins
    scale_sigma_rel: Floats
    valid: Bools
    statuses: list[tuple[str, ...]]
    tracks: list[TrackTable]
    lanes_m: Floats  # (M, 2)
    lines: list[tuple[str, Floats]]  # kind of each of the road's lines, and its vertices (K, 2)
    earth_deg: Floats | None  # (K, 2) latitude and longitude along the way; None: no GNSS was there
    files: dict[str, str]  # text of those of FILES that are there
    landmarks_m: Floats
    summary: dict[str, Any]
    camera: str  # the text of camera.toml; "": there is none


def read_drive(directory: Path) -> DriveTable:
    """The results in a directory of `birdslam run`. Raises ResultsError where they are none, or torn."""
    try:
        summary = json.loads((directory / "summary.json").read_text(encoding="utf-8"))
        with (directory / FRAMES_FILE).open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
        if not rows or tuple(rows[0]) != FRAME_COLUMNS:
            raise ResultsError(f"{directory / FRAMES_FILE}: holds no frames")
        numbers = np.array([[float(row[name] or "nan") for name in FRAME_COLUMNS[:9]] for row in rows])
        to_plane = _epochs(numbers)
        poses = [to_plane[int(row[2])] @ SE2(*row[3:6]) for row in numbers]
        lanes, landmarks = (_map_points(directory / "map.csv", kind, to_plane) for kind in ("lane", "landmark"))
        camera, tracks = directory / "camera.toml", _tracks(directory / "tracks", to_plane, numbers[0, 1])
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
            tracks=sorted(tracks, key=lambda track: -len(track.t_s))[:MOST_TRACKS],
            lanes_m=lanes,
            lines=_lines(directory / "map.geojson", to_plane),
            earth_deg=_earth(directory / "ego.geojson"),
            files=_files(directory),
            landmarks_m=landmarks,
            summary=summary,
            camera=camera.read_text(encoding="utf-8") if camera.is_file() else "",
        )
    except FileNotFoundError as error:
        raise ResultsError(f"{directory}: no results of `birdslam run` ({error.filename} is missing)") from None
    except OSError as error:
        raise ResultsError(f"{directory}: {error.strerror}: {error.filename}") from None
    except (ValueError, KeyError, TypeError) as error:
        raise ResultsError(f"{directory}: its results are torn: {error}") from None


def _epochs(numbers: Floats) -> dict[int, SE2]:
    """Of each epoch its world in the plane: its first pose lies on the last one of the epoch before."""
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
    every = max(1, -(-sum(map(len, points)) // MOST_MAP_POINTS))
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


def _earth(path: Path) -> Floats | None:
    if not path.is_file():
        return None
    (way,) = json.loads(path.read_text(encoding="utf-8"))["features"]
    return np.array(way["geometry"]["coordinates"], np.float64)[:, ::-1]


def _files(directory: Path) -> dict[str, str]:
    there = {name: directory / name for name in FILES}
    return {
        name: path.read_text(encoding="utf-8")
        for name, path in there.items()
        if path.is_file() and path.stat().st_size <= MOST_FILE_BYTES
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
        if len(t_s) >= FEWEST_ROWS:
            yield TrackTable(path.name.removesuffix(".tum.txt"), label, np.array(t_s), np.array(xy_m))
