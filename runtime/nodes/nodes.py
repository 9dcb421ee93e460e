"""What the three processes do; thin, since each holds its objects of birdslam/ and only moves records in and out.

A node receives (`receive`, in bounded time), and makes records of what it received (`step`, a generator: the runner
sends each as soon as it is there). It has `ended` once END_OF_SOURCE went through it.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any, Protocol

import cv2
import msgspec

from birdslam.frontend import FrontEnd
from birdslam.geometry.camera import Camera
from birdslam.graph.minimum import solver
from birdslam.runtime.configuration import Configuration, ConfigurationError
from birdslam.runtime.nodes.capture import CaptureNode, stamps
from birdslam.runtime.nodes.degradation import STATUS, Degradation, Mode
from birdslam.runtime.nodes.ego_motion import external_odometry
from birdslam.runtime.nodes.inference import Inference
from birdslam.runtime.nodes.optimize import OptimizeNode
from birdslam.runtime.process.restarts import Assignment
from birdslam.runtime.transport.bus import Bus, Message
from birdslam.runtime.transport.presence import ring_path
from birdslam.runtime.transport.ring import FrameReader
from birdslam.types import INVALIDATING, Attitude, Frame, FrameRef, Measurements, Status

WAITING_FRAMES = 8  # that come while perceive is at one are predicted, all but the newest; more are dropped
STALE_BUDGETS = 3.0  # a frame that comes to perceive this many times later than budgeted bears INPUT_STALE

log = logging.getLogger(__name__)


class Node(Protocol):
    """What the runner drives."""

    ended: bool

    @property
    def mode(self) -> str:
        """For its health."""

    def receive(self, timeout_s: float) -> Message | None: ...

    def step(self, record: Any) -> Iterator[msgspec.Struct]: ...

    def drain(self) -> None:
        """Lets the source end here; only capture can."""

    def counters(self) -> dict[str, int]:
        """`dropped`, `malformed` and `torn` since the start (see wire.Health)."""

    def close(self) -> None: ...


def calibrated(configuration: Configuration) -> Camera:
    """The camera, which the supervisor has filled in from the source."""
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
        self._waiting: deque[Message] = deque()  # frames that have come, behind the one at hand
        self._ring = FrameReader(ring_path(configuration.vehicle, configuration.runtime_dir))
        self._inference = inference
        self._frontend = frontend
        self._torn = 0
        self._degradation: Degradation | None = None
        if degrades:
            budget_ms = configuration.budgets.perceived_ms
            self._degradation = Degradation(configuration.degradation, inference.roles, budget_ms)
        perceive = configuration.perceive
        # A node restarted is awaited: it looks at its networks for as short a time as it can
        measured_s = 0.0 if assignment.restarts else perceive.looks.measured_s
        self._look_rate = inference.fit(configuration.camera, perceive, measured_s)
        self._last_frame: int | None = None  # that came
        self._coast_divisor = configuration.degradation.coast_divisor
        self._coast_max_ns = round(configuration.degradation.coast_max_ms * 1e6)
        self._stale_ns = round(configuration.budgets.received_ms * STALE_BUDGETS * 1e6)
        self._looked_frame = -1  # the last frame with pixels that was looked at
        self._measured_ns: int | None = None  # the source time of the last one whose motion was measured
        self._looked_invalid: tuple[Status, ...] = ()  # what made it one that nobody may drive by
        self._looked_attitude = Attitude()

    @property
    def mode(self) -> str:
        return Mode.FULL if self._degradation is None else self._degradation.mode

    def receive(self, timeout_s: float) -> Message | None:
        """The next frame, while `_waiting` has those that came after it."""
        message = self._frames.recv(0.0 if self._waiting else timeout_s)
        while message is not None:
            self._waiting.append(message)
            message = self._frames.recv(0.0) if self._degradation is not None else None
        return self._waiting.popleft() if self._waiting else None

    @property
    def _overtaken(self) -> bool:
        """Whether a newer frame waits already: the one at hand is predicted, since there is time for one of them."""
        return any(Status.END_OF_SOURCE not in message.record.status for message in self._waiting)

    def step(self, ref: FrameRef) -> Iterator[Measurements]:
        begun_ns = time.monotonic_ns()
        if Status.END_OF_SOURCE in ref.status:
            self.ended = True
            yield Measurements(**stamps(ref), status=ref.status)
            return
        if self._overtaken:
            yield self._coast(ref)
            return
        image = None
        if ref.slot >= 0:
            image = self._ring.read(ref)
            if image is None:  # overwritten meanwhile: the next frame says FRAMES_DROPPED
                self._torn += 1
                return
        frame = Frame(**stamps(ref), image=image, status=ref.status, speeds=ref.speeds)
        if self._degradation is None:
            yield self._frontend.measure(frame, self._inference.start(frame))
        else:
            mode = self._degradation.mode
            yield self._coast(ref) if self._coasts(ref, mode) else self._look(frame, mode)
        self._inference.over()
        now_ns = time.monotonic_ns()
        self._keep_pace(ref.frame_id, (now_ns - begun_ns) / 1e6)
        if self._degradation is not None and self._degradation.judge((now_ns - ref.t_capture_ns) / 1e6):
            log.warning("frame %d: mode %s after %s", ref.frame_id, self._degradation.mode, mode)

    def _keep_pace(self, frame_id: int, step_ms: float) -> None:
        """Networks that look less often where frames were left out, and more often once there is time."""
        dropped = self._last_frame is not None and frame_id > self._last_frame + 1
        self._last_frame = frame_id
        if self._look_rate is not None and self._look_rate.judge(step_ms, dropped):
            self._inference.look_as(self._look_rate)
            log.info("frame %d: networks look %d times less often than they would", frame_id, self._look_rate.sparing)

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
        """Whether there is no time to look at this frame."""
        return mode is Mode.COASTING and ref.slot >= 0 and ref.frame_id - self._looked_frame < self._coast_divisor

    def _coast(self, ref: FrameRef) -> Measurements:
        status = (*ref.status, Status.COASTING, *self._looked_invalid, *self._too_long(ref.t_source_ns))
        return Measurements(**stamps(ref), status=tuple(dict.fromkeys(status)), attitude=self._looked_attitude)

    def _too_long(self, t_source_ns: int) -> tuple[Status, ...]:
        """Whether the motion has only been predicted for longer than anybody should drive by."""
        since_ns = 0 if self._measured_ns is None else t_source_ns - self._measured_ns
        return (Status.COASTED_TOO_LONG,) if since_ns > self._coast_max_ns else ()

    def drain(self) -> None:
        """Ends with END_OF_SOURCE, as ever."""

    def counters(self) -> dict[str, int]:
        frames, looks = self._frames, self._inference.networks.looks
        return {"dropped": frames.dropped, "malformed": frames.malformed, "torn": self._torn, "looks": looks}

    def close(self) -> None:
        self._inference.close()
        self._ring.close()


def front_end(configuration: Configuration, inference: Inference) -> FrontEnd:
    """As perceive has it."""
    camera = calibrated(configuration)
    return FrontEnd(
        camera,
        configuration.slam.frontend,
        external_odometry(configuration, camera),
        frustum_network=inference.frustum_network,
        lane_head=inference.lane_head,
    )


def prepare(name: str, configuration: Configuration) -> Callable[[Bus, Callable[[float], object], Assignment], Node]:
    """Does what takes long and what several processes may do at once; the result makes the node without delay."""
    if name == "perceive":
        cv2.setNumThreads(configuration.perceive.opencv_threads)
        inference = Inference(configuration)
        frontend = front_end(configuration, inference)
        return lambda bus, wait, assignment: PerceiveNode(configuration, inference, frontend, bus, assignment)
    if name == "optimize":
        if configuration.slam.graph.vehicles_move_ego:
            solver()
        return lambda bus, wait, assignment: OptimizeNode(configuration, bus, assignment)
    return lambda bus, wait, assignment: CaptureNode(configuration, bus, wait, assignment)
