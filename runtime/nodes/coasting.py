"""Frames whose measurements are late: the optimizer publishes a prediction with a growing covariance.

A planner gets an estimate of each frame within its latency budget, also if perceive is dead, stalled or slow. The
prediction does not enter the graph; late measurements are added as if they had arrived in time.
"""

from __future__ import annotations

from collections import deque

import msgspec

from birdslam.runtime.configuration import Configuration
from birdslam.runtime.nodes.capture import stamps
from birdslam.runtime.transport.bus import Message
from birdslam.types import INVALIDATING, Attitude, Estimate, FrameRef, Measurements, Status

PENDING_FRAMES = 64  # more than are captured within any deadline
# Statuses that go with the next frame, where their own was late
REPORTED_LATE = frozenset({Status.GRAPH_RESET, Status.GRAPH_RESTORED})


class Overdue(msgspec.Struct, frozen=True):
    """A frame announced by capture whose measurements are late."""

    ref: FrameRef


class PendingFrames:
    """The frames announced by capture and not yet answered by perceive, oldest first."""

    def __init__(self, deadline_ns: int) -> None:
        self._deadline_ns = deadline_ns  # from a frame's capture on
        self._waiting: deque[Message] = deque(maxlen=PENDING_FRAMES)
        self._answered_frame = -1

    def add(self, message: Message) -> None:
        """Adds a frame, unless it is END_OF_SOURCE or its answer has already arrived."""
        if Status.END_OF_SOURCE not in message.record.status and message.record.frame_id > self._answered_frame:
            self._waiting.append(message)

    def answered(self, frame_id: int) -> None:
        """Removes this frame and all earlier ones, since perceive answers in order and may drop frames."""
        self._answered_frame = max(self._answered_frame, frame_id)
        while self._waiting and self._waiting[0].record.frame_id <= frame_id:
            self._waiting.popleft()

    def wait_s(self, now_ns: int) -> float:
        """Returns the time until a frame is overdue, in s, at most the deadline."""
        if not self._waiting:
            return self._deadline_ns / 1e9
        return max(0.0, (self._waiting[0].record.t_capture_ns + self._deadline_ns - now_ns) / 1e9)

    def overdue(self, now_ns: int) -> Message | None:
        """Returns the newest overdue frame as Overdue and discards the earlier ones; None if no frame is overdue."""
        newest = None
        while self._waiting and now_ns - self._waiting[0].record.t_capture_ns >= self._deadline_ns:
            newest = self._waiting.popleft()
        return None if newest is None else Message(Overdue(newest.record), newest.trace, newest.t_received_ns)


def deadline_ns(configuration: Configuration) -> int:
    """Returns the latest arrival of measurements after capture, in ns, that meets the end-to-end budget."""
    budgets = configuration.budgets
    return round((budgets.end_to_end_ms - budgets.optimize_ms - budgets.optimize_to_planner_ms) * 1e6)


def unmeasured(ref: FrameRef, last: Estimate | None, max_ns: int) -> Measurements:
    """Predicts an estimate for a frame without measurements; `last` is the last estimate with measurements.

    It keeps the height, the tilt and the invalidating statuses of `last`, and is invalid after `max_ns` of source time
    without measurements.
    """
    status = [*ref.status, Status.COASTING, Status.PERCEPTION_LATE]
    if last is None:
        status.append(Status.NOT_INITIALISED)
    else:
        status += [s for s in last.status if s in INVALIDATING]
        if ref.t_source_ns - last.t_source_ns > max_ns:
            status.append(Status.COASTED_TOO_LONG)
    attitude = Attitude() if last is None else last.attitude
    return Measurements(**stamps(ref), status=tuple(dict.fromkeys(status)), attitude=attitude)


def with_unreported(estimate: Estimate, unreported: tuple[Status, ...]) -> Estimate:
    """Returns the estimate with the unreported statuses added; GRAPH_RESET replaces GRAPH_RESTORED."""
    status = tuple(dict.fromkeys((*estimate.status, *unreported)))
    if Status.GRAPH_RESET in status:
        status = tuple(s for s in status if s != Status.GRAPH_RESTORED)
    return estimate if status == estimate.status else msgspec.structs.replace(estimate, status=status)
