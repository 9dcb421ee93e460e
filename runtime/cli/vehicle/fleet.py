"""`birdslam uplink` and `birdslam router`: the uplink of a vehicle and the router of a fleet."""

from __future__ import annotations

import argparse
from pathlib import Path

from birdslam.runtime.configuration import load
from birdslam.runtime.fleet import router, uplink
from birdslam.runtime.supervision.run import check_runtime_dir


def add_uplink_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the vehicle."""
    parser.add_argument("config", type=Path, metavar="CONFIG.toml", help="configuration of the vehicle")
    parser.add_argument("--vehicle", metavar="NAME", help="name of the vehicle on the bus")
    parser.add_argument("--runtime-dir", metavar="DIR", help="runtime.runtime_dir of the run")


def run_uplink(options: argparse.Namespace) -> int:
    """Runs the uplink until a signal ends it."""
    given = {"vehicle": options.vehicle, "runtime.runtime_dir": options.runtime_dir}
    configuration = load(options.config, {key: value for key, value in given.items() if value is not None})
    check_runtime_dir(configuration.vehicle, configuration.runtime_dir)
    uplink.run(configuration)
    return 0


def add_router_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the configuration."""
    parser.add_argument("config", type=Path, metavar="CONFIG.toml")


def run_router(options: argparse.Namespace) -> int:
    """Runs the router until a signal ends it."""
    router.run(load(options.config).router)
    return 0
