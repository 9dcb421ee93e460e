"""Many vehicles at one router: a listener's ages, its processor time and the bytes, with one that floods or dies.

    python -m perf fleet [--source demo] [--vehicles 1,3,10,100] [--seconds 5] [--runs 0] [--output F.json]

The router is `birdslam router` with mutual TLS and a certificate for each vehicle. Up to three vehicles are processes
that go the whole way (bus, uplink, router), the others sessions of their own in two processes. All replay the estimates
of one drive, at the rate. The listener is a process with the client `Fleet`, which reads each estimate, or (`newest`) a
table of all twice a second. `--runs N` then does it with N real `birdslam run`s and their `birdslam uplink`s.
"""

from __future__ import annotations

import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import msgspec
import psutil

from birdslam import BirdSLAM
from birdslam.perf.errors import PerfError
from birdslam.perf.processes import birdslam_command, free_port
from birdslam.perf.reporting.arguments import benchmark_parser, numbers
from birdslam.perf.reporting.figures import Ledger, curve, noise, spread, spread_text
from birdslam.perf.reporting.machine import ROOT, Steal
from birdslam.perf.robustness.fleet_sides import Plan
from birdslam.runtime.wire import encode
from birdslam.sources.opening import open_recording

label = "many vehicles at one router: a listener's ages and CPU, bytes, with one that floods or dies"

WHOLE = 3  # vehicles that go the whole way, each a process
REPLAYERS = 2  # processes for all others
FLOOD = "flood"
FLOOD_TIMES = 100  # of the rate
_END_S = 10.0  # for a process to end
CONDITIONS = ("each", "newest", "flood", "death")


@dataclass
class Process:
    """One of ours, with the line that it says when it is ready."""

    process: subprocess.Popen[str]

    def read(self) -> str:
        out: IO[str] | None = self.process.stdout
        assert out is not None
        line = out.readline()
        if not line:
            raise PerfError(f"{self.process.args!r} ended with {self.process.wait()}")
        return line.strip()

    def end(self) -> None:
        """By the end of its standard input; killed where that takes too long."""
        try:
            self.process.communicate(timeout=_END_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.communicate()


class Place:
    """A folder with certificates, the estimates of a drive and plans."""

    def __init__(self, folder: Path, names: list[str], rate_hz: float) -> None:
        self.folder, self.names, self.rate_hz = folder, names, rate_hz
        self._number = itertools.count()
        self.router = f"tls/127.0.0.1:{free_port()}"
        script = ROOT / "deploy" / "certificates.sh"
        if not script.is_file() or shutil.which("openssl") is None:
            raise PerfError("needs the checkout's deploy/certificates.sh, and openssl")
        wanted = [("router", "127.0.0.1"), ("planner", "operator"), *(("uplink", name) for name in names)]
        for what in wanted:
            subprocess.run([str(script), str(folder), *what], check=True, capture_output=True)
        (folder / "run").mkdir(mode=0o700)

    def start(self, role: str, vehicles: list[str], **changes: Any) -> Process:
        plan = Plan(
            folder=str(self.folder), router=self.router, vehicles=tuple(vehicles), rate_hz=self.rate_hz, **changes
        )
        file = self.folder / f"plan-{next(self._number)}.json"
        file.write_bytes(msgspec.json.encode(plan))
        return Process(_popen([sys.executable, "-m", "birdslam.perf.robustness.fleet_sides", role, str(file)]))

    @contextmanager
    def routing(self) -> Iterator[psutil.Process]:
        """`birdslam router` over all of them."""
        file = self.folder / "router.toml"
        file.write_text(
            f'[router]\nlisten = "{self.router}"\nca = "ca.pem"\ncertificate = "router.pem"\nkey = "router.key"\n'
            f'listeners = ["operator"]\nvehicles = {json.dumps(self.names)}\n'
        )
        router = Process(_popen(birdslam_command("router", str(file))))
        try:
            while "is open" not in router.read():
                continue
            yield psutil.Process(router.process.pid)
        finally:
            router.process.terminate()
            router.end()


def _popen(command: list[str]) -> subprocess.Popen[str]:
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True)


