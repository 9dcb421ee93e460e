"""GNSS fixes from files: CSV with named columns, NMEA 0183 sentences, GPX tracks, subtitles. The input is not trusted.

The times of a CSV are seconds of the recording's clock, or Unix time; NMEA and GPX have UTC, subtitles the time of
their film. UTC is the recording's own clock where it begins within a day of the fixes. Else the clocks are unrelated,
and the first fix gets the time of the first frame: `Track.clock_is_known` is false.
"""

from __future__ import annotations

import csv
import io
import math
import re
from dataclasses import dataclass
from datetime import datetime
from xml.etree import ElementTree

from birdslam.loops.gnss.earth import DEFAULT_SIGMA_M, GnssFix, is_on_earth
from birdslam.loops.gnss.sentences import SIGMA_PER_HDOP_M, NmeaReader, Sentence, undated_fixes
from birdslam.loops.gnss.subtitles import is_subtitles, subtitle_fixes
from birdslam.types import NS_PER_S

MAX_BYTES, MAX_FIXES = 1 << 26, 1_000_000
MAX_S = 4e9  # of a time in seconds, either way
DAY_S = 86_400.0
UNIX_FROM_S = 1e9  # a time in seconds from here on is Unix time: 2001 and later
NMEA_LINES = 50  # among so many first lines one is a sentence
GNSS_FILE = "gnss.csv"  # fixes received during a drive, in its folder
COLUMNS = "time_s, latitude_deg, longitude_deg, and optionally sigma_m, speed_mps"
_NAMES = {  # other names of the columns, and the factor to our unit
    **dict.fromkeys(("t_s", "time", "t", "timestamp_s", "seconds", "unix_s"), ("time_s", 1.0)),
    **dict.fromkeys(("latitude", "lat"), ("latitude_deg", 1.0)),
    **dict.fromkeys(("longitude", "lon", "lng"), ("longitude_deg", 1.0)),
    **dict.fromkeys(("speed", "velocity_mps"), ("speed_mps", 1.0)),
    **dict.fromkeys(("speed_kmh", "speed_kph"), ("speed_mps", 1.0 / 3.6)),
    **dict.fromkeys(("speed_mph",), ("speed_mps", 0.44704)),
}
_SENTENCE = re.compile(r"^[ \t]*(\[\d+\])?[$!](?=[A-Z]{2})", re.MULTILINE)


class GnssError(ValueError):
    """The file has no usable fixes."""


@dataclass(frozen=True)
class Track:
    """Fixes in the order of their times, and whether these are times of the recording's clock."""

    fixes: list[GnssFix]
    clock_is_known: bool = True


def read_fixes(data: bytes, name: str, begin_ns: int) -> list[GnssFix]:
    """Returns the fixes of a file's bytes in the order of their times. Raises GnssError."""
    return read_track(data, name, begin_ns).fixes


def read_track(data: bytes, name: str, begin_ns: int, offset_s: float | None = None) -> Track:
    """Reads the fixes of a file's bytes; `begin_ns` is the recording's first time. Raises GnssError.

    `offset_s`, where the user states it, is the time from the first fix to the first frame.
    """
    if len(data) > MAX_BYTES:
        raise GnssError(f"{name}: is larger than {MAX_BYTES >> 20} MiB")
    try:
        text = data.decode("utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig")
    except UnicodeDecodeError:
        raise GnssError(f"{name}: is no text") from None
    if text.lstrip()[:1] == "<":
        fixes, utc = _gpx(text, name), True
    elif _SENTENCE.search("\n".join(text.splitlines()[:NMEA_LINES])):
        fixes, utc = _nmea(text, name, begin_ns), True
    elif is_subtitles(text):
        fixes, utc = [_checked(f"{name}: cue", number, *fix) for number, fix in subtitle_fixes(text)], False
    else:
        fixes = _csv(text, name)
        utc = bool(fixes) and fixes[0][0] >= UNIX_FROM_S
    fixes = [fix for fix in fixes if fix[1] or fix[2]]  # receivers without a fix write 0, 0
    if not fixes:
        raise GnssError(f"{name}: has no fix")
    if len(fixes) > MAX_FIXES:
        raise GnssError(f"{name}: has more than {MAX_FIXES} fixes")
    is_known = not utc or abs(fixes[0][0] - begin_ns / NS_PER_S) <= DAY_S
    first_s, first_ns = 0.0, 0
    if offset_s is not None:
        first_s, first_ns = min(fix[0] for fix in fixes) + offset_s, begin_ns
    elif not is_known:
        first_s, first_ns = min(fix[0] for fix in fixes), begin_ns
    out = [
        GnssFix(
            t_source_ns=first_ns + round((t_s - first_s) * NS_PER_S),
            latitude_deg=latitude,
            longitude_deg=longitude,
            sigma_m=sigma_m,
            speed_mps=speed_mps,
        )
        for t_s, latitude, longitude, sigma_m, speed_mps in fixes
    ]
    return Track(sorted(out, key=lambda fix: fix.t_source_ns), is_known or offset_s is not None)


