"""Commands over many vehicles: `birdslam router`, `birdslam uplink`, and `top` and `listen` with `--all`."""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path
from typing import TextIO

import msgspec

from birdslam.runtime.cli.top import CLEAR, PERIOD_S
from birdslam.runtime.configuration import load
from birdslam.runtime.fleet import router as routing
from birdslam.runtime.fleet import uplink as speaking
from birdslam.runtime.fleet.listener import Fleet, FleetReading, Heard
from birdslam.runtime.supervision.run import check_runtime_dir

MAX_AGE_MS = 1000.0  # of an estimate that is told as on time: what a watching person needs
_COLUMNS = (
    *(("vehicle", 17), ("state", 8), ("valid", 7), ("Hz", 6), ("age ms", 8), ("heard s ago", 12)),
    *(("lost", 7), ("kB/s", 7), ("frame", 9), ("epoch", 6), ("tracks", 7), ("status", 8)),
)


def route(options: argparse.Namespace) -> int:
    """`birdslam router`."""
    routing.run(load(options.config).router)
    return 0


def uplink(options: argparse.Namespace) -> int:
    """`birdslam uplink`."""
    given = {"vehicle": options.vehicle, "runtime.runtime_dir": options.runtime_dir}
    configuration = load(options.config, {key: value for key, value in given.items() if value is not None})
    check_runtime_dir(configuration.vehicle, configuration.runtime_dir)
    speaking.run(configuration)
    return 0


class FleetWatch:
    """The table of all vehicles, with rates since the table before."""

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        self._before: dict[str, Heard] = {}
        self._before_s = time.monotonic()

    def table(self) -> str:
        """Everything, as lines."""
        now_s = time.monotonic()
        took_s, self._before_s = max(now_s - self._before_s, 1e-3), now_s
        readings = self._fleet.readings(MAX_AGE_MS)
        rows = [self._row(reading, took_s) for reading in readings]
        alive, usable = sum(r.alive for r in readings), sum(r.usable for r in readings)
        router = "" if self._fleet.connected else "  THE ROUTER IS GONE"
        head = f"{len(readings)} vehicles: {alive} alive, {usable} alive, on time and valid{router}"
        return "\n".join([head, _line_of(tuple(title for title, _ in _COLUMNS)), *rows])

    def _row(self, reading: FleetReading, took_s: float) -> str:
        heard, estimate = self._fleet.heard(reading.vehicle), reading.estimate
        before = self._before.get(reading.vehicle, Heard(0, 0, 0, 0))
        self._before[reading.vehicle] = heard
        ago = f"{reading.silent_ms / 1e3:.1f}" if estimate else ""
        cells: tuple[str, ...] = (
            *(reading.vehicle, _state(reading), "" if estimate is None else "yes" if reading.valid else "NO"),
            f"{(heard.estimates - before.estimates) / took_s:.1f}",
            *(f"{reading.age_ms:.0f}" if estimate else "", ago),
            *(str(reading.lost), f"{(heard.received_bytes - before.received_bytes) / took_s / 1e3:.1f}"),
        )
        if estimate is not None:
            cells += (str(estimate.frame_id), str(estimate.epoch), str(len(estimate.vehicles)))
            cells += (" ".join(estimate.status),)
        return _line_of(cells)


def _state(reading: FleetReading) -> str:
    if not reading.alive:
        return "GONE" if reading.estimate else "UNHEARD"
    return "alive" if reading.on_time else "LATE" if reading.estimate else "SILENT"


def _line_of(cells: tuple[str, ...]) -> str:
    return "".join(f"{text:<{width - 1}} " for text, (_, width) in zip(cells, _COLUMNS, strict=False)).rstrip()


def top_all(config: Path, once: bool, out: TextIO = sys.stdout) -> int:
    """`birdslam top --all`: a table of all vehicles once a second; with `once` a single one, 1 where none is alive."""
    in_place = out.isatty() and os.environ.get("TERM", "dumb") != "dumb" and not once
    with Fleet(load(config).fleet) as fleet:
        watch = FleetWatch(fleet)
        while True:
            time.sleep(PERIOD_S)  # rates are of this second
            text = watch.table()
            out.write(f"{CLEAR}{text}\n" if in_place else f"{text}\n")
            out.flush()
            if once:
                return int(not any(reading.alive for reading in fleet.readings()))


def listen_all(options: argparse.Namespace) -> int:
    """`birdslam listen --all`: every vehicle's estimates as they come; 1 where none came within the time-out."""
    left = options.count
    with Fleet(load(options.all).fleet) as fleet:
        while left is None or left > 0:
            reading = fleet.wait(options.timeout, MAX_AGE_MS)
            if reading is None:
                print(f"birdslam: no estimate of any vehicle in {options.timeout:g} s", file=sys.stderr)
                return 1
            if reading.estimate is None:  # it was malformed, which the log tells
                continue
            print(_as_line(reading, options.json), flush=True)
            left = None if left is None else left - 1
    return 0


def _as_line(reading: FleetReading, as_json: bool) -> str:
    estimate = reading.estimate
    assert estimate is not None
    if as_json:
        return msgspec.json.encode({"vehicle": reading.vehicle, "estimate": estimate}).decode()
    pose, valid = estimate.T_world_ego, "valid" if reading.valid else "NOT VALID"
    return (
        f"{reading.vehicle}: frame {estimate.frame_id}  epoch {estimate.epoch}  x {pose.x_m:.2f} m  "
        f"y {pose.y_m:.2f} m  yaw {pose.yaw_rad:.3f} rad  age {reading.age_ms:.1f} ms  {valid}  "
        f"{' '.join(estimate.status)}  {len(estimate.vehicles)} in sight"
    )
