"""The processes of `python -m perf fleet`: vehicles that publish recorded estimates, one that floods, and the listener.

    python -m birdslam.perf.robustness.fleet_sides ROLE PLAN.json

Each prints a line when it is ready and works until a line, or the end, comes on its standard input.
"""

from __future__ import annotations

import json
import struct
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import zenoh

from birdslam.runtime.configuration import FleetConfig, RuntimeConfig
from birdslam.runtime.fleet.link import open_link
from birdslam.runtime.fleet.listener import Fleet, FleetReading
from birdslam.runtime.fleet.uplink import Uplink
from birdslam.runtime.topology import alive_key, key_of
from birdslam.runtime.transport.bus import Bus
from birdslam.runtime.wire import Stage, Trace, decode, encode
from birdslam.types import Estimate

_UTC_FIELD = b"\xa8t_utc_ns\xcf"  # as MessagePack writes the field's name and that eight bytes follow
_NUMBER = struct.Struct(">Q")
_LINK_S = 60.0
_BURST = 20  # messages that the flood sends between two looks at the clock
NEWEST_PERIOD_S = 0.5  # between two tables of the newest estimates


class Plan(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a process is to do."""

    folder: str  # certificates and runtime directories
    router: str
    vehicles: tuple[str, ...]
    rate_hz: float
    seconds: float = 0.0  # of the listener
    mode: str = "each"  # of the listener: "each" estimate, or the "newest" of all every half second
    left_out: tuple[str, ...] = ()  # of the listener's ages: who floods, who dies
    flood_hz: float = 0.0

    def link(self, certificate: str) -> FleetConfig:
        ca, own, key = (str(Path(self.folder, f)) for f in ("ca.pem", f"{certificate}.pem", f"{certificate}.key"))
        return FleetConfig(router=self.router, ca=ca, certificate=own, key=key)

    def estimates(self) -> list[Estimate]:
        data = msgspec.msgpack.decode((Path(self.folder) / "estimates.msgpack").read_bytes(), type=list[bytes])
        return [decode(one, Estimate) for one in data]


def _paced(rate_hz: float, ended: threading.Event, send: Callable[[int], None]) -> None:
    begun_s = time.monotonic()
    number = 0
    while not ended.wait(max(0.0, begun_s + number / rate_hz - time.monotonic())):
        send(number)
        number += 1


def whole(plan: Plan, ended: threading.Event) -> None:
    """One vehicle by the whole way: its optimizer's bus, its uplink, the router."""
    (name,) = plan.vehicles
    records = plan.estimates()
    with Bus(name, "optimize", hub=True, runtime_dir=Path(plan.folder, "run")) as bus:
        out = bus.publisher("estimate")
        link = plan.link(f"{name}.vehicle")
        with Uplink(name, link, open_link(link, _LINK_S), Path(plan.folder, "run")):
            bus.declare_alive()
            print("ready", flush=True)

            def send(number: int) -> None:
                record = records[number % len(records)]
                out.put(msgspec.structs.replace(record, t_utc_ns=time.time_ns(), t_capture_ns=time.monotonic_ns()))

            _paced(plan.rate_hz, ended, send)


class _Replayed:
    """A vehicle that is a session alone: bytes that were encoded before, with the time and the number of now."""

    def __init__(self, plan: Plan, name: str, payloads: list[bytearray]) -> None:
        self._session = open_link(plan.link(f"{name}.vehicle"), _LINK_S)
        self._payloads = payloads
        self._at = [payload.index(_UTC_FIELD) + len(_UTC_FIELD) for payload in payloads]
        self._sent = 0
        self._out = self._session.declare_publisher(
            key_of(name, "estimate"),
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.REAL_TIME,
            express=False,
        )
        self._token = self._session.liveliness().declare_token(alive_key(name, "optimize"))

    def send(self) -> None:
        which = self._sent % len(self._payloads)
        self._sent += 1
        now_ns = time.monotonic_ns()
        _NUMBER.pack_into(self._payloads[which], self._at[which], time.time_ns())
        trace = Trace((Stage("optimize", now_ns, now_ns),)).sent(now_ns, self._sent)
        self._out.put(bytes(self._payloads[which]), attachment=encode(trace))

    def close(self) -> None:
        self._session.close()


def _payloads(plan: Plan) -> list[bytearray]:
    now_ns = time.time_ns()
    return [bytearray(encode(msgspec.structs.replace(record, t_utc_ns=now_ns))) for record in plan.estimates()]


def replayed(plan: Plan, ended: threading.Event) -> None:
    """Many vehicles in one process, each with a session of its own, one after the other through each period."""
    payloads = _payloads(plan)
    vehicles = [_Replayed(plan, name, payloads) for name in plan.vehicles]
    print("ready", flush=True)
    _paced(plan.rate_hz * len(vehicles), ended, lambda number: vehicles[number % len(vehicles)].send())
    for vehicle in vehicles:
        vehicle.close()


def flood(plan: Plan, ended: threading.Event) -> None:
    """One vehicle that publishes far too much, under its own key."""
    vehicle = _Replayed(plan, plan.vehicles[0], _payloads(plan))
    print("ready", flush=True)

    def send(number: int) -> None:
        for _ in range(_BURST):
            vehicle.send()

    _paced(plan.flood_hz / _BURST, ended, send)
    vehicle.close()


def listener(plan: Plan, ended: threading.Event) -> None:
    """Follows all; prints its ages, its processor time and what was lost, as JSON."""
    arrivals: list[float] = []
    reads: list[float] = []
    not_alive_ns: dict[str, int] = {}

    def take(reading: FleetReading) -> None:
        if reading.estimate is not None and reading.vehicle not in plan.left_out:
            arrivals.append(reading.age_ms - reading.silent_ms)
            reads.append(reading.age_ms)

    with Fleet(msgspec.structs.replace(plan.link("operator"), vehicles=plan.vehicles)) as fleet:
        while not all(r.estimate is not None and r.alive for r in fleet.readings()):
            if ended.wait(0.01):
                return
        print("ready", flush=True)
        while fleet.wait(0.0) is not None:
            continue  # of before
        counted = [name for name in plan.vehicles if name not in plan.left_out]
        before = {name: fleet.received(name) for name in fleet.vehicles}
        begun_s, cpu_s = time.monotonic(), time.process_time()
        while (left_s := begun_s + plan.seconds - time.monotonic()) > 0.0 and not ended.is_set():
            if plan.mode == "each":
                if (reading := fleet.wait(min(left_s, 0.1))) is not None:
                    take(reading)
            else:
                ended.wait(min(left_s, NEWEST_PERIOD_S))
                for reading in fleet.readings():
                    take(reading)
            for name in plan.left_out:
                if name not in not_alive_ns and name in fleet.vehicles and not fleet.alive(name):
                    not_alive_ns[name] = time.monotonic_ns()
        took_s, cpu_s = time.monotonic() - begun_s, time.process_time() - cpu_s
        after = {name: fleet.received(name) for name in fleet.vehicles}
    said: dict[str, Any] = {
        "arrival_ms": arrivals,
        "read_ms": reads,
        "cpu_s": cpu_s,
        "took_s": took_s,
        "received": sum(after[name].estimates - before[name].estimates for name in counted),
        "lost": sum(after[name].lost - before[name].lost for name in counted),
        "bytes": sum(after[name].received_bytes - before[name].received_bytes for name in counted),
        "received_left_out": sum(
            after[name].estimates - (before[name].estimates if name in before else 0)
            for name in plan.left_out
            if name in after
        ),
        "not_alive_ns": not_alive_ns,
    }
    print(json.dumps(said), flush=True)


ROLES = {"whole": whole, "replayed": replayed, "flood": flood, "listener": listener}


def main(arguments: list[str]) -> None:
    role, file = arguments
    plan = msgspec.json.decode(Path(file).read_bytes(), type=Plan)
    ended = threading.Event()

    def wait_for_the_end() -> None:
        sys.stdin.readline()
        ended.set()

    threading.Thread(target=wait_for_the_end, daemon=True).start()
    sys.setswitchinterval(RuntimeConfig().switch_interval_s)  # as in the processes of a run
    ROLES[role](plan, ended)


if __name__ == "__main__":
    main(sys.argv[1:])
