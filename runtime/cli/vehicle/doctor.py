"""`birdslam doctor`: a row for each check of this machine; exit status 1 where one is an error."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from birdslam.runtime.cli.arguments import add_pipeline
from birdslam.runtime.doctor.checks import examine, table
from birdslam.runtime.doctor.costs import costs
from birdslam.runtime.options import configuration_of


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Of the run to come."""
    parser.add_argument("config", nargs="?", type=Path, metavar="CONFIG.toml", help="of the run to come")
    parser.add_argument("--source", metavar="URI", help="where frames will come from")
    parser.add_argument("--vehicle", metavar="NAME", help="its name on the bus")
    parser.add_argument("--measure", action="store_true", help="and what its settings cost, in some six seconds")
    add_pipeline(parser)


def run(options: argparse.Namespace) -> int:
    """Prints the table of findings, with `--measure` that of costs too."""
    findings = list(examine(configuration_of(options)))
    print(table(findings))
    if options.measure:
        print("\nwhat the settings cost, measured now:")
        for what, cost in costs(len(os.sched_getaffinity(0))):
            print(f"{what:26}{cost}", flush=True)
    return int(any(finding.verdict == "error" for finding in findings))
