"""Pixels and messages between two processes: our ring and bus, and plain zenoh.

    python -m perf transport [--seconds 3] [--carriers ring,zenoh] [--output F.json]

Each case has two fresh processes. `ring` is the transport of frames (pixels in shared memory with a checksum, a typed
FrameRef over zenoh), `bus` that of records (typed and validated at both ends); `zenoh` sends raw bytes.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from birdslam.perf.latency.carriers import CARRIERS
from birdslam.perf.reporting.arguments import benchmark_parser, numbers
from birdslam.perf.reporting.figures import Ledger, spread, spread_text
from birdslam.perf.reporting.machine import Steal
from birdslam.runtime.doctor.costs import busy_cores

label = "pixels and messages between processes: our ring and bus, and plain zenoh"

SIZES_B = {200: "200 B", 4_000: "4 kB", 1_397_250: "1.4 MB"}  # the last: a colour frame of KITTI
BUS_MAX_B = 60_000  # pixels never use the bus
PATIENCE_S = 30.0


@dataclass(frozen=True)
class Case:
    """One row."""

    carrier: str
    size: int
    rate_hz: int
    load: int

    @property
    def name(self) -> str:
        where = f"{self.load} core loaded" if self.load else "idle"
        return f"{self.carrier} {SIZES_B.get(self.size, f'{self.size} B')} {self.rate_hz} Hz {where}"


def run(arguments: list[str]) -> None:
    parser = benchmark_parser("transport", label)
    parser.add_argument("--carriers", default=",".join(CARRIERS), help="a list")
    parser.add_argument("--bytes", type=numbers, default=tuple(SIZES_B), help="a list")
    parser.add_argument("--rates", type=numbers, default=(33, 200), help="list of rates in Hz")
    parser.add_argument("--loads", type=numbers, default=(0, 1), help="list of numbers of loaded cores")
    parser.add_argument("--seconds", type=float, default=3.0, help="duration of each case")
    options = parser.parse_args(arguments)
    carriers = options.carriers.split(",")
    unknown = sorted(set(carriers) - set(CARRIERS))
    if unknown:
        parser.error(f"{unknown[0]!r} is not a carrier; expected one of {', '.join(CARRIERS)}")
    with Ledger(options.output, label, seconds=options.seconds) as ledger:
        for load in options.loads:
            with busy_cores(load):
                for case in cases(carriers, options.bytes, options.rates, load):
                    row = measure(case, options.seconds)
                    cpu = f"cpu {row['cpu_percent']['sender']:.1f} + {row['cpu_percent']['receiver']:.1f} %"
                    line = f"{spread_text(row['latency_ms'], 'ms')}  {cpu}  dropped {row['dropped']} of {row['sent']}"
                    ledger.add(case.name, line, **row)


def cases(carriers: list[str], sizes: tuple[int, ...], rates: tuple[int, ...], load: int) -> Iterator[Case]:
    """All cases; carriers alternate, so that changes of the machine's load affect all of them."""
    for size in sizes:
        for rate_hz in rates:
            for carrier in carriers:
                if carrier != "bus" or size <= BUS_MAX_B:
                    yield Case(carrier, size, rate_hz, load)


def measure(case: Case, seconds: float) -> dict[str, Any]:
    """Measures one case in two fresh processes."""
    messages = max(1, round(seconds * case.rate_hz))
    steal = Steal()
    with tempfile.TemporaryDirectory(prefix="perf") as place:
        what = (case.carrier, place, str(case.size), str(case.rate_hz), str(messages))
        listener = _start("listen", *what)
        try:
            _expect(listener, "listening")
            sender = _start("send", *what)
            try:
                _expect(sender, "connected")
                _tell(listener)
                _tell(sender)
                _expect(sender, "sent")
                received = json.loads(listener.communicate("\n", PATIENCE_S)[0])
                sent = json.loads(sender.communicate("\n", PATIENCE_S)[0])
            finally:
                sender.kill()
                sender.wait()
        finally:
            listener.kill()
            listener.wait()
    latency_ms = [ms for _, ms in sorted(received["arrivals"])]
    return {
        "carrier": case.carrier,
        "bytes": case.size,
        "rate_hz": case.rate_hz,
        "load": case.load,
        "latency_ms": spread(latency_ms),
        "cpu_percent": {
            "sender": round(100.0 * sent["cpu_s"] / sent["took_s"], 2),
            "receiver": round(100.0 * received["cpu_s"] / sent["took_s"], 2),
        },
        "sent": messages,
        "dropped": messages - len(latency_ms),
        "steal_percent": steal.percent(),
    }


def _start(*arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "birdslam.perf.latency.carriers", *arguments]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True)


def _expect(process: subprocess.Popen[str], word: str) -> None:
    assert process.stdout is not None
    line = process.stdout.readline().strip()
    if line != word:
        raise RuntimeError(f"perf.carriers printed {line!r} instead of {word!r}: {process.args!r}")


def _tell(process: subprocess.Popen[str]) -> None:
    assert process.stdin is not None
    process.stdin.write("\n")
    process.stdin.flush()
