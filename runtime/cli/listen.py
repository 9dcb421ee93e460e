"""`birdslam listen`: live estimates in a terminal, as a planner gets them."""

from __future__ import annotations

import argparse
import sys

import msgspec

from birdslam.runtime.client import Planner
from birdslam.runtime.supervision.run import check_runtime_dir
from birdslam.types import Estimate, Status


def listen(options: argparse.Namespace) -> int:
    """`birdslam listen`: estimates as they come; 1 where none came within the time-out."""
    left, vehicle = options.count, options.vehicle
    check_runtime_dir(vehicle, options.runtime_dir)
    with Planner(vehicle, options.runtime_dir) as planner:
        while left is None or left > 0:
            estimate = planner.wait(options.timeout)
            if estimate is None:
                print(f"birdslam: no estimate of vehicle {vehicle!r} in {options.timeout:g} s", file=sys.stderr)
                return 1
            print(_as_line(estimate, planner.latest().age_ms, options.json), flush=True)
            left = None if left is None else left - 1
            if Status.END_OF_SOURCE in estimate.status:
                return 0
    return 0


def _as_line(estimate: Estimate, age_ms: float, as_json: bool) -> str:
    if as_json:
        return msgspec.json.encode(estimate).decode()
    pose = estimate.T_world_ego
    vehicles = "  ".join(
        f"{v.label} {v.vehicle} at {v.T_world_vehicle.x_m:.1f} {v.T_world_vehicle.y_m:.1f} m" for v in estimate.vehicles
    )
    return (
        f"frame {estimate.frame_id}  epoch {estimate.epoch}  x {pose.x_m:.2f} m  y {pose.y_m:.2f} m  "
        f"yaw {pose.yaw_rad:.3f} rad  age {age_ms:.1f} ms  {'valid' if estimate.valid else 'NOT VALID'}  "
        f"{' '.join(estimate.status)}  {vehicles}"
    ).rstrip()
