"""Does a listener of ROS 2 hear every estimate, and how late? A vehicle's bus, `birdslam ros`, a router and a listener
of the independent package zenoh-ros2-sdk, each a process of its own.

    python -m perf ros [--seconds 30] [--rate 33] [--vehicles 10]
"""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.perf.errors import PerfError
from birdslam.perf.processes import birdslam_command, free_port
from birdslam.perf.reporting.arguments import benchmark_parser
from birdslam.perf.reporting.figures import spread, spread_text
from birdslam.runtime.configuration import Configuration
from birdslam.runtime.supervision.query_server import QueryServer
from birdslam.runtime.transport.bus import Bus, Publisher
from birdslam.types import NS_PER_S, Estimate, VehicleEstimate

label = "a listener of ROS 2: messages lost, and their age"
PEER = "birdslam.perf.ros2.ros_peer"
VEHICLE = "ros-perf"
HEARD = {
    "/birdslam/odometry": "nav_msgs/msg/Odometry",
    "/birdslam/vehicles": "vision_msgs/msg/Detection3DArray",
    "/tf": "tf2_msgs/msg/TFMessage",
}
LIMIT_S = 60.0
LAST_S = 10.0  # for the last ones to come
COV = tuple(np.diag([0.01, 0.01, 1e-4]).ravel().tolist())


def check_peer() -> None:
    """Raises PerfError where the other side is not installed."""
    if importlib.util.find_spec("zenoh_ros2_sdk") is None:
        raise PerfError("the other side is the package zenoh-ros2-sdk: pip install zenoh-ros2-sdk")


@contextmanager
def peer(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    """A process of ros_peer.py that is ready."""
    command = [sys.executable, "-m", PEER, *arguments]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            if process.stdout.readline().strip() != "ready":
                raise PerfError(f"{PEER} {arguments[0]} did not begin")
            yield process
        finally:
            process.kill()


def estimate(frame: int, vehicles: int) -> Estimate:
    """As a drive among so many vehicles gives it, captured now."""
    now_ns = time.time_ns()
    users = tuple(
        VehicleEstimate(
            vehicle=k, T_world_vehicle=SE2(10.0 + k, 3.0, 0.1), cov=COV, velocity_mps=(5.0, 0.0),
            velocity_cov=(0.1, 0.0, 0.0, 0.1), age_ns=0, frames=9, label="car", length_m=4.2, width_m=1.8,
        )
        for k in range(vehicles)
    )  # fmt: skip
    return Estimate(
        epoch=0, frame_id=frame, t_source_ns=now_ns, t_capture_ns=time.monotonic_ns(), t_utc_ns=now_ns,
        T_world_ego=SE2(0.1 * frame, 0.0, 0.0), cov=COV, valid=True, vehicles=users,
    )  # fmt: skip


class Told(NamedTuple):
    """A message of a listener: its time, when it came (both UTC), and its fields."""

    t_ns: int
    came_ns: int
    message: dict[str, Any]

    @property
    def age_ms(self) -> float:
        """When it came."""
        return (self.came_ns - self.t_ns) / 1e6


class Heard:
    """What a listener prints, read on a thread of its own: messages by topic."""

    def __init__(self, listener: subprocess.Popen[str], topics: Iterable[str]) -> None:
        self.told: dict[str, list[Told]] = {topic: [] for topic in topics}
        self._since_ns = 0
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._read, args=(listener.stdout,), daemon=True)
        self._thread.start()

    def _read(self, lines: Iterable[str]) -> None:
        for line in lines:
            said = json.loads(line)
            message = said["message"]
            stamp = (message.get("header") or message["transforms"][0]["header"])["stamp"]
            told = Told(stamp["sec"] * NS_PER_S + stamp["nanosec"], said["came_ns"], message)
            with self._changed:
                if told.t_ns >= self._since_ns:
                    self.told[said["topic"]].append(told)
                    self._changed.notify_all()

    def wait(self, count: int, timeout_s: float) -> bool:
        """Until so many of each topic were heard; False where they were not within the time."""
        with self._changed:
            return self._changed.wait_for(lambda: min(map(len, self.told.values())) >= count, timeout_s)

    def begin(self) -> int:
        """From now on it counts, and only what was sent from now on; gives that time."""
        with self._changed:
            self._since_ns = time.time_ns()
            for found in self.told.values():
                found.clear()
            return self._since_ns


def run(arguments: list[str]) -> int:
    """Prints how many were sent and heard, topic by topic; 1 where one was lost."""
    parser = benchmark_parser("ros", label, output="")
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--rate", type=float, default=33.0)
    parser.add_argument("--vehicles", type=int, default=10)
    options = parser.parse_args(arguments)
    check_peer()
    port, camera = free_port(), Camera(640, 480, 500.0, 500.0, 320.0, 240.0, 1.5)
    frames = round(options.seconds * options.rate)
    with ExitStack() as stack:
        directory = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        bus = stack.enter_context(Bus(VEHICLE, "supervisor", hub=True, runtime_dir=directory))
        QueryServer(Configuration(vehicle=VEHICLE, camera=camera), bus)
        out = bus.publisher("estimate")
        stack.enter_context(peer("router", str(port)))
        wanted = [f"{topic}={kind}" for topic, kind in HEARD.items()]
        listener = stack.enter_context(peer("hear", str(port), "0", *wanted))
        there = ("--vehicle", VEHICLE, "--runtime-dir", str(directory), "--router", f"tcp/127.0.0.1:{port}")
        bridge = subprocess.Popen(birdslam_command("ros", "--domain", "0", *there))
        stack.callback(bridge.kill)
        if not out.wait_matched(LIMIT_S):
            raise PerfError("birdslam ros did not begin")
        heard = Heard(listener, HEARD)
        _drive(out, heard, frames, options.rate, options.vehicles)
        bridge.terminate()
        bridge.wait(LIMIT_S)
    for topic, told in heard.told.items():
        print(
            f"{topic:24}heard {len(told)} of {frames}   age {spread_text(spread([one.age_ms for one in told]), 'ms')}"
        )
    return int(any(len(told) != frames for told in heard.told.values()))


def _drive(out: Publisher, heard: Heard, frames: int, rate_hz: float, vehicles: int) -> None:
    """Sends them at their rate, once the way to the listener is there."""
    first = 0
    while not heard.wait(1, timeout_s=0.1):
        out.put(estimate(first, vehicles))
        first += 1
        if first > LIMIT_S / 0.1:
            raise PerfError("nothing comes to the listener")
    heard.begin()
    begin_s = time.monotonic()
    for frame in range(frames):
        time.sleep(max(0.0, begin_s + frame / rate_hz - time.monotonic()))
        out.put(estimate(first + frame, vehicles))
    heard.wait(frames, timeout_s=LAST_S)
