"""GNSS tracks of films: in subtitles beside the film (FILM.srt) or in it, or as GoPro, Novatek and others write them.

ExifTool, a program of its own (Debian: libimage-exiftool-perl), reads those inside. Fixes become a GPX track beside the
results, which `--gnss` and `--speed` read like any other.
"""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from birdslam.loops.gnss.earth import is_on_earth
from birdslam.loops.gnss.files import MAX_S, GnssError, read_fixes
from birdslam.loops.gnss.subtitles import cue_fixes
from birdslam.outputs.earth_files import GeoLine, write_geo_lines
from birdslam.types import NS_PER_S

TRACK_FILE = "film.gpx"
INSTALL = "ExifTool reads it: apt install libimage-exiftool-perl"
_PROGRAM = "exiftool"
_TAGS = ("-GPSLatitude", "-GPSLongitude", "-GPSDateTime", "-SampleTime", "-Text")
_LIMIT_S = 120.0
_DATE_TIME = re.compile(r"(\d{4}):(\d\d):(\d\d) (\d\d):(\d\d):(\d\d)(\.\d+)?(Z|[+-]\d\d:\d\d)?")


@dataclass(frozen=True)
class FilmFix:
    """A fix: position in degrees at UTC, or at the time in the film (s) if the camera has no date."""

    latitude_deg: float
    longitude_deg: float
    utc: datetime | None
    t_film_s: float | None = None

    @property
    def t_ns(self) -> int:
        """Time since 1970, or since the start of the film."""
        return round((self.utc.timestamp() if self.utc else self.t_film_s or 0.0) * NS_PER_S)


def is_readable() -> bool:
    """Whether ExifTool is installed."""
    return shutil.which(_PROGRAM) is not None


def read_film(path: Path) -> list[FilmFix]:
    """Reads the fixes of a film in its order, without those of a receiver that has no position. Raises GnssError."""
    if not is_readable():
        raise GnssError(f"{path}: its GNSS track is inside the film; {INSTALL}")
    command = [_PROGRAM, "-ee", "-json", "-n", "-G3", "-api", "LargeFileSupport=1", *_TAGS]
    try:
        done = subprocess.run([*command, "--", str(path)], capture_output=True, check=False, timeout=_LIMIT_S)
    except subprocess.TimeoutExpired:
        raise GnssError(f"{path}: ExifTool did not finish in {_LIMIT_S:g} s") from None
    return fixes_of_tags(done.stdout)


def fixes_of_tags(data: bytes) -> list[FilmFix]:
    """Returns the fixes in ExifTool's JSON of a film, in its order."""
    try:
        (tags,) = msgspec.json.decode(data, type=list[dict[str, Any]])
    except (msgspec.MsgspecError, ValueError):
        return []  # a file that is no film is reported when it is opened
    samples: dict[str, dict[str, Any]] = {}
    for name, value in tags.items():
        group, _, tag = name.partition(":")
        if group.startswith("Doc") and value not in (None, ""):
            samples.setdefault(group, {})[tag] = value
    found = (_fix(sample) for sample in samples.values())
    return [fix for fix in found if fix is not None] or _of_subtitle_track(samples.values())


def _of_subtitle_track(samples: Iterable[dict[str, Any]]) -> list[FilmFix]:
    """The fixes in the texts of a subtitle track."""
    cues = (
        (t_s, str(sample["Text"])) for sample in samples if "Text" in sample and (t_s := _t_film_s(sample)) is not None
    )
    return [
        FilmFix(latitude, longitude, None, t_s)
        for _, (t_s, latitude, longitude, *_) in cue_fixes(cues)
        if is_on_earth(latitude, longitude)
    ]


def track_of_films(films: Sequence[Path], path: Path) -> int:
    """Writes the fixes of films, one after the other, as a GPX track; returns their number, 0 for a single fix.

    Speeds are left out, since their unit differs between cameras. Raises GnssError.
    """
    fixes = [fix for film in films for fix in fixes_beside(film) or read_film(film)]
    if len(films) > 1 and any(fix.utc is None for fix in fixes):
        raise GnssError(f"{films[0].parent}: the fixes inside the films have no date, so their order is unknown")
    if len(fixes) < 2:
        return 0
    fixes.sort(key=lambda fix: fix.t_ns)
    degrees = np.array([(fix.latitude_deg, fix.longitude_deg) for fix in fixes])
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_geo_lines(path, [GeoLine(films[0].stem, degrees, [fix.t_ns for fix in fixes])])
    except OSError as error:
        raise GnssError(f"{path}: can't be written: {error.strerror}") from None
    return len(fixes)


def fixes_beside(film: Path) -> list[FilmFix]:
    """Reads the fixes in the subtitles beside a film, FILM.srt; none from subtitles without positions."""
    path = next((path for suffix in (".srt", ".SRT") if (path := film.with_suffix(suffix)).is_file()), None)
    if path is None:
        return []
    try:
        fixes = read_fixes(path.read_bytes(), path.name, 0)
    except OSError as error:
        raise GnssError(f"{path}: can't be read: {error.strerror}") from None
    except GnssError:
        return []
    return [FilmFix(fix.latitude_deg, fix.longitude_deg, None, fix.t_source_ns / NS_PER_S) for fix in fixes]


def _fix(sample: dict[str, Any]) -> FilmFix | None:
    try:
        latitude, longitude = float(sample["GPSLatitude"]), float(sample["GPSLongitude"])
    except (KeyError, TypeError, ValueError, OverflowError):
        return None
    utc, t_film_s = _utc(str(sample.get("GPSDateTime", ""))), _t_film_s(sample)
    if (
        (utc is None and t_film_s is None)
        or not is_on_earth(latitude, longitude)
        or (latitude == 0.0 and longitude == 0.0)
    ):
        return None
    return FilmFix(latitude, longitude, utc, t_film_s)


def _t_film_s(sample: dict[str, Any]) -> float | None:
    t_s = sample.get("SampleTime")
    return t_s if isinstance(t_s, int | float) and abs(t_s) < MAX_S else None


def _utc(text: str) -> datetime | None:
    found = _DATE_TIME.match(text)
    if found is None:
        return None
    zone = found[8] if found[8] and found[8] != "Z" else "+00:00"
    second = "{}-{}-{}T{}:{}:{}".format(*found.groups()[:6])
    try:
        whole = datetime.fromisoformat(second + zone)
        return whole.astimezone(UTC) + timedelta(seconds=float(found[7] or 0.0))
    except (ValueError, OverflowError):
        return None
