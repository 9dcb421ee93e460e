"""`birdslam doctor`: prints a row per check of this machine; exit status 1 if a check is an error."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from birdslam.runtime.cli.arguments import add_pipeline
from birdslam.runtime.doctor.checks import examine, table
from birdslam.runtime.doctor.costs import costs
from birdslam.runtime.options import configuration_of


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the configuration and the source of the planned run."""
    parser.add_argument("config", nargs="?", type=Path, metavar="CONFIG.toml", help="configuration of the planned run")
    parser.add_argument("--source", metavar="URI", help="source of the frames")
    parser.add_argument("--vehicle", metavar="NAME", help="name of the vehicle on the bus")
    parser.add_argument("--measure", action="store_true", help="also measure the cost of settings (about 6 s)")
    add_pipeline(parser)


def run(options: argparse.Namespace) -> int:
    """Prints the table of findings, and with `--measure` the table of costs."""
    findings = list(examine(configuration_of(options)))
    print(table(findings))
    if options.measure:
        print("\nmeasured cost of the settings:")
        for setting, cost in costs(len(os.sched_getaffinity(0))):
            print(f"{setting:26}{cost}", flush=True)
    return int(any(finding.verdict == "error" for finding in findings))