def checked_fix(
    name: str, t_source_ns: int, latitude_deg: float, longitude_deg: float, sigma_m: float, speed_mps: float | None
) -> GnssFix:
    """Checks a fix of a stream. Raises GnssError if it is invalid."""
    _checked(name, 0, t_source_ns / NS_PER_S, latitude_deg, longitude_deg, sigma_m, speed_mps)
    return GnssFix(
        t_source_ns=t_source_ns,
        latitude_deg=latitude_deg,
        longitude_deg=longitude_deg,
        sigma_m=sigma_m,
        speed_mps=speed_mps,
    )


_Fix = Sentence


def _checked(name: str, line: int, t_s: float, lat: float, lon: float, sigma_m: float, speed: float | None) -> _Fix:
    whole = math.isfinite(t_s) and abs(t_s) < MAX_S and is_on_earth(lat, lon)
    fine = math.isfinite(sigma_m) and 0.0 < sigma_m < 1e5 and (speed is None or 0.0 <= speed < 200.0)
    if not (whole and fine):
        raise GnssError(f"{name}: line {line} is not a fix: {t_s:g} s, {lat:g}, {lon:g}, sigma {sigma_m:g} m")
    return t_s, lat, lon, sigma_m, speed


def _csv(text: str, name: str) -> list[_Fix]:
    try:
        rows = list(csv.reader(io.StringIO(text)))
    except csv.Error as error:
        raise GnssError(f"{name}: is no CSV: {error}") from None
    if not rows:
        raise GnssError(f"{name}: is empty")
    written = [word.strip().lower() for word in rows[0]]
    head = [_NAMES.get(word, (word, 1.0))[0] for word in written]
    unit = {_NAMES[word][0]: _NAMES[word][1] for word in written if word in _NAMES}
    if not {"time_s", "latitude_deg", "longitude_deg"} <= set(head):
        raise GnssError(f"{name}: its first line must name the columns {COLUMNS}")
    out = []
    for number, row in enumerate(rows[1:], start=2):
        if not row or row[0].lstrip().startswith("#"):
            continue
        fields = dict(zip(head, row, strict=False))
        try:
            sigma = fields.get("sigma_m", "").strip()
            speed = fields.get("speed_mps", "").strip()
            out.append(
                _checked(
                    name,
                    number,
                    float(fields["time_s"]),
                    float(fields["latitude_deg"]),
                    float(fields["longitude_deg"]),
                    float(sigma) if sigma else DEFAULT_SIGMA_M,
                    float(speed) * unit.get("speed_mps", 1.0) if speed else None,
                )
            )
        except (KeyError, ValueError) as error:
            if isinstance(error, GnssError):
                raise
            raise GnssError(f"{name}: line {number} is no fix: {','.join(row)[:60]!r}") from None
    return out


def _nmea(text: str, name: str, begin_ns: int) -> list[_Fix]:
    """RMC sentences, which have date and speed, with the accuracy of GST or GGA sentences of the same time.

    Without any RMC sentence the fixes of GGA, whose day is that of the recording.
    """
    reader, out = NmeaReader(), []
    lines = _SENTENCE.sub("$", text).splitlines()  # dashcams write a time in brackets before the sentence
    for number, line in enumerate(lines, start=1):
        try:
            found = reader.take(line)
        except ValueError:
            raise GnssError(f"{name}: line {number} is no NMEA fix: {line[:60]!r}") from None
        if found is not None:
            out.append(_checked(name, number, *found))
    last = reader.finish()
    if last is not None:
        out.append(_checked(name, number, *last))
    if out:
        return out
    begin_s = begin_ns / NS_PER_S
    near_s = begin_s if begin_s >= UNIX_FROM_S else UNIX_FROM_S
    return [_checked(name, number, *fix) for number, fix in undated_fixes(lines, near_s)]


def _gpx(text: str, name: str) -> list[_Fix]:
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise GnssError(f"{name}: GPX with a DOCTYPE is not supported")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError, RecursionError) as error:
        raise GnssError(f"{name}: is no XML: {error}") from None
    out = []
    for number, point in enumerate(root.iter(), start=1):
        if not isinstance(point.tag, str) or point.tag.rpartition("}")[2] != "trkpt":
            continue
        children = {
            child.tag.rpartition("}")[2]: (child.text or "").strip() for child in point if isinstance(child.tag, str)
        }
        if "time" not in children:
            continue
        try:
            t_s = datetime.fromisoformat(children["time"].replace("Z", "+00:00")).timestamp()
            hdop, speed = children.get("hdop"), children.get("speed")
            out.append(
                _checked(
                    name,
                    number,
                    t_s,
                    float(point.attrib["lat"]),
                    float(point.attrib["lon"]),
                    SIGMA_PER_HDOP_M * float(hdop) if hdop else DEFAULT_SIGMA_M,
                    float(speed) if speed else None,
                )
            )
        except (KeyError, ValueError, OverflowError) as error:
            if isinstance(error, GnssError):
                raise
            raise GnssError(f"{name}: point {number} is no fix") from None
    return out
