"""Replays recorded measurements through the back end alone: `compare` with the recording, or `estimates`.

The trace of each estimate names its measurements. Measurements without an estimate were not received by the optimizer,
or their estimate was lost. After a restart the optimizer started a new epoch or continued from its checkpoint. If the
recording lacks measurements that it had, comparison stops until the next epoch.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import msgspec

from birdslam.graph.checkpoint import CheckpointError
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.pose_graph import PoseGraph
from birdslam.graph.weights import WeightsConfig
from birdslam.runtime.configuration import DegradationConfig
from birdslam.runtime.nodes.coasting import REPORTED_LATE, unmeasured, with_unreported
from birdslam.runtime.nodes.optimize import end_estimate
from birdslam.runtime.recording.recording import CHECKPOINT, Alive, GraphCheckpoint, Recording, RecordingError
from birdslam.runtime.replay.verdict import Difference, Verdict, differing
from birdslam.runtime.wire import Trace, WireError, decode, encode
from birdslam.types import Estimate, FrameRef, MapUpdate, Measurements, Status

BackEnd = tuple[GraphConfig, WeightsConfig]
MAX_WAITING = 64  # estimates that wait for measurements, or a frame, written after them
MAX_FRAMES = 256  # stored frame references, for frames that the optimizer predicted
COMPARED = (
    *("v1/frame", "v1/measurements", "v1/measurements/trace", "v1/estimate", "v1/estimate/trace"),
    *("v1/map", "/alive"),
)


class _Message(msgspec.Struct):
    data: bytes
    trace: Trace


@dataclass
class _State:
    """The state of the optimizer that determines its estimates."""

    graph: PoseGraph
    last: Estimate | None = None  # from measurements
    unreported: tuple[Status, ...] = ()
    maps: list[MapUpdate] = field(default_factory=list)

    def measure(self, measurements: Measurements) -> Estimate:
        """Returns the estimate of a frame, as OptimizeNode.step does."""
        if Status.END_OF_SOURCE in measurements.status:
            return end_estimate(measurements, self.graph.epoch, self.last)
        self.last = self.graph.optimise(measurements)
        gained = self.graph.map_update()
        self.maps = [gained] if gained else []
        return self.last

    def report(self, estimate: Estimate) -> Estimate:
        """Returns the estimate with the unreported statuses."""
        reported, self.unreported = with_unreported(estimate, self.unreported), ()
        return reported


class Comparison:
    """Compares a recording with its replay in one pass."""

    def __init__(self, recording: Recording) -> None:
        self.verdict = Verdict()
        self._recording = recording
        self._back_end = back_end(recording)
        self._coast_max_ns = round(recording.part("degradation", DegradationConfig).coast_max_ms * 1e6)
        self._state: _State | None = None
        self._measurements: deque[_Message] = deque()
        self._estimates: deque[_Message] = deque()
        self._frames: dict[int, FrameRef] = {}
        self._maps: dict[int, MapUpdate] = {}
        self._alive = 0  # number of starts of the optimizer
        self._checkpoint = _checkpoint(recording)
        self._since: list[Measurements] = []  # measurements after it, for the first comparable estimate
        self._epoch: int | None = None
        self._number = 0  # of the last estimate, counted per process
        self._alive_before = 0  # starts of the optimizer at the last estimate
        self._lost = False  # whether estimates before this one were lost
        self._reported_frame = -1

    def run(self) -> Verdict:
        """Returns the verdict. Raises RecordingError for an invalid record."""
        data = b""
        for message in self._recording.messages(COMPARED):
            if message.channel in ("v1/measurements", "v1/estimate"):
                data = message.data
            elif message.channel == "v1/measurements/trace":
                self._measurements.append(_Message(data, _record(message.data, Trace)))
            elif message.channel == "v1/estimate/trace":
                self._estimates.append(_Message(data, _record(message.data, Trace)))
            elif message.channel == "v1/frame":
                ref = _record(message.data, FrameRef)
                self._frames[ref.frame_id] = ref
                if len(self._frames) > MAX_FRAMES:
                    del self._frames[next(iter(self._frames))]
            elif message.channel == "v1/map":
                self._compare_map(_record(message.data, MapUpdate))
            else:
                event = msgspec.json.decode(message.data, type=Alive)
                self._alive += event.alive and event.node == "optimize"
            self._compare_estimates(MAX_WAITING)
            if self.verdict.difference is not None:
                return self.verdict
        if not self._recording.complete:
            self._drop_open_end()
        self._compare_estimates(0)
        self.verdict.open_end += len(self._measurements)
        return self.verdict

    def _drop_open_end(self) -> None:
        """Removes the last estimates of a truncated file whose measurements are lost."""
        recorded = [m.trace.stages for m in self._measurements]
        while self._estimates:
            cause = self._estimates[-1].trace.stages[:-1]
            if not cause or cause[-1].node != "perceive" or cause in recorded:
                return
            self._estimates.pop()
            self.verdict.open_end += 1

    def _compare_estimates(self, max_waiting: int) -> None:
        """Replays the estimates whose measurements or frame are read; at most `max_waiting` wait for theirs."""
        while self._estimates and self.verdict.difference is None:
            message = self._estimates[0]
            cause = message.trace.stages[:-1]
            by_measurements = bool(cause) and cause[-1].node == "perceive"
            place = next((i for i, m in enumerate(self._measurements) if m.trace.stages == cause), None)
            estimate = _record(message.data, Estimate)
            missing = place is None if by_measurements else estimate.frame_id not in self._frames
            if missing and len(self._estimates) <= max_waiting:
                return
            self._estimates.popleft()
            self.verdict.epochs += estimate.epoch != self._epoch
            self._epoch = estimate.epoch
            number = message.trace.number
            again = self._alive > self._alive_before or number <= self._number
            self._lost = number > (1 if again else self._number + 1)
            self._number, self._alive_before = number, self._alive
            if not by_measurements:
                taken = self._replay(estimate, message.data, self._reported_before(estimate), None)
                for _ in range(taken):
                    self._measurements.popleft()
                self.verdict.unanswered += taken
            elif place is None:  # the recording lacks measurements of the optimizer
                self._state = None
                self.verdict.unknown += 1
            else:
                given = [_record(self._measurements.popleft().data, Measurements) for _ in range(place + 1)]
                self.verdict.unanswered += place
                self._replay(estimate, message.data, given[:-1], given[-1])
            self._reported_frame = max(self._reported_frame, estimate.frame_id)

    def _replay(self, estimate: Estimate, data: bytes, open_: list[Measurements], answered: Measurements | None) -> int:
        """Replays one estimate under each hypothesis about the optimizer; the difference to the last one is reported.

        Returns how many of the measurements `open_` it used.
        """
        likeliest: Estimate | None = None
        unseen = self._began_unseen(estimate)
        for state, given, restarts in self._hypotheses(estimate, open_, answered):
            replayed = self._replayed(state, given, estimate)
            if replayed is None:
                continue
            likeliest = replayed
            if _canonical(replayed) == data:
                self._state = state
                self._maps |= {gained.frame_id: gained for gained in state.maps}
                self.verdict.equal += 1
                self.verdict.coasted += answered is None
                self.verdict.restarts += restarts
                return len(given) - (answered is not None)
        now = self._state
        # Its checkpoint is older than the replayed state, and it did not receive the measurements since
        behind = self._came_back and Status.GRAPH_RESTORED in estimate.status
        if behind:
            self.verdict.restarts += self._came_back
        if unseen or behind or (now is not None and (open_ or now.graph.epoch != estimate.epoch)):
            self._state = None
        elif now is not None:
            now.unreported = ()  # this estimate has reported it
        if likeliest is None or unseen or behind:
            self.verdict.unknown += 1
        else:
            self.verdict.difference = Difference(estimate.frame_id, differing(estimate, likeliest))
        return 0

    @property
    def _came_back(self) -> int:
        """Number of restarts of the optimizer since the last equal estimate."""
        return max(0, self._alive - 1 - self.verdict.restarts)

    def _began_unseen(self, estimate: Estimate) -> bool:
        """Whether the first estimate of this epoch was not recorded: it was lost, or its sender was killed."""
        began = self._state is not None and estimate.epoch > self._state.graph.epoch
        killed = self._came_back > 1 and Status.GRAPH_RESTORED in estimate.status
        return began and (self._lost or killed) and Status.GRAPH_RESET not in estimate.status

    def _reported_before(self, estimate: Estimate) -> list[Measurements]:
        """Returns the next measurements of already published frames, which a restored graph may contain."""
        if self._state is None or Status.GRAPH_RESTORED not in estimate.status:
            return []
        waiting = (_record(message.data, Measurements) for message in self._measurements)
        return list(itertools.takewhile(lambda m: m.frame_id <= self._reported_frame, waiting))

    def _hypotheses(
        self, estimate: Estimate, open_: list[Measurements], answered: Measurements | None
    ) -> Iterator[tuple[_State, list[Measurements], int]]:
        """Yields (state before, measurements added to it, number of restarts of the optimizer)."""
        now = [] if answered is None else [answered]
        new_world = Status.GRAPH_RESET in estimate.status
        checkpoint = self._checkpoint
        if self._state is None:
            at_first = self.verdict.equal + self.verdict.unknown == 0 and checkpoint is None
            if checkpoint is not None:
                self._since += [m for m in (*open_, *now) if m.frame_id > checkpoint.frame_id]
                answered_in_time = bool(now and self._since) and self._since[-1].frame_id == estimate.frame_id
                if answered_in_time and estimate.epoch == checkpoint.epoch:
                    yield _State(PoseGraph.restore(checkpoint.data, *self._back_end)), self._since, 0
            if new_world or at_first:
                yield self._fresh(estimate), now, 0
            return
        came_back = self._came_back
        restored = (Status.GRAPH_RESTORED,) if came_back and Status.GRAPH_RESTORED in estimate.status else ()
        if came_back and new_world:
            yield self._fresh(estimate), now, 1
            yield self._copy(), now, 1  # from its checkpoint, without the retained measurements
        if restored:
            for last, given in itertools.product((self._state.last, None), ([*open_, *now], now)):
                yield self._copy(last, restored), given, 1
        if self._began_unseen(estimate):
            started = min(came_back, 2 if restored else 1)  # the process that started the epoch, and its successor
            for start in range(len(open_)):
                graph = PoseGraph(*self._back_end, estimate.epoch)
                yield _State(graph, unreported=restored), [*open_[start:], *now], started
        if open_:
            yield self._copy(), now, 0
        yield self._state, [*open_, *now], 0

    def _copy(self, *changed: Any) -> _State:
        """Copies the current state for a hypothesis, optionally with another `last` and `unreported`."""
        assert self._state is not None
        graph = PoseGraph.restore(self._state.graph.checkpoint(), *self._back_end)
        return _State(graph, *(changed or (self._state.last, self._state.unreported)))

    def _fresh(self, estimate: Estimate) -> _State:
        """Returns a new graph, with GRAPH_RESET if the estimate has it."""
        unreported = (Status.GRAPH_RESET,) if Status.GRAPH_RESET in estimate.status else ()
        return _State(PoseGraph(*self._back_end, estimate.epoch), unreported=unreported)

    def _replayed(self, state: _State, given: list[Measurements], estimate: Estimate) -> Estimate | None:
        """Returns the replayed estimate of the frame; None if it can't be determined."""
        replayed = None
        for measurements in given:
            replayed = state.measure(measurements)
        if replayed is not None and replayed.frame_id < estimate.frame_id:  # late: a newer frame was predicted
            state.unreported = (*state.unreported, *(s for s in replayed.status if s in REPORTED_LATE))
        if replayed is None or replayed.frame_id != estimate.frame_id:
            ref = self._frames.get(estimate.frame_id)
            if ref is None:
                return None
            replayed = state.graph.optimise(unmeasured(ref, state.last, self._coast_max_ns))
        if Status.END_OF_SOURCE in replayed.status:
            return replayed
        return state.report(replayed)

    def _compare_map(self, recorded: MapUpdate) -> None:
        """Compares the map update of a frame, which is written after its estimate."""
        self._compare_estimates(MAX_WAITING)
        replayed = self._maps.pop(recorded.frame_id, None)
        if replayed is None:
            return
        if _canonical(replayed) == encode(recorded):
            self.verdict.maps += 1
        elif self.verdict.difference is None:
            self.verdict.difference = Difference(recorded.frame_id, differing(recorded, replayed))


