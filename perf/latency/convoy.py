"""The optimize process with a given number of visible vehicles: `python -m perf system --vehicles 0,5,10,15`.

Simulated measurements (birdslam/bench/simulation/drive.py) go over the real bus at the rate to the process that
`birdslam run` starts. This process replaces capture, perceive and the planner; the networks' time does not depend on
the number of vehicles.
"""

from __future__ import annotations

import signal
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import psutil

from birdslam.perf.errors import PerfError
from birdslam.perf.latency.drive import DriveConfig, drive
from birdslam.perf.reporting.figures import curve, spread
from birdslam.perf.reporting.machine import Steal
from birdslam.runtime.configuration import Configuration, complete, load, parse_setting
from birdslam.runtime.fields import parted
from birdslam.runtime.latency import stages
from birdslam.runtime.nodes.capture import stamps
from birdslam.runtime.nodes.sources import open_source
from birdslam.runtime.process.restarts import FIRST
from birdslam.runtime.supervision.processes import NodeLog, NodeProcess
from birdslam.runtime.transport.bus import Bus, Message, Subscriber
from birdslam.runtime.wire import Trace
from birdslam.types import FrameRef, Measurements

_VEHICLE = "perf"
_READY_S = 60.0
_SEED = 1


def measure(
    vehicles: int, rate_hz: float, seconds: float, warm_up_s: float, settings: tuple[str, ...]
) -> dict[str, Any]:
    """One row: time of the process's step, the hops to and from it, CPU and memory."""
    frames = round(rate_hz * (seconds + warm_up_s))
    world = drive(DriveConfig(frames=frames, rate_hz=rate_hz, vehicles=vehicles, traffic="convoy"), _SEED)
    with tempfile.TemporaryDirectory(prefix="perf") as folder:
        place = Path(folder)
        (place / "rt").mkdir(mode=0o700)
        configuration = _configuration(place / "rt", rate_hz, settings)
        log = NodeLog(place / "optimize.log")
        with (
            Bus(_VEHICLE, "supervisor", hub=True, runtime_dir=configuration.runtime_dir) as bus,
            closing(NodeProcess("optimize", configuration, log)) as process,
        ):
            bus.declare_alive()
            process.begin(FIRST)
            try:
                return _row(vehicles, bus, psutil.Process(process.pid), world.measurements, rate_hz, warm_up_s)
            except TimeoutError as error:
                raise PerfError(process.failure()) from error
            finally:
                process.send(signal.SIGTERM)


def _configuration(runtime_dir: Path, rate_hz: float, settings: tuple[str, ...]) -> Configuration:
    overrides, constants = parted(dict(parse_setting(text) for text in settings))
    overrides |= {"vehicle": _VEHICLE, "runtime.runtime_dir": str(runtime_dir)}
    overrides |= {"source.uri": "demo", "source.rate": rate_hz}
    configuration = load(None, overrides, constants=constants)
    source = open_source(configuration)
    return complete(configuration, source.camera, source.rate_hz)


def _row(
    vehicles: int, bus: Bus, process: psutil.Process, log: list[Measurements], rate_hz: float, warm_up_s: float
) -> dict[str, Any]:
    started = round(rate_hz * warm_up_s)
    steal, before_s, begun_s = Steal(), 0.0, 0.0
    messages: list[Message] = []
    for number, message in enumerate(_played(bus, log, rate_hz)):
        if number == started:
            steal, before_s, begun_s = Steal(), _cpu_s(process), time.monotonic()
        if number >= started and message is not None:
            messages.append(message)
    cpu_cores = (_cpu_s(process) - before_s) / (time.monotonic() - begun_s)
    split: dict[str, list[float]] = {}
    for message in messages:
        for name, ms in list(stages(message.trace, message.t_received_ns))[3:]:  # from the hop of perceive
            split.setdefault(name, []).append(ms)
    step_ms = np.array(split["optimize"])
    return {
        "vehicles": vehicles,
        "tracked": round(float(np.mean([len(message.record.vehicles) for message in messages])), 1),
        "frames": len(log) - started,
        "dropped": len(log) - started - len(messages),
        "cpu_cores": round(cpu_cores, 4),
        "rss_mb": round(process.memory_info().rss / 2**20, 1),
        "stages": {name: spread(values) for name, values in split.items()},
        "step_ms": spread(step_ms),
        "curve_ms": curve(step_ms),
        "steal_percent": steal.percent(),
    }


def _cpu_s(process: psutil.Process) -> float:
    times = process.cpu_times()
    return float(times.user + times.system)


def _played(bus: Bus, log: list[Measurements], rate_hz: float) -> Iterator[Message | None]:
    """The estimate of each frame; None if it did not arrive before the next frame."""
    estimates = bus.subscriber("estimate")
    frames, measurements = bus.publisher("frame"), bus.publisher("measurements")
    if bus.wait_alive({"optimize"}, _READY_S) or not measurements.wait_matched(_READY_S):
        raise TimeoutError
    begun_ns = time.monotonic_ns()
    for number, record in enumerate(log):
        due_ns = begun_ns + round(number * 1e9 / rate_hz)
        time.sleep(max(0.0, (due_ns - time.monotonic_ns()) / 1e9))
        now_ns = time.monotonic_ns()
        record = msgspec.structs.replace(record, t_capture_ns=now_ns)
        first = Trace().after("capture", now_ns, now_ns)
        frames.put(FrameRef(**stamps(record), status=record.status), first)
        second = first.sent(now_ns, number + 1).after("perceive", now_ns, time.monotonic_ns())
        measurements.put(record, second)
        yield _answer(estimates, record.frame_id, due_ns + round(1e9 / rate_hz))


def _answer(estimates: Subscriber, frame_id: int, until_ns: int) -> Message | None:
    while (left_s := (until_ns - time.monotonic_ns()) / 1e9) > 0.0:
        message = estimates.recv(left_s)
        if message is not None and message.record.frame_id == frame_id:
            return message
    return None


def summary(row: dict[str, Any]) -> str:
    """A row as text."""
    step = row["step_ms"]
    times = "  ".join(f"{name} {step[name]:.2f}" for name in ("p50", "p99", "max"))
    lost = f"dropped {row['dropped']} of {row['frames']}"
    return f"{times} ms  {row['cpu_cores']:.3f} cores  {row['rss_mb']:.0f} MB  tracked {row['tracked']}  {lost}"
