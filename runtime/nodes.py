"""What the three processes do; thin, since each holds its objects of birdslam/ and only moves records in and out.

A node receives (`receive`, in bounded time), and makes records of what it received (`step`, a generator: the runner
sends each as soon as it is there). It has `ended` once END_OF_SOURCE went through it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import msgspec

from birdslam.camera import Camera, Undistorter
from birdslam.datasets import RecordedFrame
from birdslam.frontend import FrontEnd
from birdslam.graph import PoseGraph
from birdslam.se2 import SE2
from birdslam.types import Estimate, Frame, FrameRef, MapUpdate, Measurements, Status
from runtime.bus import Bus, Message
from runtime.configuration import Configuration, ConfigurationError
from runtime.frames import FrameReader, FrameRing
from runtime.inference import Inference
from runtime.presence import ring_path
from runtime.sources import EndOfSource, Pacer, ReadAhead, SourceError, open_source, to_frame
from runtime.wire import Trace


class Node(Protocol):
    """What the runner drives."""

    ended: bool

    def receive(self, timeout_s: float) -> Message | None: ...

    def step(self, record: Any) -> Iterator[msgspec.Struct]: ...

    def drain(self) -> None:
        """Told to let the source end here; only capture can."""

    def counters(self) -> dict[str, int]:
        """`dropped`, `malformed` and `torn` since the start (see wire.Health)."""

    def close(self) -> None: ...


def calibrated(configuration: Configuration) -> Camera:
    """The camera, which the supervisor has filled in from the source."""
    if configuration.camera is None:
        raise ConfigurationError("camera: none is configured")
    return configuration.camera


@dataclass(frozen=True)
class Captured:
    """A frame of the source at its time, not yet undistorted."""

    frame_id: int
    recorded: RecordedFrame
    t_capture_ns: int


class CaptureNode:
    """camera -> FrameRef: paces, stamps and undistorts frames, and lays their pixels into the ring."""

    def __init__(self, configuration: Configuration, bus: Bus, wait: Callable[[float], object]) -> None:
        self.ended = False
        self._config = configuration
        self._wait = wait
        self._source = open_source(configuration)
        camera = self._source.camera
        self._undistort = Undistorter(camera)
        path = ring_path(configuration.vehicle, configuration.runtime_dir)
        self._ring = FrameRing(path, camera.height_px, camera.width_px, slots=configuration.runtime.ring_slots)
        self._pacer = Pacer(configuration.source.rate)
        self._estimates = bus.subscriber("estimate")
        self._reader: ReadAhead | None = None
        self._next: tuple[int, RecordedFrame] | None = None
        self._quiet_since_s = 0.0
        self._sent = 0  # frame_id of the next frame to send
        self._returned = -1  # frame_id of the newest estimate that came back
        self._t_source_ns = 0
        self._over_since_s: float | None = None
        self._end_sent = False

    def receive(self, timeout_s: float) -> Message | None:
        """The next frame when it is due; at rate "max" when few enough are in flight; END_OF_SOURCE at the end."""
        until_s = time.monotonic() + timeout_s
        if self._reader is None:
            self._reader = ReadAhead(self._source, 1 if self._source.live else self._config.source.prefetch_frames)
            self._quiet_since_s = time.monotonic()
        while self._must_wait():
            back = self._estimates.recv(max(0.0, until_s - time.monotonic()))
            if back is None:
                return None
            self._returned = back.record.frame_id
            if Status.END_OF_SOURCE in back.record.status:  # all pixels are read: the ring may go
                self.ended = True
                return None
        if self._over_since_s is not None:
            return self._end()
        try:
            self._next = self._next or self._reader.next(max(0.0, until_s - time.monotonic()))
        except EndOfSource:
            self.drain()
            return None
        if self._next is None:
            self._check_camera()
            return None
        frame_id, recorded = self._next
        t_capture_ns = self._due(frame_id, recorded, until_s)
        if t_capture_ns is None:
            return None
        self._next = None
        self._quiet_since_s = time.monotonic()
        return Message(Captured(frame_id, recorded, t_capture_ns), Trace(), t_capture_ns)

    def _must_wait(self) -> bool:
        """For an estimate to come back: all at the end, so that END_OF_SOURCE pushes no frame out of a queue of one."""
        runtime, in_flight = self._config.runtime, self._sent - 1 - self._returned
        if self._end_sent:
            return True
        if self._over_since_s is not None:
            return in_flight > 0 and time.monotonic() - self._over_since_s < runtime.drain_timeout_s
        return self._config.lossless and in_flight >= runtime.in_flight_frames

    def _due(self, frame_id: int, recorded: RecordedFrame, until_s: float) -> int | None:
        """When the frame is captured; None where that is after `until_s`."""
        if self._source.live:
            return recorded.t_source_ns
        now_ns = time.monotonic_ns()
        due_ns = self._pacer.due_ns(frame_id, recorded.t_source_ns, now_ns)
        if due_ns > now_ns:
            self._wait(max(0.0, min((due_ns - now_ns) / 1e9, until_s - time.monotonic())))
            now_ns = time.monotonic_ns()
        return now_ns if now_ns >= due_ns else None

    def _check_camera(self) -> None:
        limit_s = self._config.source.camera_timeout_s
        if self._source.live and time.monotonic() - self._quiet_since_s > limit_s:
            raise SourceError(f"{self._source.name}: has delivered no frame for {limit_s:g} s")

    def step(self, captured: Captured | FrameRef) -> Iterator[FrameRef]:
        if isinstance(captured, FrameRef):
            self._end_sent = True
            yield captured
            return
        t_capture_ns = captured.t_capture_ns
        frame = to_frame(self._undistort, captured.frame_id, captured.recorded, t_capture_ns, _utc_ns(t_capture_ns))
        self._sent = frame.frame_id + 1
        self._t_source_ns = frame.t_source_ns
        yield self._reference(frame)

    def _reference(self, frame: Frame) -> FrameRef:
        dropped = self.counters()["dropped"]
        if frame.image is None:
            return FrameRef(**_stamps(frame), status=frame.status, dropped=dropped)
        slot, sequence = self._ring.write(frame.image)
        height_px, width_px = frame.image.shape[:2]
        return FrameRef(
            **_stamps(frame),
            slot=slot,
            sequence=sequence,
            ring_epoch=self._ring.epoch,
            width_px=width_px,
            height_px=height_px,
            channels=1 if frame.image.ndim == 2 else frame.image.shape[2],
            dropped=dropped,
            status=frame.status,
        )

    def _end(self) -> Message:
        now_ns = time.monotonic_ns()
        end = FrameRef(
            frame_id=self._sent,
            t_source_ns=self._t_source_ns,
            t_capture_ns=now_ns,
            t_utc_ns=_utc_ns(now_ns),
            dropped=self.counters()["dropped"],
            status=(Status.END_OF_SOURCE,),
        )
        return Message(end, Trace(), now_ns)

    def drain(self) -> None:
        if self._over_since_s is None:
            self._over_since_s = time.monotonic()

    def counters(self) -> dict[str, int]:
        return {"dropped": self._reader.dropped if self._reader else 0}

    def close(self) -> None:
        if self._reader is not None:
            self._reader.close()
        self._ring.close()


class PerceiveNode:
    """FrameRef -> Measurements: the networks and the front end."""

    def __init__(self, configuration: Configuration, bus: Bus, wait: Callable[[float], object]) -> None:
        self.ended = False
        cv2.setNumThreads(configuration.perceive.opencv_threads)
        self._frames = bus.subscriber("frame")
        self._ring = FrameReader(ring_path(configuration.vehicle, configuration.runtime_dir))
        self._inference = Inference(configuration)
        self._frontend = FrontEnd(calibrated(configuration), configuration.slam.frontend)
        self._torn = 0

    def receive(self, timeout_s: float) -> Message | None:
        return self._frames.recv(timeout_s)

    def step(self, ref: FrameRef) -> Iterator[Measurements]:
        if Status.END_OF_SOURCE in ref.status:
            self.ended = True
            yield Measurements(**_stamps(ref), status=ref.status)
            return
        image = None
        if ref.slot >= 0:
            image = self._ring.read(ref)
            if image is None:  # overwritten meanwhile: the next frame says FRAMES_DROPPED
                self._torn += 1
                return
        frame = Frame(ref.frame_id, ref.t_source_ns, ref.t_capture_ns, ref.t_utc_ns, image, ref.status)
        yield self._frontend.step(frame, self._inference.start(frame))

    def drain(self) -> None:
        """Ends with END_OF_SOURCE, as ever."""

    def counters(self) -> dict[str, int]:
        return {"dropped": self._frames.dropped, "malformed": self._frames.malformed, "torn": self._torn}

    def close(self) -> None:
        self._inference.close()
        self._ring.close()


class OptimizeNode:
    """Measurements -> Estimate, MapUpdate: the pose graph."""

    def __init__(self, configuration: Configuration, bus: Bus, wait: Callable[[float], object]) -> None:
        self.ended = False
        self._measurements = bus.subscriber("measurements")
        self._graph = PoseGraph(configuration.slam.graph, configuration.slam.weights)
        self._last: Estimate | None = None

    def receive(self, timeout_s: float) -> Message | None:
        return self._measurements.recv(timeout_s)

    def step(self, measurements: Measurements) -> Iterator[Estimate | MapUpdate]:
        if Status.END_OF_SOURCE in measurements.status:
            self.ended = True
            yield from self._end(measurements)
            return
        self._last = self._graph.update(measurements)
        yield self._last
        gained = self._graph.map_update()
        if gained is not None:
            yield gained

    def _end(self, measurements: Measurements) -> Iterator[Estimate | MapUpdate]:
        """The map is complete before the estimate that ends the run; its update bears the number of the end."""
        epoch = self._last.epoch if self._last else 0
        gained = self._graph.map_update() or MapUpdate(epoch=epoch, frame_id=measurements.frame_id)
        yield msgspec.structs.replace(gained, frame_id=measurements.frame_id)
        yield Estimate(
            **_stamps(measurements),
            epoch=epoch,
            T_world_ego=self._last.T_world_ego if self._last else SE2(),
            cov=self._last.cov if self._last else (0.0,) * 9,
            valid=False,
            status=measurements.status,
        )

    def drain(self) -> None:
        """Ends with END_OF_SOURCE, as ever."""

    def counters(self) -> dict[str, int]:
        return {"dropped": self._measurements.dropped, "malformed": self._measurements.malformed}

    def close(self) -> None:
        """Holds nothing open."""


NODE_TYPES: dict[str, Callable[[Configuration, Bus, Callable[[float], object]], Node]] = {
    "capture": CaptureNode,
    "perceive": PerceiveNode,
    "optimize": OptimizeNode,
}


def _utc_ns(t_monotonic_ns: int) -> int:
    return time.time_ns() - (time.monotonic_ns() - t_monotonic_ns)


def _stamps(record: Frame | FrameRef | Measurements) -> dict[str, Any]:
    return {
        "frame_id": record.frame_id,
        "t_source_ns": record.t_source_ns,
        "t_capture_ns": record.t_capture_ns,
        "t_utc_ns": record.t_utc_ns,
    }
