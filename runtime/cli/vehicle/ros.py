"""`birdslam ros`: publishes the estimates of a running vehicle in ROS 2."""

from __future__ import annotations

import argparse
from pathlib import Path

from birdslam.runtime.cli.arguments import add_settings
from birdslam.runtime.configuration import ConfigurationError
from birdslam.runtime.options import configuration_of
from birdslam.runtime.ros import publisher
from birdslam.runtime.supervision.run import check_runtime_dir


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the vehicle and the ROS connection."""
    parser.add_argument("config", nargs="?", type=Path, metavar="CONFIG.toml", help="configuration of the vehicle")
    parser.add_argument("--vehicle", metavar="NAME", help="name of the vehicle on the bus")
    parser.add_argument("--runtime-dir", metavar="DIR", help="runtime.runtime_dir of the run")
    add_ros(parser)
    parser.add_argument("--rate", dest="rate_hz", type=float, metavar="HZ", help="maximum rate of estimates")
    add_settings(parser)
    parser.set_defaults(model=[])


def add_ros(parser: argparse.ArgumentParser) -> None:
    """Adds router, domain and namespace of ROS."""
    parser.add_argument("--router", metavar="tcp/HOST:PORT", help="router of rmw_zenoh; default: tcp/localhost:7447")
    parser.add_argument("--domain", type=int, metavar="N", help="ROS domain; default: ROS_DOMAIN_ID, else 0")
    parser.add_argument("--namespace", metavar="/NAME", help="namespace of topics and frames")


def run(options: argparse.Namespace) -> int:
    """Publishes until a signal ends it."""
    if options.rate_hz is not None and not options.rate_hz > 0.0:
        raise ConfigurationError(f"--rate {options.rate_hz:g}: needs a positive number")
    configuration = configuration_of(options)
    check_runtime_dir(configuration.vehicle, configuration.runtime_dir)
    publisher.run(configuration, options.rate_hz)
    return 0
