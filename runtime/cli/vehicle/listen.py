"""`birdslam listen`: prints live estimates of one vehicle, as its planner receives them, or of a fleet."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Generator
from contextlib import closing
from itertools import islice

import msgspec

from birdslam.runtime.cli.arguments import add_fleet, add_vehicle
from birdslam.runtime.client import Planner
from birdslam.runtime.configuration import load
from birdslam.runtime.fleet.listener import Fleet
from birdslam.runtime.supervision.run import check_runtime_dir
from birdslam.types import Estimate, Lanes, Status

MAX_AGE_MS = 1000.0  # of an estimate of a fleet that is on time


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the vehicle or the fleet, and limits."""
    add_vehicle(parser)
    add_fleet(parser)
    parser.add_argument("--json", action="store_true", help="one JSON object per line")
    parser.add_argument("--count", metavar="N", type=int, help="end after N estimates")
    parser.add_argument("--timeout", metavar="S", type=float, help="end with status 1 after S seconds without estimate")


def run(options: argparse.Namespace) -> int:
    """Prints a line per estimate; returns 1 after a timeout."""
    if options.all is None:
        subject, lines = f"vehicle {options.vehicle!r}", _of_vehicle(options)
    else:
        subject, lines = "any vehicle", _of_fleet(options)
    with closing(lines):
        for line in islice(lines, options.count):
            if line is None:
                print(f"birdslam: no estimate of {subject} in {options.timeout:g} s", file=sys.stderr)
                return 1
            print(line, flush=True)
    return 0


def _of_vehicle(options: argparse.Namespace) -> Generator[str | None]:
    """Yields lines until the source ends; None after a timeout."""
    check_runtime_dir(options.vehicle, options.runtime_dir)
    with Planner(options.vehicle, options.runtime_dir) as planner:
        while (estimate := planner.wait(options.timeout)) is not None:
            if options.json:
                yield msgspec.json.encode(estimate).decode()
            else:
                vehicles = "  ".join(
                    f"{v.label} {v.vehicle} at {v.T_world_vehicle.x_m:.1f} {v.T_world_vehicle.y_m:.1f} m"
                    for v in estimate.road_users
                )
                ego = _ego(estimate, planner.latest().age_ms, estimate.valid)
                yield f"{ego}  {_lane(estimate.lanes)}{vehicles}".rstrip()
            if Status.END_OF_SOURCE in estimate.status:
                return
        yield None


def _of_fleet(options: argparse.Namespace) -> Generator[str | None]:
    with Fleet(load(options.all).fleet) as fleet:
        while (reading := fleet.wait(options.timeout, MAX_AGE_MS)) is not None:
            estimate = reading.estimate
            if estimate is None:  # malformed; it is in the log
                continue
            if options.json:
                yield msgspec.json.encode({"vehicle": reading.vehicle, "estimate": estimate}).decode()
            else:
                ego = _ego(estimate, reading.age_ms, reading.valid)
                yield f"{reading.vehicle}: {ego}  {len(estimate.vehicles)} in sight, {len(estimate.people)} people"
        yield None


def _lane(lanes: Lanes | None) -> str:
    """Returns the ego lane and its leader."""
    if lanes is None or lanes.ego is None:
        return ""
    own = lanes.ego
    text = f"lane {lanes.ego_index + 1 if lanes.ego_index is not None else 0} of {len(lanes.lanes)} from the left, "
    text += f"{own.width_m:.1f} m wide, centre at {own.offset_m:+.2f} m"
    if lanes.leader is not None:
        text += f", {lanes.leader.vehicle} ahead at {lanes.leader.gap_m:.0f} m"
    return text + "  "


def _ego(estimate: Estimate, age_ms: float, valid: bool) -> str:
    pose = estimate.T_world_ego
    return (
        f"frame {estimate.frame_id}  epoch {estimate.epoch}  x {pose.x_m:.2f} m  y {pose.y_m:.2f} m  "
        f"yaw {pose.yaw_rad:.3f} rad  age {age_ms:.1f} ms  {'valid' if valid else 'NOT VALID'}  "
        f"{' '.join(estimate.status)}"
    )
