"""Tables of vehicle speeds with named columns, as written by loggers and GPS receivers."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path

from birdslam.loops.gnss.earth import is_on_earth
from birdslam.sources.recording import DatasetError
from birdslam.types import NS_PER_S, SpeedReading

# Column -> quantity and factor to our unit
_COLUMNS: Mapping[str, tuple[str, float]] = {
    **dict.fromkeys(("time_s", "t_s", "time", "t", "timestamp_s", "seconds"), ("time", 1.0)),
    **dict.fromkeys(("speed_mps", "speed", "velocity_mps", "v_mps"), ("speed", 1.0)),
    **dict.fromkeys(("speed_kmh", "speed_kph", "velocity_kmh"), ("speed", 1.0 / 3.6)),
    **dict.fromkeys(("speed_mph",), ("speed", 0.44704)),
    **dict.fromkeys(("sigma_mps", "speed_sigma_mps"), ("sigma", 1.0)),
    **dict.fromkeys(("yaw_rate_radps",), ("yaw_rate", 1.0)),
    **dict.fromkeys(("yaw_rate_sigma_radps",), ("yaw_rate_sigma", 1.0)),
    **dict.fromkeys(("latitude_deg", "latitude", "lat"), ("latitude", 1.0)),
    **dict.fromkeys(("longitude_deg", "longitude", "lon", "lng"), ("longitude", 1.0)),
}
GPS_SIGMA_MPS = 0.3  # of a receiver's speed: often whole km/h, some tenths of a second late
_FIX_SIGMA_M = 1.0  # of the distance between two fixes: five decimals of a degree
_YAW_RATE_SIGMA_RADPS = 0.01
_SPEED_SIGMA_MPS = 0.1
_Row = tuple[int, dict[str, float]]  # line number, values by quantity
_EARTH_M = 6_371_000.0
MAX_S = 9e9  # of a time: ns since 1970 exceed int64 above this
_MIN_GAP_NS = 250_000_000  # larger gaps between readings are interpolated
_MAX_GAP_NS = 3 * NS_PER_S  # larger gaps are not interpolated
_INTERPOLATED_NS = 100_000_000


def names_columns(line: str) -> bool:
    """Whether a line is a table's header: it names a time and has no numbers."""
    return any(_COLUMNS.get(word, ("", 0.0))[0] == "time" for word in _cells(line.lower()))


def table_readings(path: Path, lines: Sequence[tuple[int, str]]) -> Iterator[tuple[int, SpeedReading]]:
    """Line number and reading of each line (number, text) below the header. Without a speed column, from GPS fixes.

    Raises DatasetError.
    """
    head = _cells(lines[0][1].lower())
    columns = {_COLUMNS[word][0]: (at, _COLUMNS[word][1]) for at, word in enumerate(head) if word in _COLUMNS}
    by_fixes = "speed" not in columns
    if by_fixes and not {"latitude", "longitude"} <= set(columns):
        raise DatasetError(f"{path}: line {lines[0][0]}: has no column of speed (speed_mps, speed_kmh) or GPS fixes")
    rows: list[_Row] = []
    for number, text in lines[1:]:
        cells = _cells(text)
        try:
            rows.append((number, {name: float(cells[at]) * unit for name, (at, unit) in columns.items() if cells[at]}))
            row = rows[-1][1]
            is_place = is_on_earth(row.get("latitude", 0.0), row.get("longitude", 0.0))
            if not abs(row.get("time", math.inf)) < MAX_S or not is_place:
                raise ValueError
        except (ValueError, IndexError):
            raise DatasetError(f"{path}: line {number} does not match the header: {text[:40]!r}") from None
    if by_fixes:
        yield from _interpolate(_fix_speeds(rows))
    elif "latitude" in columns:
        yield from _interpolate(_stated_speeds(rows, GPS_SIGMA_MPS))
    else:
        yield from _stated_speeds(rows, _SPEED_SIGMA_MPS)


def fix_speeds(fixes: Sequence[tuple[int, float, float, float | None]]) -> Iterator[tuple[int, SpeedReading]]:
    """Line number and reading from GNSS fixes: time in ns, latitude and longitude in degrees, and speed or None.

    If fewer than half state a speed, the speeds are those between the fixes.
    """
    rows: list[_Row] = []
    for number, (t_ns, latitude_deg, longitude_deg, speed_mps) in enumerate(fixes, start=1):
        row = {"time": t_ns / NS_PER_S, "latitude": latitude_deg, "longitude": longitude_deg}
        rows.append((number, row if speed_mps is None else {**row, "speed": speed_mps}))
    stated = sum("speed" in row for _, row in rows)
    yield from _interpolate(_stated_speeds(rows, GPS_SIGMA_MPS) if 2 * stated > len(rows) else _fix_speeds(rows))


def _stated_speeds(rows: Sequence[_Row], sigma_mps: float) -> Iterator[tuple[int, SpeedReading]]:
    for number, row in rows:
        if "speed" in row:
            yield (
                number,
                SpeedReading(
                    t_ns=round(row["time"] * NS_PER_S),
                    speed_mps=row["speed"],
                    sigma_mps=row.get("sigma", sigma_mps),
                    yaw_rate_radps=row.get("yaw_rate"),
                    yaw_rate_sigma_radps=row.get("yaw_rate_sigma", _YAW_RATE_SIGMA_RADPS * ("yaw_rate" in row)),
                ),
            )


def _interpolate(readings: Iterable[tuple[int, SpeedReading]]) -> Iterator[tuple[int, SpeedReading]]:
    """Interpolates readings of a 1 Hz GPS linearly to 10 Hz.

    The sigma includes the deviation from the line at an acceleration of 3 m/s2: an eighth of that times the interval.
    """
    before: SpeedReading | None = None
    for number, after in readings:
        apart_ns = 0 if before is None else after.t_ns - before.t_ns
        if before is not None and _MIN_GAP_NS < apart_ns <= _MAX_GAP_NS:
            steps = math.ceil(apart_ns / _INTERPOLATED_NS)
            off_mps = 3.0 / 8.0 * apart_ns / NS_PER_S
            for k in range(1, steps):
                yield (
                    number,
                    SpeedReading(
                        t_ns=before.t_ns + apart_ns * k // steps,
                        speed_mps=before.speed_mps + (after.speed_mps - before.speed_mps) * k / steps,
                        sigma_mps=math.hypot(max(before.sigma_mps, after.sigma_mps), off_mps),
                    ),
                )
        yield number, after
        before = after


def _fix_speeds(rows: Sequence[_Row]) -> Iterator[tuple[int, SpeedReading]]:
    """The mean speed between two fixes, at the middle of their times."""
    fixes = [(number, row) for number, row in rows if {"latitude", "longitude"} <= set(row)]
    for (_, a), (number, b) in pairwise(fixes):
        apart_s = b["time"] - a["time"]
        if apart_s <= 0.0:
            continue
        north_m = math.radians(b["latitude"] - a["latitude"]) * _EARTH_M
        east_m = math.radians(b["longitude"] - a["longitude"]) * _EARTH_M * math.cos(math.radians(a["latitude"]))
        yield (
            number,
            SpeedReading(
                t_ns=round(0.5 * (a["time"] + b["time"]) * NS_PER_S),
                speed_mps=math.hypot(north_m, east_m) / apart_s,
                sigma_mps=max(GPS_SIGMA_MPS, _FIX_SIGMA_M / apart_s),
            ),
        )


def _cells(line: str) -> list[str]:
    return [cell.strip().strip('"') for cell in line.split(",")] if "," in line else line.split()
