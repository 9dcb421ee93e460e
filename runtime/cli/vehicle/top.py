"""`birdslam top`: prints a table of the nodes of a running vehicle, or of the vehicles of a fleet, once a second.

A terminal is refreshed in place; a pipe or a dumb terminal receives one table after the other.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TextIO

import msgspec

from birdslam.runtime.cli.arguments import add_fleet, add_vehicle
from birdslam.runtime.configuration import BudgetsConfig, load
from birdslam.runtime.fleet.listener import Fleet, FleetReading, Received
from birdslam.runtime.topology import NODES, PROCESSES
from birdslam.runtime.transport.bus import Bus, BusError, Message, Subscriber
from birdslam.runtime.wire import Health
from birdslam.types import Estimate

PERIOD_S = 1.0
MAX_HEALTH_PERIODS = 3.0  # an older health record is stale
FLEET_MAX_AGE_MS = 1000.0  # of an estimate that is on time
CLEAR = "\x1b[H\x1b[2J"
COLUMNS = (
    *(("node", 10), ("state", 9), ("mode", 9), ("Hz", 6)),
    *(("wait p50/p99", 14), ("step p50/p99", 14), ("budget", 7), ("age p50/p99/max ms", 20)),
    *(("over", 6), ("late", 6), ("drop", 6), ("torn", 5), ("again", 6), ("cpu %", 6), ("MB", 6)),
)
FLEET_COLUMNS = (
    *(("vehicle", 17), ("state", 8), ("valid", 7), ("Hz", 6), ("age ms", 8), ("heard s ago", 12)),
    *(("lost", 7), ("kB/s", 7), ("frame", 9), ("epoch", 6), ("tracks", 7), ("status", 8)),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the vehicle or the fleet."""
    add_vehicle(parser)
    add_fleet(parser)
    parser.add_argument("--once", action="store_true", help="print one table and end; status 1 if no node is alive")


def run(options: argparse.Namespace) -> int:
    """Prints the nodes of a vehicle or the vehicles of a fleet."""
    if options.all is None:
        return top(options.vehicle, options.runtime_dir, options.once)
    return top_all(options.all, options.once)


