"""The faults of the fault suite, each a context manager that lasts as long as the fault."""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import psutil

from birdslam.perf.robustness.faulty_vehicle import ROOT, Vehicle
from birdslam.runtime.doctor.costs import busy_cores
from birdslam.runtime.topology import NODES, QUERIES, key_of
from birdslam.runtime.transport.presence import ring_path

Injection = Callable[[Vehicle], contextlib.AbstractContextManager[None]]

PROMISE_S = {"capture": 1.0, "perceive": 2.0, "optimize": 1.0}  # max. time to a valid estimate after kill -9
READERS = {"frame": "perceive", "measurements": "optimize", "estimate": "planner"}


@dataclass(frozen=True)
class Fault:
    """`inject` is the context of the fault, which lasts `lasts_s`."""

    name: str
    node: str
    inject: Injection
    lasts_s: float = 0.0
    blind: bool = False  # no frame captured during the fault may be valid
    promise_s: float | None = None


def signalled(node: str, number: signal.Signals, then: signal.Signals | None = None) -> Injection:
    """A signal to the process of a node, and optionally another at the end."""

    @contextlib.contextmanager
    def inject(vehicle: Vehicle) -> Iterator[None]:
        process = vehicle.node(node)
        process.send_signal(number)
        yield
        if then is not None:
            with contextlib.suppress(psutil.NoSuchProcess):
                process.send_signal(then)

    return inject


def camera(name: str) -> Injection:
    """A fault of the camera (perf/faulty_camera)."""

    @contextlib.contextmanager
    def inject(vehicle: Vehicle) -> Iterator[None]:
        vehicle.fault(name)
        yield
        vehicle.fault("")

    return inject


@contextlib.contextmanager
def cpu_hog(vehicle: Vehicle) -> Iterator[None]:
    """Two busy processes for each core."""
    with busy_cores(2 * (os.cpu_count() or 1)):
        yield


def no_memory(node: str) -> Injection:
    """The process can't allocate more memory."""

    @contextlib.contextmanager
    def inject(vehicle: Vehicle) -> Iterator[None]:
        process = vehicle.node(node)
        limit = process.memory_info().vms
        resource.prlimit(process.pid, resource.RLIMIT_AS, (limit, limit))
        yield

    return inject


def full_disk(node: str) -> Injection:
    """The process can't extend files."""

    @contextlib.contextmanager
    def inject(vehicle: Vehicle) -> Iterator[None]:
        process = vehicle.node(node)
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (1, resource.RLIM_INFINITY))
        yield
        with contextlib.suppress(ProcessLookupError):  # the recorder ends by itself
            resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))

    return inject


