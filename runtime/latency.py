"""Latency statistics: fixed-size distributions of ages and stages from the traces of messages."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from birdslam.runtime.wire import Spread, Trace

_LOWEST_MS = 1e-3
_BINS_PER_FACTOR = 100  # within one factor e: a percentile is exact to 1 %
_BINS = math.ceil(_BINS_PER_FACTOR * math.log(1e5 / _LOWEST_MS))  # up to 100 s


class Distribution:
    """A distribution of durations in ms, of fixed size. Percentiles are exact to 1 %, the maximum is exact."""

    def __init__(self) -> None:
        self.count = 0
        self.max_ms = 0.0
        self._bins = np.zeros(_BINS, dtype=np.int64)

    def add(self, ms: float) -> None:
        position = math.floor(_BINS_PER_FACTOR * math.log(max(ms, _LOWEST_MS) / _LOWEST_MS))
        self._bins[min(position, _BINS - 1)] += 1
        self.count += 1
        self.max_ms = max(self.max_ms, ms)

    def joined(self, other: Distribution) -> Distribution:
        """Returns the sum of both distributions."""
        out = Distribution()
        out.count, out.max_ms = self.count + other.count, max(self.max_ms, other.max_ms)
        out._bins = self._bins + other._bins
        return out

    def percentile(self, percent: float) -> float:
        """Returns a percentile in ms; NaN without data."""
        if not self.count:
            return math.nan
        rank = max(1, math.ceil(self.count * percent / 100.0))
        position = int(np.searchsorted(np.cumsum(self._bins), rank))
        return min(_LOWEST_MS * math.exp((position + 0.5) / _BINS_PER_FACTOR), self.max_ms)

    def summary(self) -> dict[str, float]:
        """Returns p50, p99 and max in ms; empty without data."""
        if not self.count:
            return {}
        figures = {"p50": self.percentile(50.0), "p99": self.percentile(99.0), "max": self.max_ms}
        return {name: round(value, 3) for name, value in figures.items()}


class Recent:
    """The distribution over the last `span_s` to 2 `span_s`, of fixed size."""

    def __init__(self, span_s: float = 5.0) -> None:
        self._span_ns = round(span_s * 1e9)
        self._older, self._newer = Distribution(), Distribution()
        self._turn_ns = 0

    def add(self, ms: float, now_ns: int) -> None:
        self._turn(now_ns)
        self._newer.add(ms)

    def _turn(self, now_ns: int) -> None:
        if now_ns - self._turn_ns > self._span_ns:
            late = now_ns - self._turn_ns > 2 * self._span_ns
            self._older, self._newer = Distribution() if late else self._newer, Distribution()
            self._turn_ns = now_ns

    def spread(self, now_ns: int) -> Spread:
        """Returns the current spread."""
        self._turn(now_ns)
        both = self._older.joined(self._newer)
        if not both.count:
            return Spread()
        return Spread(both.percentile(50.0), both.percentile(95.0), both.percentile(99.0), both.max_ms)


def stages(trace: Trace, t_received_ns: int) -> Iterator[tuple[str, float]]:
    """Yields (name, ms) of each wait in a queue, each step, and each hop between nodes, the last to the receiver."""
    arrivals = [(after.node, after.arrived_ns or after.received_ns) for after in trace.stages[1:]]
    arrivals.append(("planner", t_received_ns))
    for stage, (receiver, arrival_ns) in zip(trace.stages, arrivals, strict=False):
        if stage.arrived_ns:
            yield queue_of(stage.node), (stage.received_ns - stage.arrived_ns) / 1e6
        yield stage.node, (stage.done_ns - stage.received_ns) / 1e6
        yield f"{stage.node} -> {receiver}", (arrival_ns - stage.done_ns) / 1e6


def queue_of(node: str) -> str:
    """Returns the name of the stage in which a record waits in the node's queue."""
    return f"{node} queue"


def key_of(stage: str) -> str:
    """Returns a stage's name as a key, as in `budgets.capture_to_perceive_ms`."""
    return stage.replace(" -> ", "_to_").replace(" ", "_")