def run(arguments: list[str]) -> None:
    parser = benchmark_parser("fleet", label)
    parser.add_argument("--source", default="demo", metavar="URI", help="whose estimates are replayed (demo)")
    parser.add_argument("--frames", type=int, default=150, metavar="N", help="of it")
    parser.add_argument("--vehicles", type=numbers, default=(1, 3, 10, 100), help="how many, a list")
    parser.add_argument("--conditions", default=",".join(CONDITIONS), help="a list")
    parser.add_argument("--rate", type=float, default=33.0, metavar="HZ", help="of each vehicle")
    parser.add_argument("--seconds", type=float, default=5.0, help="of each row")
    parser.add_argument("--runs", type=int, default=0, metavar="N", help="then with N real runs of the source")
    options = parser.parse_args(arguments)
    conditions = options.conditions.split(",")
    if unknown := set(conditions) - set(CONDITIONS):
        parser.error(f"there is no condition {min(unknown)!r}: {', '.join(CONDITIONS)}")
    settings = {"source": options.source, "rate_hz": options.rate, "seconds": options.seconds}
    with Ledger(options.output, label, **settings) as ledger, tempfile.TemporaryDirectory(prefix="fleet") as folder:
        names = [f"v{number}" for number in range(max(*options.vehicles, options.runs))]
        place = Place(Path(folder), [*names, FLOOD], options.rate)
        sizes = write_estimates(Path(folder) / "estimates.msgpack", options.source, options.frames)
        ledger.set(estimate_bytes=spread(sizes))
        print(f"{len(sizes)} estimates of {options.source}: {spread_text(spread(sizes), 'B')}", flush=True)
        with place.routing() as router:
            for count in options.vehicles:
                with vehicles(place, names[:count]) as senders:
                    for condition in conditions:
                        if condition != "death" or count > 1:
                            row = measure(place, router, names[:count], condition, options.seconds, senders)
                            ledger.add(f"{count} vehicles, {condition}", row_text(row), **row)
            if options.runs:
                with runs(place, names[: options.runs], options.source):
                    row = measure(place, router, names[: options.runs], "each", options.seconds, [])
                    ledger.add(f"{options.runs} runs", row_text(row), **row)


def write_estimates(file: Path, source: str, frames: int) -> list[int]:
    """The estimates of a drive, encoded; gives their sizes in bytes."""
    recording = open_recording(source)
    slam = BirdSLAM.with_shipped_networks(recording.camera, rate_hz=recording.rate_hz)
    encoded = [encode(slam.step(frame)[1]) for frame in itertools.islice(recording.undistorted_frames(), frames)]
    if not encoded:
        raise PerfError(f"{source}: no frames")
    file.write_bytes(msgspec.msgpack.encode(encoded))
    return [len(one) for one in encoded]


@contextmanager
def vehicles(place: Place, names: list[str]) -> Iterator[list[Process]]:
    """All of them at work; gives the processes of those that go the whole way."""
    single, many = names[:WHOLE], names[WHOLE:]
    started: list[Process] = []
    try:
        started += [place.start("whole", [name]) for name in single]
        groups = [group for first in range(REPLAYERS) if (group := many[first::REPLAYERS])]
        started += [place.start("replayed", group) for group in groups]
        for process in started:
            process.read()
        yield started[: len(single)]
    finally:
        for process in started:
            process.end()


@contextmanager
def runs(place: Place, names: list[str], source: str) -> Iterator[None]:
    """`birdslam run` and `birdslam uplink` of each name."""
    with ExitStack() as stack:
        for name in names:
            file = place.folder / f"{name}.toml"
            file.write_text(
                f'vehicle = "{name}"\noutput = "out-{name}"\n[source]\nuri = "{source}"\nrate = {place.rate_hz}\n'
                f'loop = true\n[runtime]\nruntime_dir = "run"\nspares = false\n[fleet]\nrouter = "{place.router}"\n'
                f'ca = "ca.pem"\ncertificate = "{name}.vehicle.pem"\nkey = "{name}.vehicle.key"\n'
            )
            for command in ("run", "uplink"):
                process = subprocess.Popen(
                    birdslam_command(command, str(file)), stdout=subprocess.DEVNULL, start_new_session=True
                )
                stack.callback(process.wait)
                stack.callback(process.send_signal, signal.SIGTERM)
        yield


