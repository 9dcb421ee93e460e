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
    """A frame that capture has announced, and whose measurements are late."""

    ref: FrameRef


class PendingFrames:
    """The frames that capture has announced and perceive has not answered, oldest first."""

    def __init__(self, deadline_ns: int) -> None:
        self._deadline_ns = deadline_ns  # from a frame's capture on
        self._waiting: deque[Message] = deque(maxlen=PENDING_FRAMES)
        self._answered_frame = -1

    def add(self, message: Message) -> None:
        """One more; END_OF_SOURCE is no frame, and an answer may be taken up before the frame that it answers."""
        if Status.END_OF_SOURCE not in message.record.status and message.record.frame_id > self._answered_frame:
            self._waiting.append(message)

    def answered(self, frame_id: int) -> None:
        """This frame is, and with it all before it: perceive goes in their order, and leaves some out."""
        self._answered_frame = max(self._answered_frame, frame_id)
        while self._waiting and self._waiting[0].record.frame_id <= frame_id:
            self._waiting.popleft()

    def wait_s(self, now_ns: int) -> float:
        """How long until one is overdue, as far as is known; never longer than the deadline itself."""
        if not self._waiting:
            return self._deadline_ns / 1e9
        return max(0.0, (self._waiting[0].record.t_capture_ns + self._deadline_ns - now_ns) / 1e9)

    def overdue(self, now_ns: int) -> Message | None:
        """The newest frame that is, as Overdue; those before it are not reported any more."""
        newest = None
        while self._waiting and now_ns - self._waiting[0].record.t_capture_ns >= self._deadline_ns:
            newest = self._waiting.popleft()
        return None if newest is None else Message(Overdue(newest.record), newest.trace, newest.t_received_ns)


def deadline_ns(configuration: Configuration) -> int:
    """By when measurements must have come, for an estimate to reach the planner within the budget end to end."""
    budgets = configuration.budgets
    return round((budgets.end_to_end_ms - budgets.optimize_ms - budgets.optimize_to_planner_ms) * 1e6)


def unmeasured(ref: FrameRef, last: Estimate | None, max_ns: int) -> Measurements:
    """Stands in for a frame's measurements meanwhile; `last` is the last estimate that rests on some.

    What made that one invalid still holds, and after `max_ns` of source time without measurements all is. The ego's
    height and tilt are those of that one.
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
    """The estimate with statuses that were not reported yet; of GRAPH_RESET and GRAPH_RESTORED the former alone."""
    status = tuple(dict.fromkeys((*estimate.status, *unreported)))
    if Status.GRAPH_RESET in status:
        status = tuple(s for s in status if s != Status.GRAPH_RESTORED)
    return estimate if status == estimate.status else msgspec.structs.replace(estimate, status=status)
