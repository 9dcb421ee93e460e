"""A whole drive through ROS 2: images of another node in, estimates heard by another node, and the router lost between.

    python -m perf ros_drive [--source demo] [--seconds 30] [--rate 33] [--router-gone 3]

A car of the package zenoh-ros2-sdk publishes a recording's images, `birdslam run --source ros:/front/image` drives by
them, `birdslam ros` says what it finds, and a listener of that package hears it, each a process of its own. After it
the router is killed for so many seconds, and another one begun. Status 1 where an image got no estimate.
"""

from __future__ import annotations

import json
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import ExitStack, suppress
from pathlib import Path

import numpy as np

from birdslam.geometry.arrays import Ints
from birdslam.perf.errors import PerfError
from birdslam.perf.processes import birdslam_command, free_port
from birdslam.perf.reporting.arguments import benchmark_parser
from birdslam.perf.reporting.figures import spread, spread_text
from birdslam.perf.ros2.ros import LAST_S, Heard, check_peer, peer
from birdslam.perf.ros2.ros_peer import IMAGE
from birdslam.ros.messages import ODOMETRY
from birdslam.ros.parts import Level
from birdslam.runtime.transport.bus import Bus, BusClosed

label = "images of ROS 2 through the whole system to a listener of ROS 2: lost ones, their age, a router that goes"
VEHICLE = "ros-drive"
POSES, STATES = "/birdslam/odometry", "/diagnostics"
HEARD = {POSES: ODOMETRY, STATES: "diagnostic_msgs/msg/DiagnosticArray"}
BEGIN_S, BACK_S, END_S = 90.0, 30.0, 60.0
STEADY = 66  # valid estimates one after the other, before it counts
SAME_NS = 1_000_000  # an estimate's time is its image's, over two clocks
TURN_S = 0.05
DEPTH = 1024  # of what this process reads on the vehicle's bus


class Sent:
    """The times of the images that the car has sent (UTC, in ns), read on a thread of its own."""

    def __init__(self, car: subprocess.Popen[str]) -> None:
        self.t_ns: list[int] = []
        assert car.stdout is not None
        self._thread = threading.Thread(target=self._read, args=(car.stdout,), daemon=True)
        self._thread.start()

    def _read(self, lines: Iterable[str]) -> None:
        for line in lines:
            self.t_ns.append(int(line))


class OnTheBus:
    """The times of a topic's frames (UTC, in ns) on the vehicle's own bus, read on a thread of its own; of capture's
    also how many had given way to newer ones by then.
    """

    def __init__(self, bus: Bus, topic: str) -> None:
        self.t_ns: list[int] = []
        self.gave_way: list[int] = []
        self._messages = bus.subscriber(topic, DEPTH)
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        with suppress(BusClosed):
            while True:
                if (message := self._messages.recv()) is not None:
                    self.t_ns.append(message.record.t_utc_ns)
                    self.gave_way.append(getattr(message.record, "dropped", 0))


def valid_times(heard: Heard) -> list[int]:
    """The times of the estimates that may be driven by."""
    return [
        told.t_ns
        for told in list(heard.told[STATES])
        for status in told.message["status"]
        if status["name"] == "birdslam: estimate"
        and status["level"] < Level.ERROR
        and status["message"] != "no estimate"
    ]


def without(images_ns: Ints, of_ns: Iterable[int]) -> Ints:
    """The images whose time is none of these."""
    estimates_ns = np.array(sorted(of_ns), dtype=np.int64)
    if not estimates_ns.size:
        return images_ns
    after = np.clip(np.searchsorted(estimates_ns, images_ns), 1, max(estimates_ns.size - 1, 1))
    near = [np.abs(estimates_ns[np.minimum(at, estimates_ns.size - 1)] - images_ns) for at in (after - 1, after)]
    return images_ns[np.minimum(*near) > SAME_NS]


