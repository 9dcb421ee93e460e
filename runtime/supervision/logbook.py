"""The supervisor's subscriber: passes every estimate and map update to the results, and counts them."""

from __future__ import annotations

import os
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from typing import Any, Protocol, TypeVar

from birdslam.runtime.latency import Distribution, stages
from birdslam.runtime.progress import time_to_go
from birdslam.runtime.transport.bus import Bus, BusClosed, Message
from birdslam.types import Estimate, MapUpdate, Status

QUEUE_FRAMES = 1024  # no loss if the disk stalls for half a minute
MAP_WAIT_S = 2.0  # for the last map update, which optimize sends before the end
RECENT_FRAMES = 32


_Record = TypeVar("_Record", Estimate, MapUpdate)


class Results(Protocol):
    """Receives the results of a drive while it runs, as `birdslam.outputs.drive_files.Recorder` does."""

    def add(self, estimate: Estimate) -> None: ...
    def add_map(self, update: MapUpdate) -> None: ...


class Logbook:
    """Subscribes in a thread, as a planner does, so that its ages are a planner's.

    `event_fd` becomes readable after END_OF_SOURCE (`ended`) or a failure to write (`error`). If `tolerant`, a disk
    failure only ends the writing (reason in `unwritten`). `listeners` receive the same records as `results`.
    """

    def __init__(self, bus: Bus, results: Results, tolerant: bool = False, listeners: Sequence[Results] = ()) -> None:
        self.event_fd = os.eventfd(0)
        self.ended = False
        self.error: Exception | None = None
        self.unwritten: OSError | None = None
        self._tolerant = tolerant
        self.recorded = 0
        self.age = Distribution()
        self.stages: dict[str, Distribution] = {}
        self.statuses: Counter[str] = Counter()
        self.predicted = 0  # frames that perceive predicted
        self.speed_sources: Counter[str] = Counter()
        self._results = results
        self._listeners = tuple(listeners)
        self._bus = bus
        self._estimates = bus.subscriber("estimate", depth=QUEUE_FRAMES)
        self._map = bus.subscriber("map", depth=QUEUE_FRAMES)
        self._first_ns = self._last_ns = 0
        self._recent: deque[tuple[int, float]] = deque(maxlen=RECENT_FRAMES)  # received (ns), age (ms)
        self._latest: Estimate | None = None
        self._map_frame = -1  # of the newest map update
        self._started = self._done = 0  # estimates whose processing has started, and has ended
        self._thread = threading.Thread(target=self._run, name="logbook", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            while not self.ended:
                message = self._estimates.recv()
                if message is not None:
                    self._started += 1
                    self._take(message)
                    self._done += 1
        except BusClosed:
            return
        except Exception as error:  # reported by the supervisor
            self.error = error
        finally:
            os.eventfd_write(self.event_fd, 1)

    def _take(self, message: Message) -> None:
        estimate: Estimate = message.record
        if Status.END_OF_SOURCE in estimate.status:
            self._take_map(until_frame=estimate.frame_id)
            self.ended = True
            return
        self.statuses.update(status.value for status in estimate.status)
        self.speed_sources.update(source.value for source in estimate.speed_sources)
        self._latest = estimate
        if Status.PERCEPTION_LATE in estimate.status:  # without measurements: not counted as processed
            return
        self.predicted += Status.COASTING in estimate.status
        for listener in self._listeners:
            listener.add(estimate)
        self._write(self._results.add, estimate)
        self._take_map()
        age_ms = (message.t_received_ns - estimate.t_capture_ns) / 1e6
        self.age.add(age_ms)
        for name, ms in stages(message.trace, message.t_received_ns):
            self.stages.setdefault(name, Distribution()).add(ms)
        self._first_ns = self._first_ns or message.t_received_ns
        self._last_ns = message.t_received_ns
        self._recent.append((message.t_received_ns, age_ms))
        self.recorded += 1

    def _write(self, add: Callable[[_Record], None], record: _Record) -> None:
        if self.unwritten is not None:
            return
        try:
            add(record)
        except OSError as error:
            if not self._tolerant:
                raise
            self.unwritten = error

    def _take_map(self, until_frame: int | None = None) -> None:
        """Takes the map updates that have arrived; with `until_frame`, waits for the update of that frame."""
        until_s = time.monotonic() + (MAP_WAIT_S if until_frame is not None else 0.0)
        while self._map_frame != until_frame:
            message = self._map.recv(max(0.0, until_s - time.monotonic()))
            if message is None:
                return
            for listener in self._listeners:
                listener.add_map(message.record)
            self._write(self._results.add_map, message.record)
            self._map_frame = message.record.frame_id

    @property
    def rate_hz(self) -> float:
        """The mean rate of the run."""
        span_ns = self._last_ns - self._first_ns
        return (self.recorded - 1) * 1e9 / span_ns if span_ns > 0 else 0.0

    def status_line(self, frames: int | None = None) -> str:
        """Returns rate, age, tracks and statuses of the newest frames. `frames`: the number of frames of the source."""
        recent, latest = tuple(self._recent), self._latest
        if latest is None or not recent:
            return "waiting for the first frame"
        span_ns = recent[-1][0] - recent[0][0]
        rate_hz = (len(recent) - 1) * 1e9 / span_ns if span_ns > 0 else 0.0
        ages = sorted(age for _, age in recent)
        trouble = " ".join(status.value for status in latest.status)
        to_go = ""
        if frames is not None and self.rate_hz > 0.0:
            to_go = f" of {frames}, {time_to_go((frames - 1 - latest.frame_id) / self.rate_hz)} to go"
        return (
            f"frame {latest.frame_id}{to_go}  {rate_hz:.1f} Hz  "
            f"age {ages[len(ages) // 2]:.0f} ms (max {ages[-1]:.0f})  tracks {len(latest.vehicles)}  "
            f"{'valid' if latest.valid else 'NOT VALID'}  {trouble}"
        ).rstrip()

    def figures(self) -> dict[str, Any]:
        """Returns the entries of summary.json."""
        return {
            "rate_hz": round(self.rate_hz, 3),
            "age_ms": self.age.summary(),
            "stages_ms": {name: distribution.summary() for name, distribution in self.stages.items()},
            "statuses": dict(sorted(self.statuses.items())),
            "speed_sources": dict(sorted(self.speed_sources.items())),
        }

    @property
    def unread(self) -> int:
        """The number of estimates that have arrived and wait to be written."""
        return self._estimates.unread

    def wait_over(self, idle_s: float, stalled_s: float) -> None:
        """Waits until the end was processed, or recording failed.

        At most `idle_s` for the next estimate to arrive, and `stalled_s` for one to be written.
        """
        while self._thread.is_alive():
            before = self._started, self._done
            self._thread.join(stalled_s if self.unread or self._started > self._done else idle_s)
            if before == (self._started, self._done):
                return

    def close(self) -> None:
        """Closes the bus, which ends the thread."""
        self._bus.close()
        self._thread.join()
        os.close(self.event_fd)
