"""`birdslam listen`: live estimates in a terminal, of one vehicle as its planner gets them, or of a whole fleet."""

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

MAX_AGE_MS = 1000.0  # of a fleet's estimate that counts as on time


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """One vehicle, or all of a fleet, and how long."""
    add_vehicle(parser)
    add_fleet(parser)
    parser.add_argument("--json", action="store_true", help="one JSON object a line")
    parser.add_argument("--count", metavar="N", type=int, help="end after N estimates")
    parser.add_argument("--timeout", metavar="S", type=float, help="end, with status 1, when none comes for so long")


def run(options: argparse.Namespace) -> int:
    """A line for each estimate; 1 where none came within the time-out."""
    if options.all is None:
        whose, lines = f"vehicle {options.vehicle!r}", _of_vehicle(options)
    else:
        whose, lines = "any vehicle", _of_fleet(options)
    with closing(lines):
        for line in islice(lines, options.count):
            if line is None:
                print(f"birdslam: no estimate of {whose} in {options.timeout:g} s", file=sys.stderr)
                return 1
            print(line, flush=True)
    return 0


def _of_vehicle(options: argparse.Namespace) -> Generator[str | None]:
    """Until the source ends; None: the time is out."""
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
            if estimate is None:  # it was malformed: the log has it
                continue
            if options.json:
                yield msgspec.json.encode({"vehicle": reading.vehicle, "estimate": estimate}).decode()
            else:
                ego = _ego(estimate, reading.age_ms, reading.valid)
                yield f"{reading.vehicle}: {ego}  {len(estimate.vehicles)} in sight, {len(estimate.people)} people"
        yield None


def _lane(lanes: Lanes | None) -> str:
    """The ego's lane and who is ahead in it."""
    if lanes is None or lanes.ego is None:
        return ""
    own = lanes.ego
    said = f"lane {lanes.ego_index + 1 if lanes.ego_index is not None else 0} of {len(lanes.lanes)} from the left, "
    said += f"{own.width_m:.1f} m wide, its middle {own.offset_m:+.2f} m"
    if lanes.leader is not None:
        said += f", {lanes.leader.vehicle} ahead at {lanes.leader.gap_m:.0f} m"
    return said + "  "


def _ego(estimate: Estimate, age_ms: float, valid: bool) -> str:
    pose = estimate.T_world_ego
    return (
        f"frame {estimate.frame_id}  epoch {estimate.epoch}  x {pose.x_m:.2f} m  y {pose.y_m:.2f} m  "
        f"yaw {pose.yaw_rad:.3f} rad  age {age_ms:.1f} ms  {'valid' if valid else 'NOT VALID'}  "
        f"{' '.join(estimate.status)}"
    )
