"""GNSS tracks inside films, read by ExifTool: GoPro, Novatek (Viofo and others), BlackVue, Garmin and more.

ExifTool is a program of its own (Debian: libimage-exiftool-perl). Fixes become a GPX track beside the results, which
`--gnss` and `--speed` read like any other.
"""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import msgspec

from birdslam.loops.gnss.earth import is_on_earth
from birdslam.loops.gnss.files import GnssError

FILM = "film"  # `--gnss film`, `--speed film`
TRACK_FILE = "film.gpx"
INSTALL = "ExifTool reads it: apt install libimage-exiftool-perl"
_PROGRAM = "exiftool"
_TAGS = ("GPSLatitude", "GPSLongitude", "GPSSpeed", "GPSSpeedRef", "GPSDateTime", "SampleTime")
_MPS = {"K": 1.0 / 3.6, "M": 0.44704, "N": 0.514444}  # by GPSSpeedRef; ExifTool's default is km/h
_LIMIT_S = 120.0
_DATE_TIME = re.compile(r"(\d{4}):(\d\d):(\d\d) (\d\d):(\d\d):(\d\d)(\.\d+)?(Z|[+-]\d\d:\d\d)?")
_UNKNOWN_DATE = datetime(2000, 1, 1, tzinfo=UTC)  # of a track with times in the film alone


@dataclass(frozen=True)
class FilmFix:
    """A fix: UTC, position in degrees, speed in m/s if the camera states it."""

    utc: datetime
    latitude_deg: float
    longitude_deg: float
    speed_mps: float | None


def is_readable() -> bool:
    """Whether ExifTool is installed."""
    return shutil.which(_PROGRAM) is not None


def read_film(path: Path) -> list[FilmFix]:
    """Reads the fixes of a film in its order, without those of a receiver that has no position. Raises GnssError."""
    if not is_readable():
        raise GnssError(f"{path}: its GNSS track is inside the film; {INSTALL}")
    command = [
        _PROGRAM,
        "-ee3",
        "-json",
        "-n",
        "-G3",
        "-a",
        "-api",
        "LargeFileSupport=1",
        *(f"-{tag}" for tag in _TAGS),
    ]
    try:
        done = subprocess.run([*command, "--", str(path)], capture_output=True, check=False, timeout=_LIMIT_S)
        (tags,) = msgspec.json.decode(done.stdout, type=list[dict[str, Any]])
    except subprocess.TimeoutExpired:
        raise GnssError(f"{path}: ExifTool did not finish in {_LIMIT_S:g} s") from None
    except (msgspec.MsgspecError, ValueError):
        said = done.stderr.decode(errors="replace").strip().splitlines()
        raise GnssError(f"{path}: ExifTool can't read it: {said[0] if said else 'no output'}") from None
    samples: dict[str, dict[str, Any]] = {}
    for name, value in tags.items():
        group, _, tag = name.partition(":")
        if group.startswith("Doc") and value not in (None, ""):
            samples.setdefault(group, {})[tag] = value
    found = (_fix(sample) for sample in samples.values())
    return [fix for fix in found if fix is not None]


def write_gpx(path: Path, fixes: Sequence[FilmFix]) -> None:
    """Writes fixes as a GPX track with speeds. Raises OSError."""
    points = []
    for fix in fixes:
        speed = "" if fix.speed_mps is None else f"<speed>{fix.speed_mps:.3f}</speed>"
        time = fix.utc.isoformat(timespec="milliseconds").replace("+00:00", "Z")
        place = f'lat="{fix.latitude_deg:.8f}" lon="{fix.longitude_deg:.8f}"'
        points.append(f"<trkpt {place}><time>{time}</time>{speed}</trkpt>")
    head = '<?xml version="1.0" encoding="UTF-8"?>\n<gpx version="1.0" creator="birdslam" '
    head += 'xmlns="http://www.topografix.com/GPX/1/0"><trk><trkseg>'
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join([head, *points, "</trkseg></trk></gpx>", ""]), encoding="utf-8")


def track_of_films(films: Sequence[Path], path: Path) -> int:
    """Writes the fixes of films, one after the other, as a GPX track; returns their number. Raises GnssError."""
    fixes = [fix for film in films for fix in read_film(film)]
    if fixes:
        try:
            write_gpx(path, sorted(fixes, key=lambda fix: fix.utc))
        except OSError as error:
            raise GnssError(f"{path}: can't be written: {error.strerror}") from None
    return len(fixes)


def _fix(sample: dict[str, Any]) -> FilmFix | None:
    try:
        latitude, longitude = float(sample["GPSLatitude"]), float(sample["GPSLongitude"])
        speed = float(sample["GPSSpeed"]) if "GPSSpeed" in sample else None
    except (KeyError, TypeError, ValueError):
        return None
    utc = _utc(str(sample.get("GPSDateTime", "")), sample.get("SampleTime"))
    if utc is None or not is_on_earth(latitude, longitude) or (latitude == 0.0 and longitude == 0.0):
        return None
    unit = _MPS.get(str(sample.get("GPSSpeedRef", "K"))[:1].upper(), _MPS["K"])
    return FilmFix(utc, latitude, longitude, None if speed is None or speed < 0.0 else speed * unit)


def _utc(text: str, sample_s: Any) -> datetime | None:
    found = _DATE_TIME.match(text)
    if found is None:
        return _UNKNOWN_DATE + timedelta(seconds=float(sample_s)) if isinstance(sample_s, int | float) else None
    zone = found[8] if found[8] and found[8] != "Z" else "+00:00"
    try:
        second = "{}-{}-{}T{}:{}:{}".format(*found.groups()[:6])
        whole = datetime.fromisoformat(second + zone).astimezone(UTC)
    except (ValueError, OverflowError):
        return None
    return whole + timedelta(seconds=float(found[7] or 0.0))
