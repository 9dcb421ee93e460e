"""Reads a recorded drive frame by frame: Measurements, Estimate and MapUpdate."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from typing import TypeVar

import msgspec

from birdslam.runtime.recording.recording import Recorded, Recording, RecordingError
from birdslam.runtime.wire import WireError, decode
from birdslam.types import Estimate, MapUpdate, Measurements, Status

MAX_WAITING = 64  # estimates and map updates that wait for measurements written after them
READ = ("v1/measurements", "v1/estimate", "v1/map")

_Record = TypeVar("_Record", bound=msgspec.Struct)


def measurements_of(recordings: Iterable[Recording]) -> Iterator[Measurements]:
    """Yields all measurements in the order of the file. Raises RecordingError for one that does not decode."""
    for recording in recordings:
        for message in recording.messages(READ[:1]):
            yield _record(recording, message, Measurements)


def recorded_drive(recordings: Iterable[Recording]) -> Iterator[Measurements | Estimate | MapUpdate]:
    """Yields every estimate, after its Measurements if they were recorded, and the map updates.

    `recordings`: the files of one run in order. Estimates without measurements in time (PERCEPTION_LATE) are skipped,
    as in a run's results. Raises RecordingError for a record that does not decode.
    """
    for recording in recordings:
        waiting: deque[Estimate | MapUpdate] = deque()
        measured: dict[int, Measurements] = {}
        for message in recording.messages(READ):
            if message.channel == "v1/measurements":
                measurements = _record(recording, message, Measurements)
                measured[measurements.frame_id] = measurements
            elif message.channel == "v1/map":
                waiting.append(_record(recording, message, MapUpdate))
            else:
                estimate = _record(recording, message, Estimate)
                if not {Status.END_OF_SOURCE, Status.PERCEPTION_LATE}.intersection(estimate.status):
                    waiting.append(estimate)
            yield from _released(waiting, measured, MAX_WAITING)
        yield from _released(waiting, measured, 0)


def _released(
    waiting: deque[Estimate | MapUpdate], measured: dict[int, Measurements], max_waiting: int
) -> Iterator[Measurements | Estimate | MapUpdate]:
    while waiting:
        record = waiting[0]
        if isinstance(record, Estimate):
            if record.frame_id not in measured and len(waiting) <= max_waiting:
                return
            if record.frame_id in measured:
                yield measured[record.frame_id]
            for frame in [frame for frame in measured if frame <= record.frame_id]:
                del measured[frame]
        yield waiting.popleft()


def _record(recording: Recording, message: Recorded, kind: type[_Record]) -> _Record:
    try:
        return decode(message.data, kind)
    except WireError as error:
        raise RecordingError(f"{recording.path}: has an invalid {kind.__name__}: {error}") from None
