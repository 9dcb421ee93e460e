"""GNSS fixes from files: CSV with a head, NMEA 0183 sentences, GPX tracks. Untrusted input like any other.

Times are brought to the recording's clock: those of a CSV are seconds of that clock; NMEA and GPX tell UTC, which is
the recording's own where it begins within a day of them, and else begins with it.
"""

from __future__ import annotations

import csv
import io
import math
from datetime import datetime
from xml.etree import ElementTree

from birdslam.loops.gnss.earth import DEFAULT_SIGMA_M, GnssFix, is_on_earth
from birdslam.loops.gnss.sentences import SIGMA_PER_HDOP_M, NmeaReader, Sentence
from birdslam.types import NS_PER_S

MAX_BYTES, MAX_FIXES = 1 << 26, 1_000_000
MAX_S = 4e9  # of a time in seconds, either way
DAY_S = 86_400.0
GNSS_FILE = "gnss.csv"  # of the fixes that came while a car drove, in the drive's folder
COLUMNS = "time_s, latitude_deg, longitude_deg, and where known sigma_m, speed_mps"


class GnssError(ValueError):
    """The file has no usable fixes."""


def read_fixes(data: bytes, name: str, begin_ns: int) -> list[GnssFix]:
    """The fixes of a file's bytes, by their times; `begin_ns`: the recording's first time. Raises GnssError."""
    if len(data) > MAX_BYTES:
        raise GnssError(f"{name}: is larger than {MAX_BYTES >> 20} MiB")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise GnssError(f"{name}: is no text") from None
    begin = text.lstrip()[:1]
    if begin == "<":
        fixes, utc = _gpx(text, name), True
    elif begin in ("$", "!"):
        fixes, utc = _nmea(text, name), True
    else:
        fixes, utc = _csv(text, name), False
    fixes = [fix for fix in fixes if fix[1] or fix[2]]  # receivers without a fix write 0, 0
    if not fixes:
        raise GnssError(f"{name}: has no fix")
    if len(fixes) > MAX_FIXES:
        raise GnssError(f"{name}: has more than {MAX_FIXES} fixes")
    first_s, first_ns = 0.0, 0
    if utc and abs(fixes[0][0] - begin_ns / NS_PER_S) > DAY_S:
        first_s, first_ns = fixes[0][0], begin_ns
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
    return sorted(out, key=lambda fix: fix.t_source_ns)


def checked_fix(
    name: str, t_source_ns: int, latitude_deg: float, longitude_deg: float, sigma_m: float, speed_mps: float | None
) -> GnssFix:
    """A fix of a stream. Raises GnssError where it is none."""
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
        raise GnssError(f"{name}: line {line} is no fix: {t_s:g} s, {lat:g}, {lon:g}, sigma {sigma_m:g} m")
    return t_s, lat, lon, sigma_m, speed


def _csv(text: str, name: str) -> list[_Fix]:
    try:
        rows = list(csv.reader(io.StringIO(text)))
    except csv.Error as error:
        raise GnssError(f"{name}: is no CSV: {error}") from None
    if not rows:
        raise GnssError(f"{name}: is empty")
    head = [word.strip().lower() for word in rows[0]]
    if not {"time_s", "latitude_deg", "longitude_deg"} <= set(head):
        raise GnssError(f"{name}: its first line has to name the columns {COLUMNS}")
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
                    float(speed) if speed else None,
                )
            )
        except (KeyError, ValueError) as error:
            if isinstance(error, GnssError):
                raise
            raise GnssError(f"{name}: line {number} is no fix: {','.join(row)[:60]!r}") from None
    return out


def _nmea(text: str, name: str) -> list[_Fix]:
    """RMC sentences, which tell date and speed, with the accuracy that GST or GGA of the same time tell."""
    reader, out = NmeaReader(), []
    for number, line in enumerate(text.splitlines(), start=1):
        try:
            found = reader.take(line)
        except ValueError:
            raise GnssError(f"{name}: line {number} is no NMEA fix: {line[:60]!r}") from None
        if found is not None:
            out.append(_checked(name, number, *found))
    last = reader.finish()
    return out if last is None else [*out, _checked(name, number, *last)]


def _gpx(text: str, name: str) -> list[_Fix]:
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise GnssError(f"{name}: a GPX file with a DOCTYPE is not read")
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