class VehicleTable:
    """The health of the nodes of a vehicle and its newest estimate."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._healths = {name: bus.subscriber(f"health/{name}") for name in PROCESSES}
        self._estimates: Subscriber = bus.subscriber("estimate")
        self._budgets: BudgetsConfig | None = None

    def wait(self, timeout_s: float) -> None:
        """Waits for the last health record of each node, up to the timeout."""
        until_s = time.monotonic() + timeout_s
        self._bus.wait_alive(NODES, timeout_s)
        self._bus.catch_up("estimate", self._estimates)
        for name, subscriber in self._healths.items():
            self._bus.catch_up(f"health/{name}", subscriber)
        for name in self._bus.alive & set(PROCESSES):
            if self._healths[name].newest is None:
                self._healths[name].recv(max(0.0, until_s - time.monotonic()))

    def pause(self, timeout_s: float) -> None:
        """Waits for the next health record of the optimizer, the last node, up to the timeout."""
        self._healths["optimize"].recv(timeout_s)

    @property
    def has_nodes(self) -> bool:
        """Whether a node of this vehicle is alive."""
        return bool(self._bus.alive & set(PROCESSES))

    def table(self, now_ns: int) -> str:
        """Returns the table as text."""
        if self._budgets is None:
            self._budgets = _budgets(self._bus)
        head = _line_of([title for title, _ in COLUMNS], COLUMNS)
        rows = [self._row(name, now_ns) for name in PROCESSES if name in NODES or self._healths[name].newest]
        causes = [
            f"{name} was restarted {health.restarts} times, the last time because it {health.cause}"
            for name in PROCESSES
            if (health := self._health(name)) is not None and health.restarts
        ]
        return "\n".join([self._line(now_ns), *self._car(), head, *rows, *causes])

    def _health(self, name: str) -> Health | None:
        message = self._healths[name].newest
        return message.record if message else None

    def _row(self, name: str, now_ns: int) -> str:
        alive, health = name in self._bus.alive, self._health(name)
        if health is None:
            return _line_of((name, _state(alive, stale=True)), COLUMNS)
        stale = now_ns - health.t_ns > MAX_HEALTH_PERIODS * PERIOD_S * 1e9
        budget = "" if self._budgets is None or name not in NODES else f"{self._budgets.step_ms(name):g}"
        cells = (
            *(name, _state(alive, stale, health), health.mode, f"{health.rate_hz:.1f}"),
            *(_pair(health.wait.p50_ms, health.wait.p99_ms), _pair(health.step.p50_ms, health.step.p99_ms), budget),
            f"{health.age.p50_ms:.0f} / {health.age.p99_ms:.0f} / {health.age.max_ms:.0f}",
            *(str(n) for n in (health.overruns, health.late, health.dropped, health.torn, health.restarts)),
            *(f"{health.cpu_percent:.0f}", f"{health.rss_bytes / 2**20:.0f}"),
        )
        return _line_of(cells, COLUMNS)

    def _car(self) -> list[str]:
        """Returns the counters of the vehicle speed, if there are readings."""
        capture = self._health("capture")
        if capture is None or not (capture.speeds or capture.malformed):
            return []
        lost = f"{capture.speeds_dropped} lost, {capture.malformed} malformed"
        return [f"vehicle speed: {capture.speeds} readings, {lost}"]

    def _line(self, now_ns: int) -> str:
        """Returns the summary of the newest estimate."""
        message: Message | None = self._estimates.newest
        if message is None:
            return f"{self._bus.vehicle}: no estimate"
        estimate: Estimate = message.record
        age_ms = (now_ns - estimate.t_capture_ns) / 1e6
        left_ns = message.trace.left_ns
        left = "" if left_ns is None else f"  {left_ns / 1e6:.0f} ms of its budget left"
        return (
            f"{self._bus.vehicle}: frame {estimate.frame_id}  epoch {estimate.epoch}  "
            f"{'valid' if estimate.valid else 'NOT VALID'}  {age_ms:.0f} ms old{left}  "
            f"tracks {len(estimate.vehicles)}  people {len(estimate.people)}  "
            f"scale from {' and '.join(estimate.speed_sources) or 'nothing yet'}  "
            f"{' '.join(estimate.status)}"
        ).rstrip()


def _state(alive: bool, stale: bool, health: Health | None = None) -> str:
    if not alive:
        return "GONE"
    if stale:
        return "SILENT"
    return "stale" if health is not None and health.status else "alive"


def _pair(p50_ms: float, p99_ms: float) -> str:
    return f"{p50_ms:.1f} / {p99_ms:.1f}"


def _line_of(cells: Sequence[str], columns: Sequence[tuple[str, int]]) -> str:
    return "".join(f"{text:<{width - 1}} " for text, (_, width) in zip(cells, columns, strict=False)).rstrip()


def _budgets(bus: Bus) -> BudgetsConfig | None:
    """Returns the budgets of the run, or None without a reply of the supervisor."""
    try:
        for configuration in bus.query("configuration", PERIOD_S):
            budgets: Any = configuration["budgets"] if isinstance(configuration, dict) else configuration.budgets
            return msgspec.convert(budgets, BudgetsConfig)
    except (BusError, KeyError, msgspec.ValidationError):
        return None
    return None


class FleetTable:
    """The table of all vehicles, with rates since the previous table."""

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        self._before: dict[str, Received] = {}
        self._before_s = time.monotonic()

    def table(self) -> str:
        """Returns the table as text."""
        now_s = time.monotonic()
        interval_s, self._before_s = max(now_s - self._before_s, 1e-3), now_s
        readings = self._fleet.readings(FLEET_MAX_AGE_MS)
        rows = [self._row(reading, interval_s) for reading in readings]
        alive, usable = sum(r.alive for r in readings), sum(r.usable for r in readings)
        router = "" if self._fleet.connected else "  THE ROUTER IS GONE"
        head = f"{len(readings)} vehicles: {alive} alive, {usable} alive, on time and valid{router}"
        return "\n".join([head, _line_of([title for title, _ in FLEET_COLUMNS], FLEET_COLUMNS), *rows])

    def _row(self, reading: FleetReading, interval_s: float) -> str:
        received, estimate = self._fleet.received(reading.vehicle), reading.estimate
        before = self._before.get(reading.vehicle, Received(0, 0, 0, 0))
        self._before[reading.vehicle] = received
        ago = f"{reading.silent_ms / 1e3:.1f}" if estimate else ""
        cells: tuple[str, ...] = (
            *(reading.vehicle, _fleet_state(reading), "" if estimate is None else "yes" if reading.valid else "NO"),
            f"{(received.estimates - before.estimates) / interval_s:.1f}",
            *(f"{reading.age_ms:.0f}" if estimate else "", ago),
            *(str(reading.lost), f"{(received.received_bytes - before.received_bytes) / interval_s / 1e3:.1f}"),
        )
        if estimate is not None:
            cells += (str(estimate.frame_id), str(estimate.epoch), str(len(estimate.vehicles)))
            cells += (" ".join(estimate.status),)
        return _line_of(cells, FLEET_COLUMNS)


def _fleet_state(reading: FleetReading) -> str:
    if not reading.alive:
        return "GONE" if reading.estimate else "UNHEARD"
    return "alive" if reading.on_time else "LATE" if reading.estimate else "SILENT"


def refresh(table: Callable[[], str], pause: Callable[[], object], once: bool, out: TextIO) -> None:
    """Writes the table repeatedly until Ctrl-C, or once."""
    in_place = out.isatty() and os.environ.get("TERM", "dumb") != "dumb" and not once
    while True:
        text = table()
        out.write(f"{CLEAR}{text}\n" if in_place else f"{text}\n")
        out.flush()
        if once:
            return
        pause()


def top(vehicle: str, runtime_dir: Path | None, once: bool, out: TextIO = sys.stdout) -> int:
    """Prints the nodes of a vehicle every second, or once; returns 1 if no node is alive."""
    with Bus(vehicle, f"top-{os.getpid()}", runtime_dir=runtime_dir) as bus:
        nodes = VehicleTable(bus)
        nodes.wait(PERIOD_S)
        refresh(lambda: nodes.table(time.monotonic_ns()), lambda: nodes.pause(PERIOD_S), once, out)
        return int(not nodes.has_nodes)


def top_all(config: Path, once: bool, out: TextIO = sys.stdout) -> int:
    """Prints all vehicles every second, or once; returns 1 if no vehicle is alive."""
    with Fleet(load(config).fleet) as fleet:
        vehicles = FleetTable(fleet)
        time.sleep(PERIOD_S)  # the interval of the first rates
        refresh(vehicles.table, lambda: time.sleep(PERIOD_S), once, out)
        return int(not any(reading.alive for reading in fleet.readings()))
