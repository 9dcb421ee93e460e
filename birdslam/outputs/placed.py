"""Writes the ego poses of a drive in the map and on Earth, and transforms its lines and tracks with them.

`places.csv` has one row per metre, with the final poses of the drive. An observed point moves with the nearest row.
`road.map.geojson` holds lines and points in map coordinates; `road` and `tracks` (.geojson, .gpx, .kml) are in WGS 84,
if the drive is georeferenced.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from scipy.spatial import cKDTree

from birdslam.geometry.arrays import Floats, Ints
from birdslam.geometry.se2 import SE2
from birdslam.outputs.earth_files import SUFFIXES, GeoLine, write_geo_lines
from birdslam.types import NS_PER_S

PLACES_FILE, ROAD_IN_MAP = "places.csv", "road.map.geojson"
COLUMNS = (
    *("t_s", "epoch", "odom_x_m", "odom_y_m", "odom_yaw_rad", "map_x_m", "map_y_m", "map_yaw_rad"),
    *("latitude_deg", "longitude_deg", "yaw_from_east_rad", "earth_over_map"),
)
AROUND_FILES = (PLACES_FILE, ROAD_IN_MAP, *(f"{name}{suffix}" for name in ("road", "tracks") for suffix in SUFFIXES))
MAX_FEATURE_POINTS = 50_000
TIME_MARGIN_S = 5.0  # before and after the observation of a line


@dataclass(frozen=True)
class Place:
    """The ego pose at one time: in the odometry world of its epoch, in the map, and on Earth if known."""

    t_source_ns: int
    epoch: int
    T_odom_ego: SE2
    T_map_ego: SE2
    earth: tuple[float, float, float, float] | None = None  # the last four COLUMNS


def write_places(directory: Path, places: Sequence[Place]) -> None:
    """Writes places.csv. Raises OSError."""
    with (directory / PLACES_FILE).open("w", encoding="ascii", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(COLUMNS)
        for place in places:
            poses = [f"{v:.4f}" for T in (place.T_odom_ego, place.T_map_ego) for v in (T.x_m, T.y_m, T.yaw_rad)]
            earth = ["", "", "", ""] if place.earth is None else [f"{number:.9g}" for number in place.earth]
            if place.earth is not None:
                earth[:2] = [f"{number:.8f}" for number in place.earth[:2]]
            rows.writerow([f"{place.t_source_ns / NS_PER_S:.6f}", str(place.epoch), *poses, *earth])


def write_around(directory: Path) -> list[str]:
    """Writes the road and the tracks in map and Earth coordinates; returns the file names. Raises OSError."""
    try:
        rows = (directory / PLACES_FILE).read_text(encoding="utf-8").splitlines()[1:]
    except FileNotFoundError:
        return []
    if not rows:  # the drive was never localised
        return []
    places = _Places(np.genfromtxt(rows, delimiter=",", ndmin=2))
    lines = list(_lines(directory / "map.geojson"))
    with (directory / ROAD_IN_MAP).open("wb") as file:  # streamed: a long drive has millions of points
        file.write(b'{"type":"FeatureCollection","birdslam":{"metres_of":"the map"},"features":[')
        for number, feature in enumerate(_in_map(places, lines, directory / "map.csv")):
            file.write(b"," * (number > 0) + msgspec.json.encode(feature))
        file.write(b"]}\n")
    written = [ROAD_IN_MAP]
    if places.on_earth:
        road = [
            GeoLine(each.name, places.degrees(each.points_m, each.epoch, *each.seen_s), (), each.properties)
            for each in lines
        ]
        tracks = [
            GeoLine(path.name.partition(".")[0], places.degrees_at(rows), [round(t * NS_PER_S) for t in rows[:, 0]])
            for path in sorted((directory / "tracks").glob("*.tum.txt"))
            if not path.name.endswith(".final.tum.txt")
            for rows in [_tum(path)]
        ]
        for name, geo_lines in (("road", road), ("tracks", tracks)):
            for suffix in SUFFIXES:
                write_geo_lines(directory / f"{name}{suffix}", geo_lines)
            written.append(f"{name}.geojson")
    return written


def _in_map(places: _Places, lines: Sequence[_Line], points: Path) -> Iterator[dict[str, object]]:
    """Yields the lines and points as GeoJSON features in map coordinates."""
    for line in lines:
        xy_m = places.in_map(line.points_m, line.epoch, *line.seen_s)
        geometry = {"type": "LineString", "coordinates": xy_m.round(3).tolist()}
        yield {"type": "Feature", "geometry": geometry, "properties": line.properties}
    for kind, epoch, points_m in _points(points):
        geometry = {"type": "MultiPoint", "coordinates": places.in_map(points_m, epoch).round(3).tolist()}
        yield {"type": "Feature", "geometry": geometry, "properties": {"kind": kind, "epoch": epoch}}


@dataclass(frozen=True)
class _Line:
    """A polyline (N, 2) of map.geojson with its properties."""

    points_m: Floats
    epoch: int
    seen_s: tuple[float, float]
    name: str
    properties: dict[str, float | int | str]


class _Places:
    """The rows of places.csv (N, 12), with k-d trees, because rows and points grow with the drive."""

    def __init__(self, table: Floats) -> None:
        self._t_s, self._epoch = table[:, 0], table[:, 1]
        self._odom, self._map, self._earth = table[:, 2:5], table[:, 5:8], table[:, 8:]
        self._times = cKDTree(table[:, :1])
        self.on_earth = bool(np.isfinite(self._earth).all())

    def _from_ego(self, points_m: Floats, rows: Ints) -> Floats:
        """Transforms points (N, 2) from the odometry world to the ego frame of their rows."""
        x, y, yaw = self._odom[rows].T
        p, (c, s) = points_m - np.column_stack([x, y]), (np.cos(yaw), np.sin(yaw))
        return np.column_stack([c * p[:, 0] + s * p[:, 1], -s * p[:, 0] + c * p[:, 1]])

    def _nearest(self, points_m: Floats, epoch: int, from_s: float, to_s: float) -> Ints:
        """Returns the nearest row (N,) to each point: in the time interval, or else in the epoch, or else of all."""
        usable = (self._epoch == epoch) & (self._t_s > from_s - TIME_MARGIN_S) & (self._t_s < to_s + TIME_MARGIN_S)
        rows = np.flatnonzero(usable)
        if not len(rows):
            rows = np.flatnonzero(self._epoch == epoch)
        if not len(rows):
            rows = np.arange(len(self._t_s))
        out: Ints = rows[cKDTree(self._odom[rows, :2]).query(points_m)[1]]
        return out

    def in_map(self, points_m: Floats, epoch: int, from_s: float = -np.inf, to_s: float = np.inf) -> Floats:
        rows = self._nearest(points_m, epoch, from_s, to_s)
        return _rotated(self._from_ego(points_m, rows), self._map[rows, 2]) + self._map[rows, :2]

    def degrees(self, points_m: Floats, epoch: int, from_s: float, to_s: float) -> Floats:
        return self._degrees(points_m, self._nearest(points_m, epoch, from_s, to_s))

    def degrees_at(self, timed: Floats) -> Floats:
        """Returns latitude and longitude (N, 2) of rows of time, x and y."""
        return self._degrees(timed[:, 1:3], self._times.query(timed[:, :1])[1])

    def _degrees(self, points_m: Floats, rows: Ints) -> Floats:
        import pymap3d  # an optional dependency

        latitude_deg, longitude_deg, yaw_rad, scale = self._earth[rows].T
        east, north = (scale[:, None] * _rotated(self._from_ego(points_m, rows), yaw_rad)).T
        lat, lon, _ = pymap3d.enu2geodetic(east, north, np.zeros(len(east)), latitude_deg, longitude_deg, 0.0)
        return np.column_stack([np.atleast_1d(lat), np.atleast_1d(lon)])


def _rotated(p_m: Floats, yaw_rad: Floats) -> Floats:
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.column_stack([c * p_m[:, 0] - s * p_m[:, 1], s * p_m[:, 0] + c * p_m[:, 1]])


def _lines(path: Path) -> Iterator[_Line]:
    if path.is_file():
        for feature in json.loads(path.read_text("ascii"))["features"]:
            points, entries = np.array(feature["geometry"]["coordinates"], np.float64), feature["properties"]
            properties = {key: value for key, value in entries.items() if isinstance(value, int | float | str)}
            seen_s = entries["first_seen_s"], entries["last_seen_s"]
            yield _Line(points, entries["epoch"], seen_s, f"{entries['kind']} {entries['line']}", properties)


def _points(path: Path) -> Iterator[tuple[str, int, Floats]]:
    """Yields the points (N, 2) of map.csv by kind and epoch, at most MAX_FEATURE_POINTS at a time."""
    found: dict[tuple[str, int], list[tuple[float, float]]] = {}
    if path.is_file():
        with path.open(encoding="ascii", newline="") as file:
            for row in csv.DictReader(file):
                key = row["kind"], int(row["epoch"])
                points = found.setdefault(key, [])
                points.append((float(row["x_m"]), float(row["y_m"])))
                if len(points) == MAX_FEATURE_POINTS:
                    yield *key, np.array(found.pop(key))
    for (kind, epoch), points in found.items():
        yield kind, epoch, np.array(points)


def _tum(path: Path) -> Floats:
    """Returns rows (N, 3) of time, x and y."""
    return np.loadtxt(path, ndmin=2)[:, :3]
