"""The optimize process: adds measurements to the pose graph and publishes an estimate of every frame in time."""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Iterator

import msgspec

from birdslam.geometry.se2 import SE2
from birdslam.graph.checkpoint import CheckpointError
from birdslam.graph.pose_graph import PoseGraph
from birdslam.runtime.configuration import Configuration
from birdslam.runtime.nodes.capture import stamps
from birdslam.runtime.nodes.checkpoints import CheckpointFile, checkpoint_path
from birdslam.runtime.nodes.coasting import (
    PENDING_FRAMES,
    REPORTED_LATE,
    Overdue,
    PendingFrames,
    deadline_ns,
    unmeasured,
    with_unreported,
)
from birdslam.runtime.nodes.degradation import Mode
from birdslam.runtime.process.restarts import FIRST, Assignment, EpochFile
from birdslam.runtime.transport.bus import Bus, Message
from birdslam.runtime.transport.presence import runtime_dir_of
from birdslam.types import Estimate, FrameRef, MapUpdate, Measurements, Status

log = logging.getLogger(__name__)


class OptimizeNode:
    """Measurements -> Estimate, MapUpdate: the pose graph.

    Frame numbers never decrease: measurements that arrive after their frame was predicted correct the graph, and the
    newest published frame is published again. After a restart the graph is restored from its last checkpoint and the
    later measurements that perceive retains (GRAPH_RESTORED); without them it starts a new epoch (GRAPH_RESET).
    """

    def __init__(self, configuration: Configuration, bus: Bus, assignment: Assignment = FIRST) -> None:
        self.ended = False
        self._measurements = bus.subscriber("measurements")
        self._pending = PendingFrames(deadline_ns(configuration))
        self._frames = None if configuration.lossless else bus.subscriber("frame", PENDING_FRAMES)
        self._coast_max_ns = round(configuration.degradation.coast_max_ms * 1e6)
        self._last: Estimate | None = None  # from measurements
        self._coasted: FrameRef | None = None  # the newest predicted frame
        self._coasted_frames = self._outrun = 0
        self._reported_frame = -1 if assignment.resume is None else assignment.resume.next_frame - 1
        self._reported_before = self._reported_frame  # by the previous process
        self._missed: deque[Message] = deque()  # measurements since the checkpoint
        self._missed_frame = -1  # the last frame among them
        self._epochs: EpochFile | None = None
        self._checkpoints: CheckpointFile | None = None
        self._checkpoint_ns, self._due_ns = round(configuration.runtime.checkpoint_ms * 1e6), 0
        if not configuration.lossless:  # a run at rate "max" is reproducible
            directory = runtime_dir_of(configuration.vehicle, configuration.runtime_dir)
            self._epochs = EpochFile(directory / "epoch")
            self._checkpoints = CheckpointFile(checkpoint_path(configuration))
        epoch = 0 if self._epochs is None else self._epochs.last + 1
        self._unreported = (Status.GRAPH_RESET,) if epoch else ()  # planners may hold poses of an older epoch
        restored = self._restored(configuration, bus, assignment)
        self._graph = restored or PoseGraph(configuration.slam.graph, configuration.slam.weights, epoch)

    def _restored(self, configuration: Configuration, bus: Bus, assignment: Assignment) -> PoseGraph | None:
        """Restores the graph of this run's last checkpoint, if no newer epoch was published."""
        if self._checkpoints is None or self._epochs is None:
            return None
        for checkpoint in self._checkpoints.take():
            if not assignment.restarts or checkpoint.epoch != self._epochs.last:
                continue
            try:
                graph = PoseGraph.restore(checkpoint.data, configuration.slam.graph, configuration.slam.weights)
            except CheckpointError as error:
                log.warning("the checkpoint of frame %d is unusable: it %s", checkpoint.frame_id, error)
                continue
            wait_s = configuration.runtime.catch_up_ms / 1e3
            if not bus.wait_alive({"perceive"}, wait_s):
                missed = bus.retained("measurements", wait_s)
                self._missed.extend(message for message in missed if message.record.frame_id > checkpoint.frame_id)
            if self._missed:
                self._missed_frame = self._missed[-1].record.frame_id
            log.warning(
                "restored the checkpoint of frame %d and %d later frames", checkpoint.frame_id, len(self._missed)
            )
            self._unreported = (Status.GRAPH_RESTORED,)
            return graph
        return None

    @property
    def mode(self) -> str:
        return Mode.COASTING if self._coasts else Mode.FULL

    @property
    def _coasts(self) -> bool:
        return self._coasted is not None and self._coasted.frame_id == self._reported_frame

    def receive(self, timeout_s: float) -> Message | None:
        """Returns the next measurements, or the frame whose measurements are overdue."""
        if self._missed:
            return self._missed.popleft()
        until_s = time.monotonic() + timeout_s
        while True:
            self._collect_frames()
            left_s = max(0.0, until_s - time.monotonic())
            message = self._measurements.recv(min(left_s, self._pending.wait_s(time.monotonic_ns())))
            if message is not None and message.record.frame_id <= self._missed_frame:
                continue  # already added
            if message is not None:
                self._pending.answered(message.record.frame_id)
                return message
            late = self._pending.overdue(time.monotonic_ns())
            if late is not None or time.monotonic() >= until_s:
                return late

    def _collect_frames(self) -> None:
        while self._frames is not None and (message := self._frames.recv(0.0)) is not None:
            self._pending.add(message)

    def step(self, record: Measurements | Overdue) -> Iterator[Estimate | MapUpdate]:
        if isinstance(record, Overdue):
            self._coasted = record.ref
            self._coasted_frames += 1
            yield self._report(self._coast(record.ref))
            return
        if Status.END_OF_SOURCE in record.status:
            self.ended = True
            yield from self._end(record)
            return
        estimate = self._last = self._graph.optimise(record)
        if estimate.frame_id <= self._reported_before:
            self._graph.map_update()  # published before the restart
            return
        if estimate.frame_id >= self._reported_frame:
            yield self._report(estimate)
        else:
            self._outrun += 1
            self._unreported = (*self._unreported, *(s for s in estimate.status if s in REPORTED_LATE))
            if self._coasted is not None and self._coasts:
                yield self._report(self._coast(self._coasted))
        gained = self._graph.map_update()
        if gained is not None:
            yield gained
        self._store_checkpoint(record.frame_id)  # after the records are sent, so that it delays none

    def _store_checkpoint(self, frame_id: int) -> None:
        """Stores a checkpoint if one is due."""
        now_ns = time.monotonic_ns()
        if self._checkpoints is not None and now_ns >= self._due_ns:
            self._checkpoints.store(frame_id, self._graph.epoch, self._graph.checkpoint())
            self._due_ns = now_ns + self._checkpoint_ns

    def _coast(self, ref: FrameRef) -> Estimate:
        """Predicts a frame without measurements; the graph does not change."""
        return self._graph.optimise(unmeasured(ref, self._last, self._coast_max_ns))

    def _report(self, estimate: Estimate) -> Estimate:
        """Returns the estimate to publish, with the statuses that were not published yet."""
        estimate, self._unreported = with_unreported(estimate, self._unreported), ()
        self._reported_frame = estimate.frame_id
        if self._epochs is not None:
            self._epochs.store(estimate.epoch)
        return estimate

    def _end(self, measurements: Measurements) -> Iterator[Estimate | MapUpdate]:
        """Completes the map, with the frame id of the end, before the estimate that ends the run."""
        epoch = self._graph.epoch
        gained = self._graph.map_update() or MapUpdate(epoch=epoch, frame_id=measurements.frame_id)
        yield msgspec.structs.replace(gained, frame_id=measurements.frame_id)
        yield end_estimate(measurements, epoch, self._last)

    def drain(self) -> None:
        """Does nothing: optimize ends with END_OF_SOURCE."""

    def counters(self) -> dict[str, int]:
        taken = self._measurements
        counted = {"coasted": self._coasted_frames, "outrun": self._outrun}
        return {"dropped": taken.dropped, "malformed": taken.malformed, **counted}

    def close(self) -> None:
        """Does nothing."""


def end_estimate(measurements: Measurements, epoch: int, last: Estimate | None) -> Estimate:
    """Returns the estimate that ends a run, at the pose of the last one."""
    return Estimate(
        **stamps(measurements),
        epoch=epoch,
        T_world_ego=last.T_world_ego if last else SE2(),
        cov=last.cov if last else (0.0,) * 9,
        valid=False,
        status=measurements.status,
    )
