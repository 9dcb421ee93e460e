"""The nodes: they move records between the bus and their objects of birdslam/.

`receive` waits for a bounded time; `step` is a generator of records, and the runner sends each at once. A node has
`ended` after END_OF_SOURCE.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any, Protocol

import cv2
import msgspec

from birdslam.frontend import FrontEnd, Pending
from birdslam.geometry.camera import Camera
from birdslam.graph.minimum import solver
from birdslam.perception import KeptFindings
from birdslam.perception.schedule import Followed
from birdslam.runtime.configuration import Configuration, ConfigurationError
from birdslam.runtime.nodes.capture import CaptureNode, stamps
from birdslam.runtime.nodes.degradation import STATUS, Degradation, Mode
from birdslam.runtime.nodes.ego_motion import external_odometry
from birdslam.runtime.nodes.inference import Inference
from birdslam.runtime.nodes.optimize import OptimizeNode
from birdslam.runtime.process.restarts import Assignment
from birdslam.runtime.transport.bus import Bus, Message
from birdslam.runtime.transport.presence import findings_path, ring_path
from birdslam.runtime.transport.ring import FrameReader
from birdslam.types import INVALIDATING, Attitude, Frame, FrameRef, Measurements, Status

WAITING_FRAMES = 8  # queue of perceive: all but the newest are predicted, more are dropped
STALE_BUDGET_RATIO = 3.0  # a frame that arrives this many times later than budgeted gets INPUT_STALE

log = logging.getLogger(__name__)


class Node(Protocol):
    """The interface that the runner calls."""

    ended: bool

    @property
    def mode(self) -> str:
        """The mode, for the node's health."""

    def receive(self, timeout_s: float) -> Message | None: ...

    def step(self, record: Any) -> Iterator[msgspec.Struct]: ...

    def drain(self) -> None:
        """Ends the source here; only capture does."""

    def counters(self) -> dict[str, int]:
        """Returns `dropped`, `malformed` and `torn` since the start (see wire.Health)."""

    def close(self) -> None: ...


def calibrated(configuration: Configuration) -> Camera:
    """Returns the camera, which the supervisor has filled in from the source."""
    if configuration.camera is None:
        raise ConfigurationError("camera: none is configured")
    return configuration.camera