@contextlib.contextmanager
def _beside(program: str, *arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    """Another process, from its message "at work" until the end of the fault."""
    process = subprocess.Popen(
        [sys.executable, "-c", program, *arguments], stdout=subprocess.PIPE, env={**os.environ, "PYTHONPATH": str(ROOT)}
    )
    assert process.stdout is not None
    try:
        assert process.stdout.readline().strip() == b"at work"
        yield process
    finally:
        process.kill()
        process.communicate()


_SENDER = """
import sys, time
from pathlib import Path
import numpy as np
from birdslam.runtime.transport.bus import Bus
key, size, count = sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
random = np.random.default_rng(7)
with Bus("faults", "intruder", runtime_dir=Path(sys.argv[1])) as bus:
    assert not bus.wait_alive(("capture", "perceive", "optimize"), 10.0)
    publisher = bus._session.declare_publisher(key)
    print("at work", flush=True)
    for number in range(count):
        publisher.put(random.bytes(size))
        if size < 10_000:
            time.sleep(0.001)
    time.sleep(60.0)
"""


def intruder(topic: str, size: int, count: int) -> Injection:
    """Random bytes on a topic of the bus, from a program of the same user."""

    @contextlib.contextmanager
    def inject(vehicle: Vehicle) -> Iterator[None]:
        key = key_of(vehicle.vehicle, topic)
        with _beside(_SENDER, str(vehicle.runtime_dir), key, str(size), str(count)):
            yield

    return inject


_ASKER = """
import sys
from pathlib import Path
import zenoh
from birdslam.runtime.transport.bus import Bus
with Bus("faults", "asker", runtime_dir=Path(sys.argv[1])) as bus:
    assert not bus.wait_alive(("supervisor", "optimize"), 10.0)
    print("at work", flush=True)
    while True:
        for key in sys.argv[2].split(","):
            bus._session.get(key, lambda reply: None, timeout=0.5)
        list(bus._session.get(key, zenoh.handlers.FifoChannel(4), timeout=0.5))
"""


@contextlib.contextmanager
def queries(vehicle: Vehicle) -> Iterator[None]:
    """A program that sends all queries without pause."""
    keys = ",".join(key_of(vehicle.vehicle, name) for name in (*QUERIES, "estimate", "measurements"))
    with _beside(_ASKER, str(vehicle.runtime_dir), keys):
        yield


_SCRIBBLER = """
import mmap, os, sys, time
import numpy as np
random = np.random.default_rng(7)
file = os.open(sys.argv[1], os.O_RDWR)
memory = np.frombuffer(mmap.mmap(file, os.fstat(file).st_size), dtype=np.uint8)
print("at work", flush=True)
while True:
    start = random.integers(64, len(memory) - 4096)
    memory[start : start + 4096] = random.integers(0, 256, 4096, dtype=np.uint8)
    time.sleep(0.0002)
"""


@contextlib.contextmanager
def scribbler(vehicle: Vehicle) -> Iterator[None]:
    """Random bytes in the shared memory of the frames, while they are written and read."""
    with _beside(_SCRIBBLER, str(ring_path(vehicle.vehicle, vehicle.runtime_dir))):
        yield


_SLOW = """
import sys
from pathlib import Path
from birdslam.runtime.client import Planner
with Planner("faults", Path(sys.argv[1])) as planner:
    planner.wait(10.0)
    print("at work", flush=True)
    while True:
        planner.wait()
"""


@contextlib.contextmanager
def slow_planner(vehicle: Vehicle) -> Iterator[None]:
    """Another planner that stops reading."""
    with _beside(_SLOW, str(vehicle.runtime_dir)) as slow:
        slow.send_signal(signal.SIGSTOP)
        yield


@contextlib.contextmanager
def kill_everything(vehicle: Vehicle) -> Iterator[None]:
    """Kills all processes and starts again with the files left behind."""
    everybody = [psutil.Process(vehicle.process.pid), *psutil.Process(vehicle.process.pid).children()]
    for process in everybody:
        process.kill()
    vehicle.process.wait()
    psutil.wait_procs(everybody, timeout=10.0)
    vehicle.start()
    yield


def _faults() -> Iterator[Fault]:
    for node in NODES:
        yield Fault("kill -9", node, signalled(node, signal.SIGKILL), promise_s=PROMISE_S[node])
    yield Fault("kill -9", "record", signalled("record", signal.SIGKILL))
    for node in (*NODES, "record", "supervisor"):
        yield Fault("SIGSTOP 2 s", node, signalled(node, signal.SIGSTOP, then=signal.SIGCONT), lasts_s=2.0)
    for node in NODES:
        yield Fault("no further memory", node, no_memory(node), lasts_s=2.0)
    yield Fault("CPU hog, 2 a core, 3 s", "all", cpu_hog, lasts_s=3.0)
    for name in ("gone", "frozen", "black", "torn"):
        yield Fault(f"camera {name} 1.5 s", "capture", camera(name), lasts_s=1.5, blind=True)
    yield Fault("frames 400 ms late, 2 s", "capture", camera("late"), lasts_s=2.0)
    yield Fault("frames out of order, 2 s", "capture", camera("disorder"), lasts_s=2.0)
    yield Fault("scribbled shared memory, 2 s", "perceive", scribbler, lasts_s=2.0)
    yield Fault("UTC steps by 1 h and back", "all", camera("clock_step"), lasts_s=1.5)
    for topic, reader in READERS.items():
        yield Fault(f"malformed {topic} messages", reader, intruder(topic, 300, 1500), lasts_s=1.5)
    for topic, reader in READERS.items():
        yield Fault(f"{topic} flooded (60 kB each)", reader, intruder(topic, 60_000, 100_000), lasts_s=2.0)
    yield Fault("flood of queries, 2 s", "supervisor", queries, lasts_s=2.0)
    yield Fault("a planner that stands still", "planner", slow_planner, lasts_s=3.0)
    yield Fault("kill -9 of everything, second start", "all", kill_everything)
    # These come last: they leave the recording and the run's results incomplete
    for node in ("record", "supervisor"):
        yield Fault("full disk", node, full_disk(node), lasts_s=2.0)


FAULTS = tuple(_faults())
