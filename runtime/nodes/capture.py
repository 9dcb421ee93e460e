"""The capture process: reads frames from their source at their time, undistorts them and writes them to the ring."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

from birdslam.geometry.camera import Undistorter
from birdslam.runtime.configuration import Configuration
from birdslam.runtime.nodes.car_speeds import CarSpeeds
from birdslam.runtime.nodes.degradation import Mode
from birdslam.runtime.nodes.sources import EndOfSource, Pacer, ReadAhead, SourceError, open_source, to_frame
from birdslam.runtime.process.restarts import FIRST, Assignment, Resume
from birdslam.runtime.transport.bus import Bus, Message
from birdslam.runtime.transport.presence import ring_path
from birdslam.runtime.transport.ring import FrameRing
from birdslam.runtime.wire import Trace
from birdslam.sources.recording import RecordedFrame
from birdslam.types import Frame, FrameRef, Measurements, Status


@dataclass(frozen=True)
class Captured:
    """A frame of the source with its capture time, not yet undistorted."""

    frame_id: int
    recorded: RecordedFrame
    t_capture_ns: int


class CaptureNode:
    """camera -> FrameRef: paces, stamps and undistorts frames, and writes their pixels to the ring."""

    mode: str = Mode.FULL

    def __init__(
        self, configuration: Configuration, bus: Bus, wait: Callable[[float], object], assignment: Assignment = FIRST
    ) -> None:
        self.ended = False
        self._config = configuration
        self._wait = wait
        self._resume = assignment.resume
        self._source = open_source(configuration, must_open=self._resume is None)
        camera = self._source.camera
        self._undistort = Undistorter(camera)
        path = ring_path(configuration.vehicle, configuration.runtime_dir)
        self._ring = FrameRing(path, camera.height_px, camera.width_px, slots=configuration.runtime.ring_slots)
        self._pacer = Pacer(configuration.source.rate)
        self._estimates = bus.subscriber("estimate")
        # Not with a speed file, whose readings come with the frames, nor at rate "max", which must be reproducible
        own = configuration.source.speed or configuration.lossless
        self._speeds = None if own else CarSpeeds(bus.subscriber("speed"))
        self._reader: ReadAhead | None = None
        self._next: tuple[int, RecordedFrame] | None = None
        self._quiet_since_s = 0.0
        self._sent = 0  # frame_id of the next frame to send
        self._returned = -1  # frame_id of the newest estimate that came back
        self._t_source_ns = 0
        self._over_since_s: float | None = None
        self._end_sent = False

    def receive(self, timeout_s: float) -> Message | None:
        """Returns the next frame when it is due, at rate "max" when few enough are in flight; at last END_OF_SOURCE."""
        until_s = time.monotonic() + timeout_s
        if self._reader is None:
            first_frame = 0 if self._resume is None else self._resume_frame(self._resume)
            capacity = 1 if self._source.live else self._config.source.prefetch_frames
            self._reader = ReadAhead(self._source, capacity, first_frame)
            self._quiet_since_s = time.monotonic()
        while self._must_wait():
            back = self._estimates.recv(max(0.0, until_s - time.monotonic()))
            if back is None:
                return None
            self._returned = back.record.frame_id
            if Status.END_OF_SOURCE in back.record.status:  # all pixels are read: the ring can be removed
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

    def _resume_frame(self, resume: Resume) -> int:
        """Returns the frame that is due now. It skips at least one, so that perceive sees a gap."""
        rate = self._config.source.rate
        hz = rate if isinstance(rate, float) else self._source.rate_hz
        missed = max(1, math.floor((time.monotonic_ns() - resume.t_capture_ns) * 1e-9 * hz))
        frame_id = resume.next_frame + missed
        self._source.resume(frame_id, resume.t_source_ns + round((missed + 1) * 1e9 / self._source.rate_hz))
        self._sent = frame_id
        self._t_source_ns = resume.t_source_ns
        return frame_id

    def _must_wait(self) -> bool:
        """Whether to wait for estimates: at the end for all, so that END_OF_SOURCE displaces no frame from a queue."""
        runtime, in_flight = self._config.runtime, self._sent - 1 - self._returned
        if self._end_sent:
            return True
        if self._over_since_s is not None:
            return in_flight > 0 and time.monotonic() - self._over_since_s < runtime.drain_timeout_s
        return self._config.lossless and in_flight >= runtime.in_flight_frames

    def _due(self, frame_id: int, recorded: RecordedFrame, until_s: float) -> int | None:
        """Returns the capture time of the frame; None if that is after `until_s`."""
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
            raise SourceError(f"{self._source.name}: no frame for {limit_s:g} s")

    def step(self, captured: Captured | FrameRef) -> Iterator[FrameRef]:
        if isinstance(captured, FrameRef):
            self._end_sent = True
            yield captured
            return
        t_capture_ns = captured.t_capture_ns
        frame = to_frame(self._undistort, captured.frame_id, captured.recorded, t_capture_ns, _utc_ns(t_capture_ns))
        if self._speeds is not None:
            readings = self._speeds.at(frame.t_source_ns, t_capture_ns)
            frame = replace(frame, speeds=frame.speeds or readings)  # readings of the recording take precedence
        self._sent = frame.frame_id + 1
        self._t_source_ns = frame.t_source_ns
        yield self._reference(frame)

    def _reference(self, frame: Frame) -> FrameRef:
        if frame.image is None:
            return FrameRef(**stamps(frame), status=frame.status, dropped=self._dropped, speeds=frame.speeds)
        slot, sequence = self._ring.write(frame.image)
        height_px, width_px = frame.image.shape[:2]
        return FrameRef(
            **stamps(frame),
            slot=slot,
            sequence=sequence,
            ring_epoch=self._ring.epoch,
            width_px=width_px,
            height_px=height_px,
            channels=1 if frame.image.ndim == 2 else frame.image.shape[2],
            dropped=self._dropped,
            status=frame.status,
            speeds=frame.speeds,
        )

    def _end(self) -> Message:
        now_ns = time.monotonic_ns()
        end = FrameRef(
            frame_id=self._sent,
            t_source_ns=self._t_source_ns,
            t_capture_ns=now_ns,
            t_utc_ns=_utc_ns(now_ns),
            dropped=self._dropped,
            status=(Status.END_OF_SOURCE,),
        )
        return Message(end, Trace(), now_ns)

    def drain(self) -> None:
        if self._over_since_s is None:
            self._over_since_s = time.monotonic()

    @property
    def _dropped(self) -> int:
        return self._reader.dropped if self._reader else 0

    def counters(self) -> dict[str, int]:
        return {"dropped": self._dropped, **(self._speeds.counters() if self._speeds else {})}

    def close(self) -> None:
        if self._reader is not None:
            self._reader.close()
        self._ring.close()


def _utc_ns(t_monotonic_ns: int) -> int:
    return time.time_ns() - (time.monotonic_ns() - t_monotonic_ns)


def stamps(record: Frame | FrameRef | Measurements) -> dict[str, Any]:
    """Returns the number and the times of a frame as keyword arguments of a record."""
    return {
        "frame_id": record.frame_id,
        "t_source_ns": record.t_source_ns,
        "t_capture_ns": record.t_capture_ns,
        "t_utc_ns": record.t_utc_ns,
    }