class PerceiveNode:
    """FrameRef -> Measurements: the networks and the front end."""

    def __init__(
        self, configuration: Configuration, inference: Inference, frontend: FrontEnd, bus: Bus, assignment: Assignment
    ) -> None:
        self.ended = False
        degrades = configuration.degradation.enabled and not configuration.lossless
        self._frames = bus.subscriber("frame", WAITING_FRAMES if degrades else None)
        self._waiting: deque[Message] = deque()  # received frames after the current one
        self._is_lossless = configuration.lossless
        self._started: tuple[Frame, Pending] | None = None  # at rate "max": the next frame
        self._ring = FrameReader(ring_path(configuration.vehicle, configuration.runtime_dir))
        self._inference = inference
        self._frontend = frontend
        self._torn = 0
        self._degradation: Degradation | None = None
        if degrades:
            budget_ms = configuration.budgets.perceived_ms
            self._degradation = Degradation(configuration.degradation, inference.roles, budget_ms)
        perceive = configuration.perceive
        # The other nodes wait for a restarted node: skip the timing
        measured_s = 0.0 if assignment.restarts else perceive.looks.measured_s
        self._look_rate = inference.fit(configuration.camera, perceive, measured_s)
        self._last_frame: int | None = None  # last received
        self._coast_divisor = configuration.degradation.coast_divisor
        self._coast_max_ns = round(configuration.degradation.coast_max_ms * 1e6)
        self._stale_ns = round(configuration.budgets.received_ms * STALE_BUDGET_RATIO * 1e6)
        self._looked_frame = -1  # the last processed frame with pixels
        self._measured_ns: int | None = None  # source time of the last frame with measured ego motion
        self._looked_invalid: tuple[Status, ...] = ()  # its invalidating statuses
        self._looked_attitude = Attitude()

    @property
    def mode(self) -> str:
        return Mode.FULL if self._degradation is None else self._degradation.mode

    def receive(self, timeout_s: float) -> Message | None:
        """Returns the next frame; `_waiting` holds the frames after it, at rate "max" none."""
        if self._degradation is None and self._waiting:
            return self._waiting.popleft()
        message = self._frames.recv(0.0 if self._waiting else timeout_s)
        while message is not None:
            self._waiting.append(message)
            message = self._frames.recv(0.0) if self._degradation is not None else None
        return self._waiting.popleft() if self._waiting else None

    @property
    def _overtaken(self) -> bool:
        """Whether a newer frame is already waiting; the current one is then predicted."""
        return any(Status.END_OF_SOURCE not in message.record.status for message in self._waiting)

    def step(self, ref: FrameRef) -> Iterator[Measurements]:
        start_ns = time.monotonic_ns()
        if Status.END_OF_SOURCE in ref.status:
            self.ended = True
            yield Measurements(**stamps(ref), status=ref.status)
            return
        if self._overtaken:
            yield self._coast(ref)
            return
        frame, pending = self._started or (self._read(ref), None)
        self._started = None
        if frame is None:
            return
        if self._degradation is None:
            pending = pending or self._inference.start(frame)
            yield self._frontend.measure(frame, Followed(pending, self._start_next) if self._is_lossless else pending)
        else:
            mode = self._degradation.mode
            yield self._coast(ref) if self._coasts(ref, mode) else self._look(frame, mode)
        self._inference.finish_frame()
        now_ns = time.monotonic_ns()
        self._adapt_rate(ref.frame_id, (now_ns - start_ns) / 1e6)
        if self._degradation is not None and self._degradation.judge((now_ns - ref.t_capture_ns) / 1e6):
            log.warning("frame %d: mode %s after %s", ref.frame_id, self._degradation.mode, mode)

    def _read(self, ref: FrameRef) -> Frame | None:
        """Reads a frame from the ring; None if it was overwritten meanwhile: the next frame gets FRAMES_DROPPED."""
        image = None
        if ref.slot >= 0:
            image = self._ring.read(ref)
            if image is None:
                self._torn += 1
                return None
        return Frame(**stamps(ref), image=image, status=ref.status, speeds=ref.speeds)

    def _start_next(self) -> None:
        """Starts the networks on the next frame, if it has arrived, while the front end processes this one."""
        message = self._frames.recv(0.0)
        if message is None:
            return
        self._waiting.append(message)
        frame = None if Status.END_OF_SOURCE in message.record.status else self._read(message.record)
        if frame is not None:
            self._started = frame, self._inference.start(frame)

    def _adapt_rate(self, frame_id: int, step_ms: float) -> None:
        """Reduces the rate of the networks after dropped frames, and raises it when there is time."""
        dropped = self._last_frame is not None and frame_id > self._last_frame + 1
        self._last_frame = frame_id
        if self._look_rate is not None and self._look_rate.judge(step_ms, dropped):
            self._inference.set_rate(self._look_rate)
            log.info("frame %d: networks run at 1/%d of their scheduled rate", frame_id, self._look_rate.sparing)

    def _look(self, frame: Frame, mode: Mode) -> Measurements:
        stale = time.monotonic_ns() - frame.t_capture_ns > self._stale_ns
        measurements = self._frontend.measure(frame, self._inference.start(frame, mode))
        if frame.image is not None:
            self._looked_frame = frame.frame_id
            if Status.ODOMETRY_COASTING not in measurements.status:
                self._measured_ns = frame.t_source_ns
        late = self._too_long(frame.t_source_ns)
        self._looked_attitude = measurements.attitude
        self._looked_invalid = tuple(s for s in measurements.status if s in INVALIDATING)
        status = (*measurements.status, *late, *STATUS[mode], *((Status.INPUT_STALE,) if stale else ()))
        return msgspec.structs.replace(measurements, status=tuple(dict.fromkeys(status)))

    def _coasts(self, ref: FrameRef, mode: Mode) -> bool:
        """Whether this frame is predicted for lack of time."""
        return mode is Mode.COASTING and ref.slot >= 0 and ref.frame_id - self._looked_frame < self._coast_divisor

    def _coast(self, ref: FrameRef) -> Measurements:
        status = (*ref.status, Status.COASTING, *self._looked_invalid, *self._too_long(ref.t_source_ns))
        return Measurements(**stamps(ref), status=tuple(dict.fromkeys(status)), attitude=self._looked_attitude)

    def _too_long(self, t_source_ns: int) -> tuple[Status, ...]:
        """Returns COASTED_TOO_LONG if the ego motion was last measured more than `coast_max_ms` ago."""
        since_ns = 0 if self._measured_ns is None else t_source_ns - self._measured_ns
        return (Status.COASTED_TOO_LONG,) if since_ns > self._coast_max_ns else ()

    def drain(self) -> None:
        """Does nothing: perceive ends with END_OF_SOURCE."""

    def counters(self) -> dict[str, int]:
        frames, looks = self._frames, self._inference.networks.frames_with_start
        return {"dropped": frames.dropped, "malformed": frames.malformed, "torn": self._torn, "looks": looks}

    def close(self) -> None:
        self._inference.close()
        self._ring.close()


def front_end(configuration: Configuration, inference: Inference) -> FrontEnd:
    """Returns the front end of perceive."""
    camera = calibrated(configuration)
    return FrontEnd(
        camera,
        configuration.slam.frontend,
        external_odometry(configuration, camera),
        frustum_network=inference.frustum_network,
        lane_head=inference.lane_head,
    )


def prepare(name: str, configuration: Configuration) -> Callable[[Bus, Callable[[float], object], Assignment], Node]:
    """Does the slow part of the start, which processes can do in parallel; the result builds the node at once."""
    if name == "perceive":
        cv2.setNumThreads(configuration.perceive.opencv_threads)
        findings = configuration.runtime_dir and findings_path(configuration.runtime_dir)
        kept = KeptFindings.read(findings) if findings and configuration.lossless and findings.exists() else None
        inference = Inference(configuration, kept=kept)
        frontend = front_end(configuration, inference)
        return lambda bus, wait, assignment: PerceiveNode(configuration, inference, frontend, bus, assignment)
    if name == "optimize":
        if configuration.slam.graph.vehicles_move_ego:
            solver()
        return lambda bus, wait, assignment: OptimizeNode(configuration, bus, assignment)
    return lambda bus, wait, assignment: CaptureNode(configuration, bus, wait, assignment)
