"""GNSS fixes from files: CSV with a head, NMEA 0183 sentences, GPX tracks. Untrusted input like any other.

Times are brought to the recording's clock: those of a CSV are seconds of that clock; NMEA and GPX tell UTC, which is
the recording's own where it begins within a day of them, and else begins with it.
"""

from __future__ import annotations

import csv
import io
import math
from datetime import UTC, datetime
from xml.etree import ElementTree

from birdslam.loops.earth import DEFAULT_SIGMA_M, GnssFix
from birdslam.types import NS_PER_S

MOST_BYTES, MOST_FIXES = 1 << 26, 1_000_000
MOST_S = 4e9  # of a time in seconds, either way
SIGMA_PER_HDOP_M = 4.0
KNOT_MPS = 0.514444
DAY_S = 86_400.0
GNSS_FILE = "gnss.csv"  # of the fixes that came while a car drove, in the drive's folder
COLUMNS = "time_s, latitude_deg, longitude_deg, and where known sigma_m, speed_mps"


class GnssError(ValueError):
    """The file holds no fixes that can be used; the message says why."""


def read_fixes(data: bytes, name: str, begin_ns: int) -> list[GnssFix]:
    """The fixes of a file's bytes, by their times; `begin_ns`: the recording's first time. Raises GnssError."""
    if len(data) > MOST_BYTES:
        raise GnssError(f"{name}: is larger than {MOST_BYTES >> 20} MiB")
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
    if not fixes:
        raise GnssError(f"{name}: has no fix")
    if len(fixes) > MOST_FIXES:
        raise GnssError(f"{name}: has more than {MOST_FIXES} fixes")
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


_Fix = tuple[float, float, float, float, float | None]


def _checked(name: str, line: int, t_s: float, lat: float, lon: float, sigma_m: float, speed: float | None) -> _Fix:
    whole = math.isfinite(t_s) and abs(t_s) < MOST_S and abs(lat) <= 90.0 and abs(lon) <= 180.0
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
    """RMC sentences, which tell date and speed, with the dilution of the GGA of the same time."""
    out: list[_Fix] = []
    dilution: dict[str, float] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        words = _sentence(line)
        if words is None:
            continue
        try:
            if words[0].endswith("GGA") and len(words) > 8 and words[8]:
                dilution = {words[1]: float(words[8])}
            if not words[0].endswith("RMC") or len(words) < 10 or words[2] != "A":
                continue
            t_s = _utc(words[9], words[1])
            latitude, longitude = _degrees(words[3], words[4]), _degrees(words[5], words[6])
            sigma_m = SIGMA_PER_HDOP_M * dilution[words[1]] if words[1] in dilution else DEFAULT_SIGMA_M
            speed = float(words[7]) * KNOT_MPS if words[7] else None
            out.append(_checked(name, number, t_s, latitude, longitude, sigma_m, speed))
        except (ValueError, OverflowError) as error:
            if isinstance(error, GnssError):
                raise
            raise GnssError(f"{name}: line {number} is no NMEA fix: {line[:60]!r}") from None
    return out


def _sentence(line: str) -> list[str] | None:
    """Its words, where its sum is right; receivers cut lines off."""
    body, star, told = line.strip().partition("*")
    if not body.startswith("$") or not star:
        return None
    total = 0
    for byte in body[1:].encode("utf-8"):
        total ^= byte
    try:
        return body[1:].split(",") if int(told[:2], 16) == total else None
    except ValueError:
        return None


def _utc(date: str, time: str) -> float:
    seconds = float(time[4:])
    if not 0.0 <= seconds < 61.0:
        raise ValueError(f"{time} is no time")
    day = datetime(2000 + int(date[4:6]), int(date[2:4]), int(date[:2]), int(time[:2]), int(time[2:4]), tzinfo=UTC)
    return day.timestamp() + seconds


def _degrees(word: str, side: str) -> float:
    """ddmm.mmmm and its hemisphere."""
    number = float(word)
    if not math.isfinite(number):
        raise ValueError(f"{word} is no angle")
    whole = math.floor(number / 100.0)
    return (whole + (number - 100.0 * whole) / 60.0) * (-1.0 if side in ("S", "W") else 1.0)


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
