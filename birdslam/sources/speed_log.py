"""Vehicle speed readings of a drive, and those that arrived by a frame."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable
from itertools import accumulate

import msgspec

from birdslam.types import NS_PER_S, SpeedReading

MAX_AGE_NS = NS_PER_S  # a frame carries the readings of this period
MAX_READINGS = 200  # max. number of them, the newest
_MAX_NS = (1 << 63) - 1


class SpeedLog:
    """The readings of a drive in the order of arrival.

    A reading arrives at its own time; one older than its predecessor arrives together with that. So the assignment to
    frames does not depend on the computer's load.
    """

    def __init__(self, readings: Iterable[SpeedReading]) -> None:
        self.readings = tuple(readings)
        self._arrival_ns = list(accumulate((reading.t_ns for reading in self.readings), max))

    def until(self, t_ns: int) -> tuple[SpeedReading, ...]:
        """Readings of the last second that arrived by `t_ns` (t_source_ns of a frame), in order of arrival."""
        begin, end = bisect_right(self._arrival_ns, t_ns - MAX_AGE_NS), bisect_right(self._arrival_ns, t_ns)
        return self.readings[max(begin, end - MAX_READINGS) : end]


def shifted(reading: SpeedReading, by_ns: int) -> SpeedReading:
    """Shifts a reading to a clock that is `by_ns` ahead; invalid times are clamped to 63 bits."""
    return msgspec.structs.replace(reading, t_ns=max(-_MAX_NS, min(reading.t_ns + by_ns, _MAX_NS)))


def added(before: tuple[SpeedReading, ...], after: tuple[SpeedReading, ...]) -> tuple[SpeedReading, ...]:
    """New readings of a frame: `after` without its overlap with `before`, the readings of the frame before."""
    old, new = ([msgspec.msgpack.encode(one) for one in span] for span in (before, after))  # encoded, NaN equals itself
    overlap = next(n for n in range(min(len(old), len(new)), -1, -1) if old[len(old) - n :] == new[:n])
    return after[overlap:]
