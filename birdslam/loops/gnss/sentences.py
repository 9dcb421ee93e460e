"""Reads NMEA 0183 sentences: RMC has the fix, GST or GGA of the same time its accuracy, before or after it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime

from birdslam.loops.gnss.earth import DEFAULT_SIGMA_M

SIGMA_PER_HDOP_M = 4.0
KNOT_MPS = 0.514444
DAY_S = 86_400.0

Sentence = tuple[float, float, float, float, float | None]  # UTC in s, latitude, longitude, sigma_m, speed_mps


class NmeaReader:
    """`take` each line; it returns a fix at the start of the next one, `finish` the last fix."""

    def __init__(self) -> None:
        self._waiting: tuple[str, float, float, float, float | None] | None = None  # time as text, then ...
        self._accuracy: dict[str, float] = {}  # by time as text

    @property
    def waits(self) -> str:
        """The time of the current fix as text; "": none."""
        return "" if self._waiting is None else self._waiting[0]

    def take(self, line: str) -> Sentence | None:
        """Returns the previous fix if this line starts another.

        Raises ValueError for a line with a valid checksum and invalid numbers; skips lines with a wrong checksum, since
        receivers truncate lines.
        """
        words = _words(line)
        if words is None or len(words[0]) < 5:
            return None
        kind = words[0][-3:]
        if kind == "GST" and len(words) > 7 and words[6] and words[7]:
            self._accuracy[words[1]] = math.hypot(float(words[6]), float(words[7])) / math.sqrt(2.0)
        elif kind == "GGA" and len(words) > 8 and words[8]:
            self._accuracy.setdefault(words[1], SIGMA_PER_HDOP_M * float(words[8]))
        elif kind == "RMC" and len(words) > 9 and words[2] == "A":
            speed_mps = float(words[7]) * KNOT_MPS if words[7] else None
            place = _degrees(words[3], words[4]), _degrees(words[5], words[6])
            here = words[1], _utc(words[9], words[1]), *place, speed_mps
            before, self._waiting = self.finish(), here
            return before
        return None

    def finish(self) -> Sentence | None:
        """Returns the current fix with its accuracy."""
        if self._waiting is None:
            return None
        time_text, utc_s, latitude_deg, longitude_deg, speed_mps = self._waiting
        sigma_m = self._accuracy.get(time_text, DEFAULT_SIGMA_M)
        self._waiting = None
        self._accuracy = {time: sigma for time, sigma in [*self._accuracy.items()][-2:] if time != time_text}
        return utc_s, latitude_deg, longitude_deg, sigma_m, speed_mps


def undated_fixes(lines: Iterable[str], near_s: float) -> Iterator[tuple[int, Sentence]]:
    """Number and fix of each GGA sentence, which has a time of day alone: of the day that begins nearest to `near_s`.

    After midnight the next day begins. Sentences without a fix or with a wrong sum are skipped.
    """
    before_s: float | None = None
    for number, line in enumerate(lines, start=1):
        words = _words(line)
        if words is None or words[0][-3:] != "GGA" or len(words) < 9 or words[6] in ("", "0"):
            continue
        try:
            t_s = 3600.0 * int(words[1][:2]) + 60.0 * int(words[1][2:4]) + _seconds(words[1])
            latitude_deg, longitude_deg = _degrees(words[2], words[3]), _degrees(words[4], words[5])
            sigma_m = SIGMA_PER_HDOP_M * float(words[8]) if words[8] else DEFAULT_SIGMA_M
        except ValueError:
            continue
        nearest_s = near_s if before_s is None else before_s
        t_s += DAY_S * round((nearest_s - t_s) / DAY_S)
        before_s = t_s
        yield number, (t_s, latitude_deg, longitude_deg, sigma_m, None)


def _words(line: str) -> list[str] | None:
    """Returns the words of a sentence with a valid checksum, else None."""
    body, star, checksum = line.strip().partition("*")
    if not body.startswith("$") or not star:
        return None
    total = 0
    for byte in body[1:].encode("utf-8"):
        total ^= byte
    try:
        return body[1:].split(",") if int(checksum[:2], 16) == total else None
    except ValueError:
        return None


def _seconds(time: str) -> float:
    """The seconds of a time hhmmss.sss. Raises ValueError."""
    seconds = float(time[4:])
    if not 0.0 <= seconds < 61.0:
        raise ValueError(f"{time} is no time")
    return seconds


def _utc(date: str, time: str) -> float:
    seconds = _seconds(time)
    day = datetime(2000 + int(date[4:6]), int(date[2:4]), int(date[:2]), int(time[:2]), int(time[2:4]), tzinfo=UTC)
    return day.timestamp() + seconds


def _degrees(word: str, side: str) -> float:
    """Converts ddmm.mmmm with its hemisphere to degrees."""
    number = float(word)
    if not math.isfinite(number):
        raise ValueError(f"{word} is no angle")
    whole = math.floor(number / 100.0)
    return (whole + (number - 100.0 * whole) / 60.0) * (-1.0 if side in ("S", "W") else 1.0)
