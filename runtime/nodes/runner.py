"""The loop of every node: receive, step, send, measure, beat.

`python -m birdslam.runtime.nodes.runner NODE VITALS_FD PARENT_PID`; standard input: the configuration as a line of
JSON, later the assignment as another; until then the process is a spare. Exit status: 0 at the end of the source or
on request; 1 failure at run time (camera lost, bug); 2 invalid input of the user.
"""

from __future__ import annotations

import logging
import os
import select
import signal
import sys
import time
from collections.abc import Callable
from types import FrameType
from typing import TypeGuard

import msgspec

from birdslam.perception import ModelError
from birdslam.runtime.configuration import Configuration, ConfigurationError
from birdslam.runtime.environment import USER_ERROR_STATUS
from birdslam.runtime.nodes.coasting import Overdue
from birdslam.runtime.nodes.meter import Meter
from birdslam.runtime.nodes.nodes import Node, prepare
from birdslam.runtime.nodes.sources import SourceError
from birdslam.runtime.process import realtime
from birdslam.runtime.process.child import begin, give_back_memory
from birdslam.runtime.process.restarts import Assignment
from birdslam.runtime.process.vitals import Vitals
from birdslam.runtime.topology import MAP, NODES, RECORDER, TOPICS
from birdslam.runtime.transport.bus import Bus, Publisher
from birdslam.runtime.wire import Health
from birdslam.sources.recording import DatasetError
from birdslam.types import Estimate, FrameRef, Measurements, Status

log = logging.getLogger(__name__)

USER_ERRORS = (ConfigurationError, DatasetError, ModelError, SourceError)
BESIDE_PATIENCE_S = 0.2  # max. delay of a restarted node's first records
DOWNSTREAM = {"capture": "perceive", "perceive": "optimize", "optimize": "supervisor"}  # node -> its receiver


class Stop:
    """Handles the signals of the supervisor.

    SIGTERM: end after the current step, or at once during the start. SIGINT: drain, that is, end the source and process
    all frames in flight.
    """

    def __init__(self) -> None:
        self.at_work = False
        self.asked = False
        self.draining = False
        self._event = os.eventfd(0)
        signal.signal(signal.SIGTERM, self._handle)
        signal.signal(signal.SIGINT, self._handle)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if not self.at_work:
            raise SystemExit(0)
        self.draining = True
        self.asked = self.asked or number == signal.SIGTERM
        os.eventfd_write(self._event, 1)

    def wait(self, timeout_s: float) -> bool:
        """Sleeps for `timeout_s` (exact to about 50 us) or until a signal; returns whether one has arrived."""
        select.select([self._event], [], [], timeout_s)
        return self.draining


def run(
    name: str,
    configuration: Configuration,
    make: Callable[[Bus, Callable[[float], object], Assignment], Node],
    assignment: Assignment,
    vitals: Vitals,
    stop: Stop,
) -> None:
    """Builds a node and runs it to its end."""
    runtime = configuration.runtime
    with Bus(
        configuration.vehicle, name, runtime_dir=configuration.runtime_dir, lossless=configuration.lossless
    ) as bus:
        node = make(bus, stop.wait, assignment)
        try:
            publishers = {TOPICS[topic].record: bus.publisher(topic) for topic in NODES[name].sends}
            _await_downstream(name, bus, publishers, runtime.ready_timeout_s)
            first_s = configuration.recording.ready_timeout_s
            bus.wait_alive(_observers(configuration), BESIDE_PATIENCE_S if assignment.restarts else first_s)
            realtime.freeze_objects()
            stop.at_work = True
            vitals.beat()  # before `ready`: a node that is ready without a beat counts as stalled
            vitals.count(ready=1)
            bus.declare_alive()
            _loop(node, publishers, Meter(name, configuration, assignment), vitals, stop, configuration)
        finally:
            node.close()


def _observers(configuration: Configuration) -> set[str]:
    """Returns the processes that must receive the first frame of a drive."""
    there = {RECORDER.name: bool(configuration.recording.file), MAP.name: configuration.maps_live}
    return {name for name, is_there in there.items() if is_there}


def _await_downstream(name: str, bus: Bus, publishers: dict[type, Publisher], timeout_s: float) -> None:
    """Waits for the receiver. Nodes become ready from supervisor to capture, so that all receive the first frame."""
    until_s = time.monotonic() + timeout_s
    missing = bus.wait_alive({DOWNSTREAM[name]}, timeout_s)
    main = publishers[TOPICS[NODES[name].sends[0]].record]
    if missing or not main.wait_matched(max(0.0, until_s - time.monotonic())):
        raise TimeoutError(f"{DOWNSTREAM[name]} was not ready to receive within {timeout_s:g} s")


def _is_frame(record: msgspec.Struct) -> TypeGuard[FrameRef | Measurements | Estimate]:
    return isinstance(record, FrameRef | Measurements | Estimate) and not _ends(record)


def _ends(record: msgspec.Struct) -> bool:
    """Whether the record ends the run."""
    return isinstance(record, FrameRef | Measurements | Estimate) and Status.END_OF_SOURCE in record.status


def _loop(
    node: Node,
    publishers: dict[type, Publisher],
    meter: Meter,
    vitals: Vitals,
    stop: Stop,
    configuration: Configuration,
) -> None:
    name, beat_s = meter.node, configuration.runtime.beat_s
    budget_ns = round(configuration.budgets.end_to_end_ms * 1e6)
    while not (node.ended or stop.asked):
        vitals.beat()
        if stop.draining:
            node.drain()
        message = node.receive(beat_s)
        now_ns = time.monotonic_ns()
        if message is not None:
            taken_ns = now_ns
            overdue = isinstance(message.record, Overdue)
            if not overdue:
                meter.received(taken_ns)
            waits = message.trace.stages and not overdue  # in the queue of this node
            arrived_ns = message.t_received_ns if waits else 0
            for record in node.step(message.record):
                now_ns = time.monotonic_ns()
                trace = message.trace.after(name, taken_ns, now_ns, arrived_ns)
                if _is_frame(record):
                    vitals.count(
                        next_frame=record.frame_id + 1, t_source_ns=record.t_source_ns, t_capture_ns=record.t_capture_ns
                    )
                    if Status.PERCEPTION_LATE not in record.status:
                        meter.frame(record.t_capture_ns, trace)
                    if isinstance(record, Estimate):
                        trace = msgspec.structs.replace(trace, left_ns=record.t_capture_ns + budget_ns - now_ns)
                publishers[type(record)].put(record, trace, must_arrive=node.ended or _ends(record))
        vitals.count(frames=meter.frames, ended=node.ended, **node.counters())
        if meter.due(now_ns):
            publishers[Health].put(meter.health(now_ns, node.mode, node.counters()))


def main(arguments: list[str]) -> int:
    """Entry point of a node's process."""
    stop = Stop()
    name, configuration, vitals = begin(arguments)
    try:
        make = prepare(name, configuration)
        give_back_memory()
        vitals.count(prepared=1)
        line = sys.stdin.buffer.readline()
        if line:  # else the supervisor needs no spare any more
            realtime.reserve_for(name, configuration)  # not in a spare
            for refused in realtime.apply(name, configuration):
                log.warning("%s", refused)
            run(name, configuration, make, msgspec.json.decode(line, type=Assignment), vitals, stop)
    except USER_ERRORS as error:
        log.error("%s", error)
        return 1 if stop.at_work else USER_ERROR_STATUS
    except Exception:
        log.exception("%s failed", name)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
