"""Reads fixes in SubRip subtitles (.srt), which cameras write beside a film: one in the text of each cue.

Times are those of the film. Positions are written `[latitude: 22.5] [longitude: 113.9]`, `GPS(113.9, 22.5, 15)` with
the longitude first (DJI), `N22.5 E113.9` or `22.5N, 113.9E`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator

from birdslam.loops.gnss.earth import DEFAULT_SIGMA_M
from birdslam.loops.gnss.sentences import Sentence

CUE = re.compile(r"^[ \t]*(\d{1,6}):(\d\d):(\d\d)[,.](\d{1,3})\s*-->.*$", re.MULTILINE)
_NUMBER = r"([+-]?\d{1,3}\.\d+)"
_NAMED = tuple(re.compile(rf"{name}\w*\s*[:=]?\s*{_NUMBER}", re.IGNORECASE) for name in (r"\blat", r"\blon"))
_LONGITUDE_FIRST = re.compile(rf"\bGPS\s*\(\s*{_NUMBER}\s*,\s*{_NUMBER}")
_HEMISPHERE_FIRST = re.compile(rf"\b([NS])\s*:?\s*{_NUMBER}\W+([EW])\s*:?\s*{_NUMBER}")
_HEMISPHERE_LAST = re.compile(rf"{_NUMBER}\s*°?\s*([NS])\W+{_NUMBER}\s*°?\s*([EW])\b")
_REPEATED_S = 1.0  # a position that stays the same is a new fix after this time: subtitles outrun the receiver


def is_subtitles(text: str) -> bool:
    """Whether the text begins with a cue."""
    found = CUE.search(text)
    return found is not None and not text[: found.start()].strip().strip("0123456789")


def subtitle_fixes(text: str) -> Iterator[tuple[int, Sentence]]:
    """Yields the number of each cue with a new fix, and the fix, with the time in the film in s."""
    cues = list(CUE.finditer(text))
    ends = [*(cue.start() for cue in cues[1:]), len(text)]
    return cue_fixes((_begin_s(cue), text[cue.end() : end]) for cue, end in zip(cues, ends, strict=True))


def cue_fixes(cues: Iterable[tuple[float, str]]) -> Iterator[tuple[int, Sentence]]:
    """As `subtitle_fixes`, of the time in s and the text of each cue."""
    last: tuple[float, float] | None = None
    last_s = 0.0
    for number, (t_s, text) in enumerate(cues, start=1):
        found = _position(text)
        if found is None or (found == last and t_s - last_s < _REPEATED_S):
            continue
        last, last_s = found, t_s
        yield number, (t_s, *found, DEFAULT_SIGMA_M, None)


def _begin_s(cue: re.Match[str]) -> float:
    hours, minutes, seconds = (int(word) for word in cue.groups()[:3])
    return 3600.0 * hours + 60.0 * minutes + seconds + float(f"0.{cue[4]}")


def _position(text: str) -> tuple[float, float] | None:
    """Latitude and longitude in degrees; None without."""
    latitude, longitude = (name.search(text) for name in _NAMED)
    if latitude and longitude:
        return float(latitude[1]), float(longitude[1])
    if found := _LONGITUDE_FIRST.search(text):
        return float(found[2]), float(found[1])
    if found := _HEMISPHERE_FIRST.search(text):
        north, latitude_deg, east, longitude_deg = found.groups()
    elif found := _HEMISPHERE_LAST.search(text):
        latitude_deg, north, longitude_deg, east = found.groups()
    else:
        return None
    return float(latitude_deg) * (-1.0 if north == "S" else 1.0), float(longitude_deg) * (-1.0 if east == "W" else 1.0)