def measure(
    place: Place, router: psutil.Process, names: list[str], condition: str, seconds: float, senders: list[Process]
) -> dict[str, Any]:
    """One row: a fresh listener over the vehicles that are there."""
    steal = Steal()
    left_out = {"flood": [FLOOD], "death": names[:1]}.get(condition, [])
    mode = "newest" if condition == "newest" else "each"
    with ExitStack() as stack:
        if condition == "flood":
            flood = place.start("flood", [FLOOD], flood_hz=FLOOD_TIMES * place.rate_hz)
            stack.callback(flood.end)
            flood.read()
        listener = place.start("listener", names, seconds=seconds, mode=mode, left_out=tuple(left_out))
        stack.callback(listener.end)
        listener.read()
        before_s, before_bytes, begun_s = sum(router.cpu_times()[:2]), _loopback_bytes(), time.monotonic()
        killed_ns = 0
        if condition == "death":
            time.sleep(seconds / 2)
            killed_ns = time.monotonic_ns()
            senders[0].process.kill()
        said = json.loads(listener.read())
        took_s = time.monotonic() - begun_s
        router_s, wire_bytes = sum(router.cpu_times()[:2]) - before_s, _loopback_bytes() - before_bytes
    counted = len(names) - (condition == "death")
    row = {
        "vehicles": len(names),
        "condition": condition,
        "arrival_ms": spread(said["arrival_ms"]),
        "read_ms": spread(said["read_ms"]),
        "curve_ms": curve(said["arrival_ms"]),
        "noise": noise("arrival_ms", said["arrival_ms"]),
        "received_hz": said["received"] / said["took_s"] / counted,
        "read_share": len(said["read_ms"]) / max(1, said["received"]),
        "lost": said["lost"],
        "received": said["received"],
        "listener_cpu_percent": 100.0 * said["cpu_s"] / said["took_s"],
        "router_cpu_percent": 100.0 * router_s / took_s,
        "payload_bytes_s": said["bytes"] / said["took_s"] / counted,
        "load": os.getloadavg()[0],
        "steal_percent": steal.percent(),
    }
    if condition in ("each", "newest"):
        row["wire_bytes_s"] = wire_bytes / took_s / counted / 2  # each byte goes to the router, and from it
    if condition == "flood":
        row["flood_sent_hz"] = FLOOD_TIMES * place.rate_hz
        row["flood_received_hz"] = said["received_left_out"] / said["took_s"]
    if killed_ns and names[0] in said["not_alive_ns"]:
        row["reported_dead_after_ms"] = (said["not_alive_ns"][names[0]] - killed_ns) / 1e6
    return row


def _loopback_bytes() -> int:
    return int(psutil.net_io_counters(pernic=True)["lo"].bytes_sent)


def row_text(row: dict[str, Any]) -> str:
    """A row for a person."""
    parts = [
        f"age on arrival {spread_text(row['arrival_ms'], 'ms')}",
        f"received {row['received_hz']:.1f} Hz each, read {100 * row['read_share']:.0f} %",
        f"lost {row['lost']}",
        f"CPU listener {row['listener_cpu_percent']:.0f} %, router {row['router_cpu_percent']:.0f} %",
        f"{row['payload_bytes_s'] / 1e3:.1f} kB/s each"
        + (f" ({row['wire_bytes_s'] / 1e3:.1f} on the wire)" if "wire_bytes_s" in row else ""),
        f"load {row['load']:.1f}",
    ]
    if "flood_received_hz" in row:
        parts.append(f"of the flood's {row['flood_sent_hz']:.0f} Hz {row['flood_received_hz']:.0f} received")
    if "reported_dead_after_ms" in row:
        parts.append(f"reported dead after {row['reported_dead_after_ms']:.0f} ms")
    return "  ".join(parts)
