"""The recorder: a process that subscribes to all topics and records the drive (recording/recording.py).

`python -m birdslam.runtime.nodes.recorder record VITALS_FD PARENT_PID`; standard input: the configuration and a
`RecorderAssignment`, one line of JSON each. Ends after END_OF_SOURCE or on SIGTERM. Exit status: 0 complete, 1 bug, 2
the file can't be created, 3 disk failure. A restarted recorder writes a new file, which starts with the graph.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from pathlib import Path
from typing import Any

import msgspec
import psutil

from birdslam.loops.map_pose import MapPose
from birdslam.runtime.configuration import Configuration, dump, without_passwords
from birdslam.runtime.environment import USER_ERROR_STATUS, library_versions
from birdslam.runtime.latency import stages
from birdslam.runtime.nodes.checkpoints import checkpoint_path, newest_checkpoint
from birdslam.runtime.process import realtime
from birdslam.runtime.process.beside import DISK_STATUS, Stop, run_beside
from birdslam.runtime.process.restarts import FIRST, Assignment
from birdslam.runtime.process.vitals import Vitals
from birdslam.runtime.recording import scene
from birdslam.runtime.recording.recording import EXACT, About, Alive, GraphCheckpoint, Latency, RecordingWriter
from birdslam.runtime.topology import MAP, NODES, RECORDER
from birdslam.runtime.transport.bus import Bus, Message, Subscriber
from birdslam.runtime.transport.presence import ring_path
from birdslam.runtime.transport.ring import FrameError, FrameReader
from birdslam.runtime.wire import Health
from birdslam.sources.speed_log import added
from birdslam.types import Estimate, FrameRef, MapUpdate, Measurements, SpeedReading, Status

TURN_S = 0.05  # max. interval between two writes
MAX_TURN_MESSAGES = 256  # written before it checks whether to end
QUIET_S = 0.2  # without a message: the drive is over
END_S = 2.0  # after END_OF_SOURCE and after each later message, for the rest
HEALTH_NS = 1_000_000_000
MAX_EVENTS = 256  # queue of liveliness events
NICENESS = 5  # below the pipeline
INDEX_MIB = 8.0, 8.0  # reserved for objects (the index of an hour) and for larger blocks (chunks with images)

log = logging.getLogger(__name__)


class RecorderAssignment(msgspec.Struct, frozen=True):
    """The networks with their hashes, the file to write, and the state of the previous recorder."""

    models: dict[str, Any]
    file: str
    assignment: Assignment = FIRST


class Recorder:
    """Writes messages from the bus to the file."""

    def __init__(
        self,
        configuration: Configuration,
        bus: Bus,
        writer: RecordingWriter,
        vitals: Vitals,
        assignment: Assignment = FIRST,
    ) -> None:
        config = configuration.recording
        self._writer, self._vitals, self._assignment = writer, vitals, assignment
        self._estimates = bus.subscriber("estimate", config.queue, may_drop=True)
        health = (f"health/{name}" for name in (*NODES, MAP.name))
        others = (*(topic for topic in EXACT if topic != "estimate"), *health, "map_pose")
        self._others = {topic: bus.subscriber(topic, config.queue, may_drop=True) for topic in others}
        self._next: dict[str, Message] = {}  # the oldest unwritten message of each topic
        self._health = bus.publisher("health/record")
        self._events: deque[tuple[int, Alive]] = deque(maxlen=MAX_EVENTS)
        bus.on_alive(lambda node, alive: self._events.append((time.monotonic_ns(), Alive(node=node, alive=alive))))
        self._ring: FrameReader | None = None
        if config.images:
            self._ring = FrameReader(ring_path(configuration.vehicle, configuration.runtime_dir))
        self._jpeg_quality = config.jpeg_quality
        self.images = self.torn = 0
        self._process = psutil.Process()
        self._process.cpu_percent()
        self._reported_ns, self._frames, self._frames_reported = time.monotonic_ns(), 0, 0
        self._end_frame: int | None = None  # of END_OF_SOURCE
        self._end_measured = False  # its measurements have arrived, which may be later
        self._measured_frame = -1
        self._map_frame = -1
        self._speeds: tuple[SpeedReading, ...] = ()  # of the last frame
        self._estimate_frame = -1
        self._handed: deque[tuple[int, int]] = deque()  # length of the file, next frame
        self._missed = 0  # frames between the previous recorder's last written one and this one's first
        self._checkpoints: Path | None = None  # source of the graph in a file that starts in the middle of a drive
        if assignment.restarts:
            self._checkpoints = checkpoint_path(configuration)
        self._first_measured: int | None = None  # the frame of the first measurements in this file
        if configuration.camera is not None:
            self._draw(scene.from_camera(configuration.camera, time.time_ns()), time.monotonic_ns())

    def record_received(self, timeout_s: float) -> bool:
        """Writes up to MAX_TURN_MESSAGES messages in order of arrival; returns whether there were any.

        It unpacks one message of each topic at a time.
        """
        if "estimate" not in self._next and (first := self._estimates.recv(timeout_s)) is not None:
            self._next["estimate"] = first
        while self._events:
            t_ns, event = self._events.popleft()
            self._writer.draw("/alive", event, t_ns)
        subscribers = {"estimate": self._estimates, **self._others}
        for topic in subscribers.keys() - self._next.keys():
            self._unpack_next(topic, subscribers[topic])
        written = 0
        while self._next and written < MAX_TURN_MESSAGES:
            oldest = min(self._next, key=lambda topic: self._next[topic].t_received_ns)
            self._take(oldest, self._next.pop(oldest))
            self._unpack_next(oldest, subscribers[oldest])
            self._show_life()
            written += 1
        now_ns = time.monotonic_ns()
        if now_ns - self._reported_ns >= HEALTH_NS:
            self._report_health(now_ns)
        if self._checkpoints is not None and self._first_measured is not None:
            self._begin_from_checkpoint(self._checkpoints, self._first_measured, now_ns)
        self._vitals.count(torn=self.torn, **self._counters())
        self._show_life()
        return written > 0

    def _unpack_next(self, topic: str, subscriber: Subscriber) -> None:
        if (message := subscriber.recv(0.0)) is not None:
            self._next[topic] = message

    def _show_life(self) -> None:
        """Updates the vitals after each message, since a full queue takes long to write."""
        self._vitals.count(frames=self._writer.messages)
        self._vitals.beat()
        if self._writer.flush_if_due(time.monotonic_ns()):
            self._handed.append((self._writer.handed_bytes, self._estimate_frame + 1))
        while self._handed and self._handed[0][0] <= self._writer.written_bytes:
            self._vitals.count(next_frame=self._handed.popleft()[1])

    def _begin_from_checkpoint(self, path: Path, first_frame: int, now_ns: int) -> None:
        """Writes the first checkpoint after which the file has all measurements."""
        found = newest_checkpoint(path)
        if found is not None and found.frame_id >= first_frame - 1:
            checkpoint = GraphCheckpoint(frame_id=found.frame_id, epoch=found.epoch, data=found.data)
            self._writer.begin_from(checkpoint, now_ns)
            self._checkpoints = None

    @property
    def over(self) -> bool:
        """Whether the end of the source, its measurements and the map have been written."""
        return self._end_frame is not None and self._end_measured and self._map_frame == self._end_frame

    @property
    def ending(self) -> bool:
        """Whether the end of the source has been written."""
        return self._end_frame is not None

    def dropped(self) -> dict[str, int]:
        """Returns the number of messages that were lost, by topic."""
        subscribers = {"estimate": self._estimates, **self._others}
        lost = {topic: subscriber.dropped for topic, subscriber in subscribers.items() if subscriber.dropped}
        if self._end_frame is not None and not self._end_measured:  # no later number counts the last ones
            lost["measurements"] = lost.get("measurements", 0) + self._end_frame - self._measured_frame
        return lost

    def _counters(self) -> dict[str, int]:
        malformed = self._estimates.malformed + sum(s.malformed for s in self._others.values())
        return {"dropped": sum(self.dropped().values()) + self._missed, "malformed": malformed}

    def _take(self, topic: str, message: Message) -> None:
        record, t_ns = message.record, message.t_received_ns
        if topic in EXACT:
            self._writer.add(topic, record, t_ns, message.trace)
        if isinstance(record, Health):
            self._writer.draw(f"/{topic}", record, t_ns)
        elif isinstance(record, FrameRef):
            for reading in added(self._speeds, record.speeds):
                self._writer.draw("/speed", reading, t_ns)
            self._speeds = record.speeds
            self._take_image(record, t_ns)
        elif isinstance(record, Measurements):
            if self._first_measured is None:
                self._first_measured = record.frame_id
            self._measured_frame = record.frame_id
            self._end_measured = self._end_measured or Status.END_OF_SOURCE in record.status
            self._draw(scene.from_measurements(record, record.t_utc_ns), t_ns)
        elif isinstance(record, MapPose):
            self._writer.draw("/map_pose", record, t_ns)
        elif isinstance(record, MapUpdate):
            self._map_frame = record.frame_id
            self._draw(scene.from_map(record, time.time_ns()), t_ns)
        elif isinstance(record, Estimate):
            if Status.END_OF_SOURCE in record.status:
                self._end_frame = record.frame_id
                return
            resume = self._assignment.resume
            if self._assignment.restarts and self._estimate_frame < 0:
                # Without a resume point the previous recorder may have written nothing
                self._missed = max(0, record.frame_id - (0 if resume is None else resume.next_frame))
            self._estimate_frame = record.frame_id
            self._frames += 1
            self._writer.draw("/estimate", record, t_ns)
            self._writer.draw("/latency", _latency(record, message), t_ns)
            self._draw(scene.from_estimate(record, record.t_utc_ns), t_ns)

    def _take_image(self, ref: FrameRef, t_ns: int) -> None:
        if self._ring is None or ref.slot < 0:
            return
        try:
            image = self._ring.read(ref)
        except FrameError as error:
            log.warning("frame %d is not recorded: %s", ref.frame_id, error)
            image = None
        if image is None:
            self.torn += 1
            return
        self._draw([scene.from_image(image, self._jpeg_quality, ref.t_utc_ns)], t_ns)
        self.images += 1

    def _draw(self, drawn: Any, t_ns: int) -> None:
        for channel, message in drawn:
            self._writer.draw(channel, message, t_ns)

    def _report_health(self, now_ns: int) -> None:
        rate_hz = (self._frames - self._frames_reported) * 1e9 / (now_ns - self._reported_ns)
        self._reported_ns, self._frames_reported = now_ns, self._frames
        counters = self._counters()
        health = Health(
            node=RECORDER.name,
            t_ns=now_ns,
            frames=self._frames,
            torn=self.torn,
            rate_hz=rate_hz,
            rss_bytes=self._process.memory_info().rss,
            cpu_percent=self._process.cpu_percent(),
            dropped=counters["dropped"],
            malformed=counters["malformed"],
            restarts=self._assignment.restarts,
            cause=self._assignment.cause[:200],
        )
        self._health.put(health)
        self._writer.draw("/health/record", health, now_ns)

    def end(self) -> dict[str, str]:
        """Returns the counts for the end of the file."""
        counts = {"estimates": self._frames, "images": self.images, "images_torn": self.torn, "missed": self._missed}
        counts |= self._counters()
        dropped = {f"dropped {topic}": n for topic, n in self.dropped().items()}
        return {name: str(count) for name, count in {**counts, **dropped}.items()}


def _latency(estimate: Estimate, message: Message) -> Latency:
    left_ns = message.trace.left_ns
    return Latency(
        frame_id=estimate.frame_id,
        age_ms=(message.t_received_ns - estimate.t_capture_ns) / 1e6,
        left_ms=None if left_ns is None else left_ns / 1e6,
        stages_ms=dict(stages(message.trace, message.t_received_ns)),
    )


def about(configuration: Configuration, models: dict[str, Any], restarts: int = 0) -> About:
    """Returns the metadata of a recording that starts now."""
    versions = library_versions()
    utc_offset_ns = time.time_ns() - time.monotonic_ns()
    return About(
        configuration=dump(without_passwords(configuration)),
        models=models,
        versions=versions,
        utc_offset_ns=utc_offset_ns,
        restarts=restarts,
    )


def record(configuration: Configuration, order: RecorderAssignment, vitals: Vitals, stop: Stop) -> int:
    """Records a drive; returns the exit status of the process."""
    realtime.reserve(*INDEX_MIB)
    config = configuration.recording
    described = about(configuration, order.models, order.assignment.restarts)
    try:
        writer = RecordingWriter(Path(order.file), described, configuration.camera, config.flush_ms, config.sync)
    except OSError as error:
        log.error("%s can't be created: %s", order.file, error.strerror)
        return USER_ERROR_STATUS
    with Bus(
        configuration.vehicle, RECORDER.name, runtime_dir=configuration.runtime_dir, lossless=configuration.lossless
    ) as bus:
        recorder = Recorder(configuration, bus, writer, vitals, order.assignment)
        vitals.beat()
        vitals.count(ready=1)
        bus.declare_alive()
        end_s = None
        while (
            writer.error is None
            and not stop.asked
            and not recorder.over
            and (end_s is None or time.monotonic() < end_s)
        ):
            received = recorder.record_received(TURN_S)
            if recorder.ending and (received or end_s is None):
                end_s = time.monotonic() + END_S
        while writer.error is None and not recorder.over and recorder.record_received(QUIET_S):
            pass
        vitals.count(ready=0)  # no more beats while it waits for the disk
        writer.close(recorder.end())
    if writer.error is not None:
        what = f"{writer.error.strerror}: {order.file} ends with what was written until then"
        log.error("the recording has ended: %s", what)
        return DISK_STATUS
    return 0


if __name__ == "__main__":
    run_beside(record, RecorderAssignment, NICENESS)
