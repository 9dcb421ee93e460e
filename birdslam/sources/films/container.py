"""Container metadata of a film: why it does not open, and the focal length stated by an MP4 or MOV.

MP4 and MOV files are boxes: four bytes of length, four of name, then the content (ISO/IEC 14496-12). Phones state a
35 mm equivalent focal length among QuickTime's metadata (`mdta` keys).
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from birdslam.sources.recording import DatasetError

FULL_FRAME_MM = 36.0  # width
_FOCAL_KEY = re.compile(rb"focal_length.*35mm", re.IGNORECASE)
_MAX_BYTES = 1 << 26  # of the index; an hour needs some MB
# Transport streams: packets of 188 bytes, or 192 with a time of four bytes first, each with the same sync byte
_PACKET_BYTES, _SYNC_BYTE, _SYNCED = {188: 0, 192: 4}, 0x47, 4
_INSIDE = (b"moov", b"trak", b"udta", b"mdia")
_STATED_MM = 5.0, 300.0  # range of a valid focal length


class _Box(NamedTuple):
    name: bytes
    begin: int  # of the content
    end: int


def why_unreadable(path: Path) -> str:
    """Why OpenCV cannot open an existing file, from its first bytes."""
    try:
        size, head = path.stat().st_size, _read(path, 0, 12)
    except OSError as error:
        return f"can't be read: {error.strerror}"
    if not size:
        return "is empty"
    if head[4:8] in (b"ftyp", b"mdat", b"moov", b"wide", b"free", b"skip"):
        names = [box.name for box in _boxes_of_file(path)]
        if b"moov" not in names:
            return "is cut off: no index, which a camera writes last (power loss?)"
    return "is not a video that OpenCV can open: no images in it, or an unknown codec"


def is_raw_stream(path: Path) -> bool:
    """Whether a file is H.264 or HEVC without a container (Annex B), and so without frame times."""
    try:
        head = _read(path, 0, 5)
    except OSError:
        return False
    begin = 4 if head[:4] == b"\0\0\0\1" else 3
    program_stream = head[:4] in (b"\0\0\1\xba", b"\0\0\1\xb3")  # MPEG-1 and MPEG-2 have times
    return head[begin - 3 : begin] == b"\0\0\1" and len(head) > begin and not program_stream


def is_torn(path: Path) -> bool:
    """Whether an MPEG transport stream (ISO/IEC 13818-1) ends within a packet, since it states no length.

    False for other and for unreadable files.
    """
    try:
        size, head = path.stat().st_size, _read(path, 0, _SYNCED * max(_PACKET_BYTES))
    except OSError:
        return False
    for packet, begin in _PACKET_BYTES.items():
        if len(head) == _SYNCED * max(_PACKET_BYTES) and set(head[begin : _SYNCED * packet : packet]) == {_SYNC_BYTE}:
            return size % packet != 0
    return False


def stated_focal_rel(path: Path) -> float | None:
    """The focal length over the image's long side if an MP4 or MOV states it, else None.

    It is the 35 mm equivalent, for images 36 mm wide; a film may use less than the whole sensor.
    """
    if path.suffix.lower() not in (".mp4", ".mov", ".m4v"):
        return None
    try:
        moov = next((box for box in _boxes_of_file(path) if box.name == b"moov"), None)
        if moov is None or moov.end - moov.begin > _MAX_BYTES:
            return None
        focal_mm = _focal_mm(_read(path, moov.begin, moov.end - moov.begin))
    except OSError:
        return None
    return None if focal_mm is None else focal_mm / FULL_FRAME_MM


# A word (Tesla: 2024-01-01_10-00-00-left_repeater) or a letter after the number (Viofo, BlackVue: ..._000123F)
_CAMERA = re.compile(
    r"(?:(?<=[-_ ])|^)((?:left_|right_)?(?:front|back|rear|left|right|inside|interior|cabin|repeater|pillar))$"
    r"|(?<=\d)_?([FRI])$",
    re.IGNORECASE,
)


def natural(path: Path) -> list[tuple[int, int | str]]:
    """Sort key for names with numbers: film2 before film10."""
    return [(0, int(part)) if part.isdigit() else (1, part.lower()) for part in re.split(r"(\d+)", path.name) if part]


def films_in(path: Path, suffixes: tuple[str, ...]) -> list[Path]:
    """The film, or the films of a directory or pattern (`DIR/*front*`) in natural order. Raises DatasetError."""
    if path.is_dir():
        found: Iterable[Path] = path.iterdir()
    elif "*" in path.name and not path.exists():
        found = path.parent.glob(path.name)
    else:
        return [path]
    films = sorted((file for file in found if file.suffix.lower() in suffixes), key=natural)
    films = [film for film in films if film.is_file() and not film.name.startswith(".")]  # ._ files of macOS
    if not films:
        raise DatasetError(f"{path}: no films ({', '.join(suffixes)})")
    cameras = {camera: film for film in films if (camera := camera_of_name(film))}
    if len(cameras) > 1:
        pattern = (path if path.is_dir() else path.parent) / f"*{next(iter(cameras))}{films[0].suffix}"
        names = ", ".join(sorted(cameras))
        raise DatasetError(f"{path}: has films of several cameras ({names}); name those of one: video:{pattern}")
    return films


def camera_of_name(path: Path) -> str:
    """The camera at the end of a file name, as recorders with several cameras write it; "": none."""
    found = _CAMERA.search(path.stem)
    return (found[1] or found[2]) if found else ""


def _boxes_of_file(path: Path) -> Iterator[_Box]:
    """The top-level boxes up to the end of the file."""
    size, at = path.stat().st_size, 0
    while at + 8 <= size:
        length, name, header = _header(_read(path, at, 16), size - at)
        if length < header:
            return
        yield _Box(name, at + header, min(at + length, size))
        at += length


def _header(head: bytes, rest: int) -> tuple[int, bytes, int]:
    """Length of a box with its header, its name, and the length of its header."""
    length, name = int.from_bytes(head[:4], "big"), head[4:8]
    if length == 1 and len(head) >= 16:
        return int.from_bytes(head[8:16], "big"), name, 16
    return (rest if length == 0 else length), name, 8


def _boxes(data: bytes, begin: int, end: int) -> Iterator[_Box]:
    while begin + 8 <= end:
        length, name, header = _header(data[begin : begin + 16], end - begin)
        if length < header or begin + length > end:
            return
        yield _Box(name, begin + header, begin + length)
        begin += length


def _focal_mm(moov: bytes) -> float | None:
    """Searches the metadata of the film and its tracks."""
    waiting = [_Box(b"moov", 0, len(moov))]
    while waiting:
        box = waiting.pop()
        for inner in _boxes(moov, box.begin, box.end):
            if inner.name in _INSIDE:
                waiting.append(inner)
            elif inner.name == b"meta":
                found = _of_meta(moov, inner)
                if found is not None:
                    return found
    return None


def _of_meta(data: bytes, meta: _Box) -> float | None:
    """`keys` names the entries of `ilst` by number. QuickTime's meta starts with boxes, MPEG's with a version."""
    skip = 0 if data[meta.begin + 4 : meta.begin + 8] in (b"hdlr", b"keys", b"mhdr") else 4
    parts = {box.name: box for box in _boxes(data, meta.begin + skip, meta.end)}
    if b"keys" not in parts or b"ilst" not in parts:
        return None
    names = [data[box.begin : box.end] for box in _boxes(data, parts[b"keys"].begin + 8, parts[b"keys"].end)]
    for item in _boxes(data, parts[b"ilst"].begin, parts[b"ilst"].end):
        number = int.from_bytes(item.name, "big")
        if 1 <= number <= len(names) and _FOCAL_KEY.search(names[number - 1]):
            for value in _boxes(data, item.begin, item.end):
                if value.name == b"data":
                    return _number(data[value.begin : value.end])
    return None


def _number(value: bytes) -> float | None:
    """Parses a `data` box: type, locale, then a text, an integer or a float."""
    kind, content = int.from_bytes(value[1:4], "big"), value[8:]
    try:
        if kind == 1:
            number = float(content.decode("ascii"))
        elif kind in (21, 22):
            number = float(int.from_bytes(content, "big", signed=kind == 21))
        elif kind in (23, 24):
            number = float(struct.unpack(">f" if kind == 23 else ">d", content)[0])
        else:
            return None
    except (ValueError, struct.error):
        return None
    return number if math.isfinite(number) and _STATED_MM[0] <= number <= _STATED_MM[1] else None


def _read(path: Path, at: int, length: int) -> bytes:
    with path.open("rb") as file:
        file.seek(at)
        return file.read(length)
