"""Statistics of a node, published once a second as its health (wire.Health)."""

from __future__ import annotations

import time

import psutil

from birdslam.runtime.configuration import Configuration
from birdslam.runtime.latency import Recent
from birdslam.runtime.process.restarts import Assignment
from birdslam.runtime.wire import Health, Trace
from birdslam.types import Status

PERIOD_NS = 1_000_000_000


class Meter:
    """Counts and times the frames of one node, in constant memory."""

    def __init__(self, node: str, configuration: Configuration, assignment: Assignment) -> None:
        self.frames = 0
        self.node, self._assignment = node, assignment
        self._budget_ms = configuration.budgets.step_ms(node)
        self._hop_ms = configuration.budgets.hop_ms(node)
        self._stale_ns = round(configuration.runtime.stale_ms * 1e6)
        self._wait, self._step, self._age = Recent(), Recent(), Recent()
        self._overruns = self._late = 0
        self._process = psutil.Process()
        self._process.cpu_percent()
        self._received_ns = self._reported_ns = time.monotonic_ns()
        self._frames_reported = 0

    def received(self, now_ns: int) -> None:
        """Records the time of the last input."""
        self._received_ns = now_ns

    def frame(self, t_capture_ns: int, trace: Trace) -> None:
        """Adds a finished frame; the last stage of `trace` is this node's.

        The wait in this node's queue counts against its budget.
        """
        self.frames += 1
        own = trace.stages[-1]
        done_ns, arrived_ns = own.done_ns, own.arrived_ns or own.received_ns
        sent_ns = trace.stages[-2].sent_ns if len(trace.stages) > 1 else t_capture_ns
        self._wait.add(max(0.0, (own.received_ns - sent_ns) / 1e6), done_ns)
        self._late += self._hop_ms is not None and (arrived_ns - sent_ns) / 1e6 > self._hop_ms
        self._step.add((done_ns - own.received_ns) / 1e6, done_ns)
        self._age.add(max(0.0, (done_ns - t_capture_ns) / 1e6), done_ns)
        self._overruns += (done_ns - arrived_ns) / 1e6 > self._budget_ms

    def due(self, now_ns: int) -> bool:
        """Whether a health is due."""
        return now_ns - self._reported_ns >= PERIOD_NS

    def health(self, now_ns: int, mode: str, counters: dict[str, int]) -> Health:
        """Returns the health to publish now."""
        rate_hz = (self.frames - self._frames_reported) * 1e9 / (now_ns - self._reported_ns)
        self._reported_ns, self._frames_reported = now_ns, self.frames
        return Health(
            node=self.node,
            t_ns=now_ns,
            frames=self.frames,
            rate_hz=rate_hz,
            wait=self._wait.spread(now_ns),
            step=self._step.spread(now_ns),
            age=self._age.spread(now_ns),
            overruns=self._overruns,
            late=self._late,
            rss_bytes=self._process.memory_info().rss,
            cpu_percent=self._process.cpu_percent(),
            mode=mode,
            restarts=self._assignment.restarts,
            cause=self._assignment.cause[:200],
            status=(Status.INPUT_STALE,) if now_ns - self._received_ns > self._stale_ns else (),
            **counters,
        )