def _checkpoint(recording: Recording) -> GraphCheckpoint | None:
    """Returns the graph at the start of a file without the start of its drive. Raises RecordingError."""
    if not recording.about.restarts:
        return None
    for message in recording.messages((CHECKPOINT,)):
        try:
            checkpoint = msgspec.msgpack.decode(message.data, type=GraphCheckpoint)
            PoseGraph.restore(checkpoint.data, *back_end(recording))
        except (msgspec.DecodeError, CheckpointError) as error:
            raise RecordingError(f"{recording.path}: its checkpoint {error}") from None
        return checkpoint
    return None


def compare(recording: Recording) -> Verdict:
    """Compares the back end's estimates with the recorded ones, bit for bit."""
    return Comparison(recording).run()


def back_end(recording: Recording) -> BackEnd:
    """Returns the recorded configuration of the graph. Raises RecordingError if it is of another version."""
    return recording.part("slam.graph", GraphConfig), recording.part("slam.weights", WeightsConfig)


def estimates(recording: Recording, config: BackEnd) -> Iterator[Measurements | Estimate | MapUpdate]:
    """Yields estimates and map updates of the recorded measurements with another configuration."""
    graph = PoseGraph(*config)
    for message in recording.messages(("v1/measurements",)):
        measurements = _record(message.data, Measurements)
        if Status.END_OF_SOURCE in measurements.status:
            continue
        yield measurements
        yield graph.optimise(measurements)
        gained = graph.map_update()
        if gained is not None:
            yield gained


def _canonical(record: msgspec.Struct) -> bytes:
    """Returns the record's bytes after decoding and encoding again."""
    return encode(decode(encode(record), type(record)))


def _record(data: bytes, kind: type[Any]) -> Any:
    try:
        return decode(data, kind)
    except WireError as error:
        raise RecordingError(f"the recording has an invalid {kind.__name__}: {error}") from None
