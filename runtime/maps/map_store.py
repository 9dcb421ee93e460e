"""Maps on the disk: read whole or refused, written whole or not at all."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from birdslam.loops.map_file import MAX_BYTES, MapError, decode_map, encode_map
from birdslam.loops.place_map import PlaceMap


def read_map(path: Path) -> PlaceMap:
    """Raises MapError, which names the file and says what is wrong with it."""
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
    """Beside the old file first, on the disk, and then in its place; gives its size in bytes. Raises MapError.

    Whatever goes wrong, the old file stays.
    """
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
        raise MapError(f"{path}: can't be written, what was there stays: {error.strerror}") from None
    return len(data)


def check_map(path: Path, extend: bool) -> PlaceMap | None:
    """The map that a drive begins with; None: a new one. Raises MapError for one that the drive could not use."""
    if path.exists() or not extend:
        return read_map(path)
    if not path.parent.is_dir() or not os.access(path.parent, os.W_OK):
        raise MapError(f"{path}: can't be written: no such folder, or not one to write in")
    return None
