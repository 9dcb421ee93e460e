"""A recording made frame by frame, with an optimizer that the test steps."""

from __future__ import annotations

from collections import deque
from pathlib import Path
from typing import Any

import msgspec

from birdslam.geometry.camera import Camera
from birdslam.perf.latency.drive import DriveConfig, drive
from birdslam.runtime.configuration import Configuration, RuntimeConfig
from birdslam.runtime.nodes.capture import stamps
from birdslam.runtime.nodes.checkpoints import CheckpointFile
from birdslam.runtime.nodes.coasting import Overdue
from birdslam.runtime.nodes.optimize import OptimizeNode
from birdslam.runtime.nodes.recorder import about
from birdslam.runtime.process.restarts import FIRST, Assignment, Resume
from birdslam.runtime.recording.recording import Alive, RecordingWriter
from birdslam.runtime.transport.bus import Message
from birdslam.runtime.transport.presence import runtime_dir_of
from birdslam.runtime.wire import Stage, Trace
from birdslam.types import Estimate, FrameRef, MapUpdate, Measurements, Status
from tests.test_bus import until

CAMERA = Camera(640, 192, 360.0, 360.0, 320.0, 96.0, 1.65)


def measured(frames: int, seed: int = 1) -> list[Measurements]:
    """A drive among vehicles, with lanes and landmarks; its stamps are those of a camera of 33 Hz."""
    config = DriveConfig(frames=frames, vehicles=4, landmarks=12)
    return [
        msgspec.structs.replace(m, t_capture_ns=m.t_source_ns, t_utc_ns=10**18 + m.t_source_ns)
        for m in drive(config, seed).measurements
    ]


class Perceive:
    """What the optimizer sees of perceive, and of the bus: nothing comes by itself."""

    dropped = malformed = 0

    def __init__(self) -> None:
        self.sent: deque[Message] = deque(maxlen=96)

    def subscriber(self, topic: str, depth: int | None = None) -> Perceive:
        return self

    def recv(self, timeout_s: float | None = None) -> None:
        return None

    def wait_alive(self, nodes: Any, timeout_s: float) -> set[str]:
        return set()

    def forget(self, but_last: int) -> None:
        """As after a longer drive than it keeps measurements of."""
        while len(self.sent) > but_last:
            self.sent.popleft()

    def retained(self, topic: str, timeout_s: float = 0.0) -> list[Message]:
        return list(self.sent)


class Tape:
    """Records the messages of an optimizer; reports those that never reached the recorder."""

    def __init__(self, place: Path, **config: Any) -> None:
        self.path = place / "drive.mcap"
        runtime = RuntimeConfig(runtime_dir=str(place / "rt"), checkpoint_ms=1e-3)
        self.configuration = Configuration(vehicle="tape", camera=CAMERA, runtime=runtime, **config)
        (place / "rt").mkdir(mode=0o700, parents=True)
        self.writer = RecordingWriter(self.path, about(self.configuration, {}), CAMERA, flush_ms=1e-3, sync=False)
        self.perceive = Perceive()
        self.estimates: list[Estimate] = []
        self._told: FrameRef | Measurements | None = None
        self._restarts = 0
        self._sent = 0  # estimates, by the optimizer at hand
        self._now_ns = 0
        self._begin(FIRST)

    def _begin(self, assignment: Assignment) -> None:
        self.writer.draw("/alive", Alive(node="optimize", alive=True), self.tick())
        self._sent = 0
        self.node = OptimizeNode(self.configuration, self.perceive, assignment)

    def tick(self) -> int:
        self._now_ns += 1_000_000
        return self._now_ns

    def _trace(self, *nodes: str) -> Trace:
        return Trace(tuple(Stage(node, self.tick(), self.tick(), self.tick()) for node in nodes))

    def frame(self, measurements: Measurements) -> FrameRef:
        """Capture announces it."""
        ref = FrameRef(**stamps(measurements))
        self.writer.add("frame", ref, self.tick())
        return ref

    def send(self, measurements: Measurements, recorded: bool = True) -> Message:
        """Perceive sends measurements."""
        message = Message(measurements, self._trace("capture", "perceive"), self._now_ns)
        self.perceive.sent.append(message)
        if recorded:
            self.writer.add("measurements", measurements, self.tick(), message.trace)
        return message

    def take(self, message: Message, recorded: bool = True) -> None:
        """The optimizer takes something up."""
        for out in self.node.step(message.record):
            trace = message.trace.after("optimize", self.tick(), self.tick())
            self._sent += isinstance(out, Estimate)
            trace = trace.sent(self.tick(), number=self._sent if isinstance(out, Estimate) else 0)
            if isinstance(out, Estimate):
                self._told = message.record
                self.estimates.append(out)
            if recorded:
                self.writer.add("estimate" if isinstance(out, Estimate) else "map", out, self.tick(), trace)
            assert isinstance(out, Estimate | MapUpdate)
        self.writer.flush_if_due(self.tick())

    def coast(self, ref: FrameRef) -> None:
        """A frame is overdue."""
        self.take(Message(Overdue(ref), self._trace("capture"), self._now_ns))

    def step(self, *frames: Measurements) -> None:
        """Frames as they should be."""
        for measurements in frames:
            self.frame(measurements)
            self.take(self.send(measurements))

    def lose(self, *frames: Measurements) -> None:
        """Frames that the optimizer does not take up."""
        for measurements in frames:
            self.frame(measurements)
            self.send(measurements)

    def restart(self, with_checkpoint: bool, noticed: bool = True) -> None:
        """The optimizer is killed, and restarted."""
        self._restarts += 1
        if not with_checkpoint:
            CheckpointFile(runtime_dir_of("tape", self.configuration.runtime_dir) / "checkpoint").take()
        if noticed:
            self.writer.draw("/alive", Alive(node="optimize", alive=False), self.tick())
        last = self.estimates[-1]
        resume = Resume(last.frame_id + 1, last.t_source_ns, last.t_capture_ns)
        assignment = Assignment(self._restarts, "was killed by a test", resume)
        if noticed:
            self._begin(assignment)
        else:
            self.node = OptimizeNode(self.configuration, self.perceive, assignment)
        while (message := self.node.receive(0.0)) is not None:
            self.take(message)

    def end(self, measurements: Measurements) -> None:
        """END_OF_SOURCE."""
        ended = Measurements(
            frame_id=measurements.frame_id + 1,
            t_source_ns=measurements.t_source_ns,
            t_capture_ns=measurements.t_capture_ns,
            t_utc_ns=measurements.t_utc_ns,
            status=(Status.END_OF_SOURCE,),
        )
        self.take(self.send(ended))
        self.close()

    def killed(self, path: Path) -> None:
        """Copies what a recorder that is killed now leaves, the disk having caught up with what it was handed."""
        until(lambda: self.writer.written_bytes == self.writer.handed_bytes, "the disk, which catches up")
        path.write_bytes(self.path.read_bytes())

    def close(self) -> None:
        self.writer.close({})
