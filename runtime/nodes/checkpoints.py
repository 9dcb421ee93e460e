"""The optimizer's last checkpoints, in a file of the vehicle's runtime directory that survives a kill -9.

The file is memory-mapped. Two slots are written alternately, each with its sequence number last: if the process is
killed while it writes one, the other is complete. `PoseGraph.restore` checks the contents.
"""

from __future__ import annotations

import logging
import mmap
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from birdslam.runtime.configuration import Configuration
from birdslam.runtime.transport.presence import runtime_dir_of

MAX_BYTES = 1 << 20
_PLACES, _HEAD_BYTES = 2, 64
_TURN, _FRAME, _EPOCH, _BYTES = range(4)  # words of a header; _TURN is 0 in an empty slot

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint with its last frame and its epoch."""

    frame_id: int
    epoch: int
    data: bytes


def checkpoint_path(configuration: Configuration) -> Path:
    """Returns the path of this vehicle's checkpoints."""
    return runtime_dir_of(configuration.vehicle, configuration.runtime_dir) / "checkpoint"


class CheckpointFile:
    """Written by the optimizer, read once by its successor. Raises OSError if the disk is full."""

    def __init__(self, path: Path) -> None:
        fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
        try:
            size = _PLACES * (_HEAD_BYTES + MAX_BYTES)
            os.posix_fallocate(fd, 0, size)
            memory = mmap.mmap(fd, size)
        finally:
            os.close(fd)
        places = np.frombuffer(memory, dtype=np.uint8).reshape(_PLACES, _HEAD_BYTES + MAX_BYTES)
        self._heads = [place[:_HEAD_BYTES].view(np.int64) for place in places]
        self._bodies = [place[_HEAD_BYTES:] for place in places]
        self._turn = max(int(head[_TURN]) for head in self._heads)

    def store(self, frame_id: int, epoch: int, data: bytes) -> bool:
        """Overwrites the older of the two checkpoints; returns False if `data` is too large."""
        if len(data) > MAX_BYTES:
            log.warning("a checkpoint of %d B is over %d B: a restart will start a new epoch", len(data), MAX_BYTES)
            return False
        self._turn += 1
        head, body = self._heads[self._turn % _PLACES], self._bodies[self._turn % _PLACES]
        head[_TURN] = 0
        body[: len(data)] = np.frombuffer(data, dtype=np.uint8)
        head[_FRAME], head[_EPOCH], head[_BYTES] = frame_id, epoch, len(data)
        head[_TURN] = self._turn
        return True

    def take(self) -> list[Checkpoint]:
        """Returns and removes the checkpoints, newest first; one that crashes the optimizer is not read twice."""
        found = []
        for head, body in sorted(zip(self._heads, self._bodies, strict=True), key=lambda place: -int(place[0][_TURN])):
            if head[_TURN] > 0 and 0 < head[_BYTES] <= MAX_BYTES:
                found.append(Checkpoint(int(head[_FRAME]), int(head[_EPOCH]), body[: int(head[_BYTES])].tobytes()))
            head[_TURN] = 0
        return found


def newest_checkpoint(path: Path) -> Checkpoint | None:
    """Returns the newest complete checkpoint in the file, for another process; None if there is none."""
    size = _HEAD_BYTES + MAX_BYTES
    try:
        fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW)
    except FileNotFoundError:
        return None
    try:
        heads = [(_head(fd, place * size), place) for place in range(_PLACES)]
        (turn, frame_id, epoch, length), place = max(heads, key=lambda found: found[0][_TURN])
        if turn <= 0 or not 0 < length <= MAX_BYTES:
            return None
        data = os.pread(fd, length, place * size + _HEAD_BYTES)
        whole = len(data) == length and _head(fd, place * size)[_TURN] == turn  # else the optimizer is writing there
        return Checkpoint(frame_id, epoch, data) if whole else None
    finally:
        os.close(fd)


def _head(fd: int, start: int) -> list[int]:
    words = np.frombuffer(os.pread(fd, _HEAD_BYTES, start).ljust(_HEAD_BYTES, b"\0"), dtype=np.int64)
    return [int(word) for word in words[: _BYTES + 1]]
