"""`birdslam ros`: publishes a vehicle's estimates as ROS 2 messages; docs/ros.md lists them.

A separate process and a planner of its vehicle's bus, so that it slows nothing down. It waits for the vehicle and the
router, and survives restarts of both.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import msgspec
import zenoh

from birdslam.geometry.camera import Camera
from birdslam.ros.messages import LATCHED, TOPICS, RosMessages, t_of
from birdslam.ros.parts import Level, Sent
from birdslam.ros.rmw_zenoh import LATCHED_QOS, Qos
from birdslam.runtime.configuration import Configuration
from birdslam.runtime.process import signals
from birdslam.runtime.process.sender import RateLimit, send
from birdslam.runtime.ros.session import NoRouter, RosNode, RosPublisher
from birdslam.runtime.topology import PROCESSES
from birdslam.runtime.transport.bus import Bus, BusError
from birdslam.runtime.transport.closing import Closing
from birdslam.runtime.wire import Health
from birdslam.types import EgoEdge, Estimate, MapUpdate, Measurements

NODE = "birdslam"
_DEPTH = 64  # queue of two seconds of estimates
_SILENT_S = 1.0  # interval of diagnostics about a missing estimate
_WAIT_S = 0.1  # for an estimate, in a step
_MAX_MOTIONS = 64


class RosBridge(Closing):
    """A vehicle's bus and a node of ROS 2. A context manager; raises as Bus and RosNode do."""

    pause_s = 0.0  # a step waits itself

    def __init__(self, vehicle: str, node: RosNode, runtime_dir: Path | None = None, rate_hz: float | None = None):
        self._vehicle, self._node = vehicle, node
        self._estimates_due, self._map_poses_due = RateLimit(rate_hz), RateLimit(rate_hz)
        namespace = node.node.namespace
        own, self._frames = ("", "") if namespace == "/" else (namespace, f"{namespace.strip('/')}/")
        self._publishers: dict[str, RosPublisher] = {}
        for topic, type_name in TOPICS.items():
            full = own + topic if topic.startswith("/birdslam/") else topic  # the others are standard topics
            qos = LATCHED_QOS if topic in LATCHED else Qos()
            self._publishers[topic] = node.publisher(full, type_name, qos)
        self._bus = Bus(vehicle, "ros", runtime_dir=runtime_dir)
        self._estimates = self._bus.subscriber("estimate", _DEPTH)
        self._measurements = self._bus.subscriber("measurements", _DEPTH)
        self._maps = self._bus.subscriber("map")
        self._map_poses = self._bus.subscriber("map_pose")
        self._healths = {name: self._bus.subscriber(f"health/{name}") for name in PROCESSES}
        self._messages: RosMessages | None = None
        self._motions: dict[int, EgoEdge] = {}  # by their last frame
        self._last_frame, self._published_ns = -1, 0
        self._received_s = time.monotonic()

    @property
    def connected(self) -> bool:
        """Whether the router is connected."""
        return self._node.connected

    @property
    def alive(self) -> frozenset[str]:
        """The vehicle's nodes that are alive."""
        return self._bus.alive & set(PROCESSES)

    def step(self, timeout_s: float = _WAIT_S) -> None:
        """Waits for an estimate and publishes it with all other messages that have arrived."""
        message = self._estimates.recv(timeout_s)
        while (measured := self._measurements.recv(0.0)) is not None:
            record: Measurements = measured.record
            if record.cc is not None:
                self._motions[record.cc.to_frame] = record.cc
        while len(self._motions) > _MAX_MOTIONS:
            del self._motions[next(iter(self._motions))]
        if message is not None:
            self._received_s = time.monotonic()
            self._publish_estimate(message.record)
        elif time.monotonic() - self._received_s > _SILENT_S:
            self._received_s = time.monotonic()
            self._publish_silence()
        self._publish_map()
        self._publish_healths()

    def _publish_estimate(self, estimate: Estimate) -> None:
        if estimate.t_capture_ns <= self._published_ns:  # a corrected prediction: tf allows one pose per time
            return
        if self._messages is None or estimate.frame_id <= self._last_frame:  # another drive
            self._messages = self._begin(estimate)
        if self._messages is None:
            return
        self._last_frame, self._published_ns = estimate.frame_id, estimate.t_capture_ns
        if not self._estimates_due.passes(time.monotonic_ns()):
            return
        motion = self._motions.pop(estimate.frame_id, None)
        for sent in self._messages.of_estimate(estimate, t_of(estimate, live=True), motion):
            self._send(sent)

    def _begin(self, estimate: Estimate) -> RosMessages | None:
        """Queries the vehicle's camera for a new drive; returns None without a reply."""
        try:
            answer = self._bus.query("configuration")
        except BusError as error:
            print(f"birdslam: ros: no camera of vehicle {self._vehicle!r}: {error}", file=sys.stderr, flush=True)
            return None
        if not answer or not answer[0].get("camera"):
            return None
        camera = msgspec.convert(answer[0]["camera"], Camera)
        messages = RosMessages(self._node.types.make, camera, self._vehicle, frames=self._frames)
        self._send(messages.fixed(t_of(estimate, live=True)))
        self._motions.clear()
        return messages

    def _publish_map(self) -> None:
        while (message := self._maps.recv(0.0)) is not None:
            update: MapUpdate = message.record
            if self._messages is not None:
                for sent in self._messages.of_map(update, time.time_ns()):
                    self._send(sent)
        newest = self._map_poses.recv(0.0)
        if newest is not None and self._messages is not None and self._map_poses_due.passes(time.monotonic_ns()):
            for sent in self._messages.of_map_pose(newest.record, t_of(newest.record, live=True)):
                self._send(sent)

    def _publish_healths(self) -> None:
        for subscriber in self._healths.values():
            while (message := subscriber.recv(0.0)) is not None:
                health: Health = message.record
                if self._messages is not None:
                    self._send(self._messages.diagnostic(health.node, *_judged(health), time.time_ns()))

    def _publish_silence(self) -> None:
        missing = sorted({"capture", "perceive", "optimize"} - self.alive)
        text = f"no estimate; not alive: {', '.join(missing)}" if missing else "no estimate"
        if self._messages is not None:
            self._send(self._messages.diagnostic("estimate", Level.ERROR, text, {}, time.time_ns()))

    def _send(self, sent: Sent) -> None:
        topic, message = sent
        try:
            self._publishers[topic].publish(message)
        except zenoh.ZError as error:  # only this message is lost
            print(f"birdslam: ros: {topic}: {error}", file=sys.stderr, flush=True)

    def close(self) -> None:
        """Closes the bus and the node."""
        self._bus.close()
        self._node.close()


def _judged(health: Health) -> tuple[Level, str, dict[str, Any]]:
    values = {
        "rate_hz": f"{health.rate_hz:.1f}",
        "dropped": health.dropped,
        "step_p99_ms": f"{health.step.p99_ms:.1f}",
        "age_p99_ms": f"{health.age.p99_ms:.1f}",
        "overruns": health.overruns,
        "restarts": health.restarts,
        "mode": health.mode,
        "rss_mib": health.rss_bytes >> 20,
    }
    statuses = ", ".join(status.value for status in health.status)
    return Level.WARN if health.status else Level.OK, statuses or "ok", values


def run(configuration: Configuration, rate_hz: float | None = None) -> None:
    """Runs until SIGTERM or SIGINT. Raises ConfigurationError, BagError without rosbags, and as Bus does."""
    vehicle, config = configuration.vehicle, configuration.ros
    signals.block()
    zenoh.init_log_from_env_or("error")
    send(
        *("ros", f"the ROS node of vehicle {vehicle!r}", config.router, lambda: RosNode(config, NODE), NoRouter),
        lambda node: RosBridge(vehicle, node, configuration.runtime_dir, rate_hz),
    )