def run(arguments: list[str]) -> int:
    """Prints what was lost."""
    parser = benchmark_parser("ros_drive", label, output="")
    parser.add_argument("--source", default="demo", metavar="URI", help="whose images the car sends, round and round")
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--rate", type=float, default=33.0)
    parser.add_argument("--router-gone", type=float, default=0.0, metavar="S")
    options, more = parser.parse_known_args(arguments)
    check_peer()
    port = free_port()
    with ExitStack() as stack:
        place = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        (place / "rt").mkdir(mode=0o700)
        router = stack.enter_context(ExitStack())
        router.enter_context(peer("router", str(port)))
        wanted = [f"{topic}={kind}" for topic, kind in HEARD.items()]
        heard = Heard(stack.enter_context(peer("hear", str(port), "0", *wanted)), HEARD)
        car = stack.enter_context(peer("car", str(port), "0", options.source, str(options.rate)))
        sent = Sent(car)
        vehicle, router_at = ("--vehicle", VEHICLE), f"tcp/127.0.0.1:{port}"
        node = ("--set", f"ros.router={router_at}", "--set", "ros.domain=0")
        output = ("--output", str(place / "out"), "--set", f"runtime.runtime_dir={place / 'rt'}")
        log = stack.enter_context((place / "run.log").open("w+"))
        drive = subprocess.Popen(
            birdslam_command("run", "--source", f"ros:{IMAGE}", *vehicle, *node, *output, *more), stderr=log
        )
        stack.callback(drive.kill)
        bridge = subprocess.Popen(birdslam_command("ros", *vehicle, *node, "--runtime-dir", str(place / "rt")))
        stack.callback(bridge.kill)

        def until(there: Callable[[], bool], limit_s: float, what: str) -> None:
            until_s = time.monotonic() + limit_s
            while not there():
                if drive.poll() is not None or time.monotonic() > until_s:
                    raise PerfError(f"{what}: {(place / 'run.log').read_text()[-1000:]}")
                time.sleep(TURN_S)

        until(lambda: len(valid_times(heard)) >= STEADY, BEGIN_S, "no valid estimate is heard")
        bus = stack.enter_context(Bus(VEHICLE, "ros-drive", runtime_dir=place / "rt"))
        captured, estimated = OnTheBus(bus, "frame"), OnTheBus(bus, "estimate")
        until(lambda: bool(captured.t_ns and estimated.t_ns), BEGIN_S, "nothing is heard on the bus")
        begin_ns = heard.begin()
        time.sleep(options.seconds)
        end_ns = time.time_ns()
        until(lambda: bool(heard.told[POSES]) and heard.told[POSES][-1].t_ns >= end_ns, LAST_S, "nothing is heard")
        images = np.array([t for t in sent.t_ns if begin_ns <= t < end_ns], dtype=np.int64)
        poses = [told for told in heard.told[POSES] if told.t_ns < end_ns]
        valid = sum(begin_ns <= t < end_ns for t in valid_times(heard))
        lost = without(images, (told.t_ns for told in poses))
        not_captured, not_estimated = without(images, captured.t_ns), without(images, estimated.t_ns)
        gave_way = captured.gave_way[-1] - captured.gave_way[0]
        said = (
            f"{not_captured.size} were not captured (of all since, {gave_way} gave way to newer ones there, others "
            f"were lost on their way), "
            f"{np.setdiff1d(not_estimated, not_captured).size} were captured and got none, "
            f"{np.setdiff1d(lost, not_estimated).size} had one that was not heard"
        )
        print(f"images sent {len(images)} in {options.seconds:g} s, valid {valid}")
        print(f"without an estimate {len(lost)}: {said}")
        if lost.size:
            print("sent at", *(f"{(t - begin_ns) / 1e9:.2f}" for t in lost), "s")
        print(f"age of an image when its pose is heard: {spread_text(spread([told.age_ms for told in poses]), 'ms')}")
        if options.router_gone:
            router.close()
            time.sleep(options.router_gone)
            silent = len(heard.told[POSES])
            back_ns = time.time_ns()
            router.enter_context(peer("router", str(port)))
            until(lambda: len(heard.told[POSES]) > silent, BACK_S, "no pose is heard after the router came back")
            until(lambda: any(t > back_ns for t in valid_times(heard)), BACK_S, "no valid estimate after the router")
            first = next(t for t in valid_times(heard) if t > back_ns)
            again = heard.told[POSES][silent]
            print(
                f"router gone {options.router_gone:g} s: a pose is heard {(again.came_ns - back_ns) / 1e9:.2f} s after "
                f"another one begins, an image of {(first - back_ns) / 1e9:.2f} s after is valid again"
            )
        bridge.terminate()
        drive.terminate()
        drive.wait(END_S)
        summary = json.loads((place / "out" / "summary.json").read_text())
    dropped, by = summary["frames_dropped"], summary["dropped_by"]
    print(f"in all {summary['frames_in']} frames in, {dropped} dropped {by}, {summary['invalid_frames']} not valid")
    return int(lost.size > 0)
