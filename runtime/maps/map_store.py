"""Reads and writes map files; writing is atomic."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from birdslam.loops.map_file import MAX_BYTES, MapError, decode_map, encode_map
from birdslam.loops.place_map import PlaceMap


def read_map(path: Path) -> PlaceMap:
    """Reads a map. Raises MapError with the file and the reason."""
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise MapError(f"{path}: can't be read: {error.strerror}") from None
    try:
        return decode_map(data)
    except MapError as error:
        raise MapError(f"{path}: {error}") from None


def write_map(path: Path, place_map: PlaceMap) -> int:
    """Writes a map atomically; returns its size in bytes. Raises MapError; the old file then stays."""
    data = encode_map(place_map)
    temporary = None
    try:
        fd, temporary = tempfile.mkstemp(prefix=f".{path.name}-", dir=path.parent or ".")
        with os.fdopen(fd, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except OSError as error:
        if temporary is not None:
            Path(temporary).unlink(missing_ok=True)
        raise MapError(f"{path}: can't be written, the old file is kept: {error.strerror}") from None
    return len(data)


def check_map(path: Path, extend: bool) -> PlaceMap | None:
    """Returns the initial map of a drive; None: a new one. Raises MapError for an unusable file."""
    if path.exists() or not extend:
        return read_map(path)
    if not path.parent.is_dir() or not os.access(path.parent, os.W_OK):
        raise MapError(f"{path}: can't be written: the folder does not exist or is not writable")
    return None
