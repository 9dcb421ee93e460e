"""What the car itself said of its motion over a whole drive, and what of it had come by a frame."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable
from itertools import accumulate

import msgspec

from birdslam.types import NS_PER_S, SpeedReading

KEPT_NS = NS_PER_S  # a frame bears the readings of so long before it
KEPT_READINGS = 200  # and no more of them: the newest
_MOST_NS = (1 << 63) - 1


class SpeedLog:
    """The readings of a drive in the order in which they came.

    One came at its own time; one that is older than a reading before it came together with that one. So the same
    frames bear the same readings, whatever the load of the computer.
    """

    def __init__(self, readings: Iterable[SpeedReading]) -> None:
        self.readings = tuple(readings)
        self._come_ns = list(accumulate((reading.t_ns for reading in self.readings), max))

    def until(self, t_ns: int) -> tuple[SpeedReading, ...]:
        """Those of the last second that had come by `t_ns` (as t_source_ns of a frame), in order of coming."""
        begin, end = bisect_right(self._come_ns, t_ns - KEPT_NS), bisect_right(self._come_ns, t_ns)
        return self.readings[max(begin, end - KEPT_READINGS) : end]


def shifted(reading: SpeedReading, by_ns: int) -> SpeedReading:
    """By another clock. Whatever its computer may say, the time stays one of 63 bits."""
    return msgspec.structs.replace(reading, t_ns=max(-_MOST_NS, min(reading.t_ns + by_ns, _MOST_NS)))


def added(before: tuple[SpeedReading, ...], after: tuple[SpeedReading, ...]) -> tuple[SpeedReading, ...]:
    """What a frame bears beyond the frame before it: of two such spans, those that came between the ends of the two."""
    was, now = ([msgspec.msgpack.encode(one) for one in span] for span in (before, after))  # a NaN equals itself there
    both = next(n for n in range(min(len(was), len(now)), -1, -1) if was[len(was) - n :] == now[:n])
    return after[both:]
