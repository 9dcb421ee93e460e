"""Vehicle speeds for a recording as a text file.

A line has a time in s in the recording's clock and a speed in m/s, then optionally the 1-sigma of the speed in m/s, a
yaw rate in rad/s (counter-clockwise) and its 1-sigma; separated by commas (a cell may be empty) or blanks, with `#`
comments. With a header line the columns may have any order: speed_tables.py.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.loops.gnss.files import GnssError, read_fixes
from birdslam.sources.recording import DatasetError, Recording, check_times
from birdslam.sources.speed_log import SpeedLog
from birdslam.sources.speed_tables import MAX_S, fix_speeds, names_columns, table_readings
from birdslam.types import NS_PER_S, SpeedReading

# 1-sigma if a file states none: some steps of a wheel speed message (often 0.1 km/h), and the bias of a stability
# control's gyroscope (0.6 degrees per second)
SIGMA_MPS = 0.1
YAW_RATE_SIGMA_RADPS = 0.01

_MAX_COLUMNS = 5


def read_speeds(path: Path, begin_ns: int = 0) -> SpeedLog:
    """Readings of a file in its order, unchecked: the method rejects faulty ones (NaN, times that do not increase).

    `begin_ns`: the recording's first time, for tracks in UTC. Raises DatasetError for a file that is unreadable or
    empty, and for an invalid line.
    """
    readings = [reading for _, reading in _lines(path, begin_ns)]
    if not readings:
        raise DatasetError(f"{path}: no speeds")
    return SpeedLog(readings)


def read_speed_curve(path: Path) -> Floats:
    """(N, 2) time in s, increasing, and speed in m/s. Raises DatasetError for an implausible line."""
    lines = list(_lines(path))
    for number, reading in lines:
        if not 0.0 <= reading.speed_mps < 150.0:
            t_s = reading.t_ns / NS_PER_S
            raise DatasetError(
                f"{path}: line {number}: {reading.speed_mps:g} m/s at {t_s:g} s is not the speed of a car"
            )
    for (_, before), (number, after) in pairwise(lines):
        if after.t_ns <= before.t_ns:
            raise DatasetError(f"{path}: line {number} is not later than the previous time")
    if len(lines) < 2:
        raise DatasetError(f"{path}: has {len(lines)} speeds, needs 2")
    return np.array([(reading.t_ns / NS_PER_S, reading.speed_mps) for _, reading in lines])


def of_sequence(path: Path, name: str) -> Path:
    """The file of a sequence: NAME.txt in a directory."""
    return path / f"{name}.txt" if path.is_dir() else path


def with_speeds(recording: Recording, path: Path) -> Recording:
    """Replaces the recording's speeds by those of a file.

    Raises DatasetError, also if all its times are outside the recording's (another clock).
    """
    first = next(iter(recording.frames()), None)
    log = read_speeds(path, 0 if first is None else first.t_source_ns)
    times = [reading.t_ns for reading in log.readings]
    check_times(recording, path, min(times), max(times))
    recording.speeds = log
    return recording


def _lines(path: Path, begin_ns: int = 0) -> Iterator[tuple[int, SpeedReading]]:
    """Number and reading of each line with a reading. Raises DatasetError."""
    try:
        data = path.read_bytes()
        text = data.decode("utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path}: can't be read: {getattr(error, 'strerror', None) or 'not UTF-8'}") from None
    if text.lstrip()[:1] in ("<", "$", "["):
        yield from _of_track(path, data, begin_ns)
        return
    lines = text.splitlines()
    texts = [(number, line, line.partition("#")[0].strip()) for number, line in enumerate(lines, start=1)]
    texts = [entry for entry in texts if entry[2]]
    if texts and names_columns(texts[0][2]):
        yield from table_readings(path, [(number, text) for number, _, text in texts])
        return
    for number, line, text in texts:
        try:
            yield number, _reading(text.split(",") if "," in text else text.split())
        except ValueError:
            raise DatasetError(
                f"{path}: line {number} is not a time in s and a speed in m/s (optionally sigma, yaw rate and its "
                f"sigma): {line[:40]!r}"
            ) from None


def _of_track(path: Path, data: bytes, begin_ns: int) -> Iterator[tuple[int, SpeedReading]]:
    """Speeds of a GPX or NMEA track: stated ones, else those between its fixes."""
    try:
        fixes = read_fixes(data, str(path), begin_ns)
    except GnssError as error:
        raise DatasetError(str(error)) from None
    yield from fix_speeds([(fix.t_source_ns, fix.latitude_deg, fix.longitude_deg, fix.speed_mps) for fix in fixes])


def _reading(words: list[str]) -> SpeedReading:
    """Parses a reading. Raises ValueError."""
    t_s, speed_mps, *rest = (float(word) if word.strip() else None for word in words)
    if t_s is None or speed_mps is None or not abs(t_s) < MAX_S or len(words) > _MAX_COLUMNS:
        raise ValueError
    sigma_mps, yaw_rate_radps, yaw_rate_sigma_radps = (*rest, None, None, None)[:3]
    if yaw_rate_radps is not None and yaw_rate_sigma_radps is None:
        yaw_rate_sigma_radps = YAW_RATE_SIGMA_RADPS
    return SpeedReading(
        t_ns=round(t_s * NS_PER_S),
        speed_mps=speed_mps,
        sigma_mps=SIGMA_MPS if sigma_mps is None else sigma_mps,
        yaw_rate_radps=yaw_rate_radps,
        yaw_rate_sigma_radps=yaw_rate_sigma_radps or 0.0,
    )
