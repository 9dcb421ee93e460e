"""The car's own speed readings over a drive, and those that had arrived by a frame."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable
from itertools import accumulate

import msgspec

from birdslam.types import NS_PER_S, SpeedReading

KEPT_NS = NS_PER_S  # a frame carries the readings of so long before it
KEPT_READINGS = 200  # and no more of them: the newest
_MAX_NS = (1 << 63) - 1


class SpeedLog:
    """The readings of a drive in the order of their arrival.

    A reading arrives at its own time; one that is older than a reading before it arrives together with that one. So
    the same frames carry the same readings, whatever the load of the computer.
    """

    def __init__(self, readings: Iterable[SpeedReading]) -> None:
        self.readings = tuple(readings)
        self._arrival_ns = list(accumulate((reading.t_ns for reading in self.readings), max))

    def until(self, t_ns: int) -> tuple[SpeedReading, ...]:
        """Those of the last second that had arrived by `t_ns` (as t_source_ns of a frame), in order of arrival."""
        begin, end = bisect_right(self._arrival_ns, t_ns - KEPT_NS), bisect_right(self._arrival_ns, t_ns)
        return self.readings[max(begin, end - KEPT_READINGS) : end]


def shifted(reading: SpeedReading, by_ns: int) -> SpeedReading:
    """On another clock, `by_ns` ahead; a time that its sender got wrong is clamped to 63 bits."""
    return msgspec.structs.replace(reading, t_ns=max(-_MAX_NS, min(reading.t_ns + by_ns, _MAX_NS)))


def added(before: tuple[SpeedReading, ...], after: tuple[SpeedReading, ...]) -> tuple[SpeedReading, ...]:
    """The readings of a frame that the frame before it did not carry: `after` without what overlaps `before`."""
    old, new = ([msgspec.msgpack.encode(one) for one in span] for span in (before, after))  # a NaN equals itself there
    overlap = next(n for n in range(min(len(old), len(new)), -1, -1) if old[len(old) - n :] == new[:n])
    return after[overlap:]
