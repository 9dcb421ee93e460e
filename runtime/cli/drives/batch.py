"""`birdslam batch`: runs many drives and writes one report. Exit status 1 if a drive failed, 130 after Ctrl-C."""

from __future__ import annotations

import argparse
from pathlib import Path

from birdslam.runtime.batch.batch import run_batch
from birdslam.runtime.batch.drive import done
from birdslam.runtime.batch.drives import find_drives, sweep, tasks
from birdslam.runtime.cli.arguments import add_config, add_pipeline, add_topics
from birdslam.runtime.configuration import ConfigurationError
from birdslam.runtime.environment import INTERRUPTED_STATUS
from birdslam.runtime.options import overrides_of


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the drives, the engine and the pipeline."""
    text = "source, KITTI directory, bag, recording or video; a directory of these; a text file that lists them"
    parser.add_argument("drives", nargs="+", metavar="DRIVE", help=text)
    parser.add_argument("--jobs", type=int, metavar="N", help="parallel drives; default: as many as fit this computer")
    text = "ray: on a cluster (pip install birdslam[ray]), with --output on storage that all nodes share"
    parser.add_argument("--engine", choices=("local", "ray"), default="local", help=text)
    text = "address of the Ray cluster (auto: the cluster of this computer)"
    parser.add_argument("--address", default="auto", metavar="HOST:PORT", help=text)
    text = "run every drive with each of these values; repeatable: every combination"
    parser.add_argument("--sweep", action="append", default=[], metavar="KEY=V1,V2", help=text)
    text = "merge the drives that share streets into one map, after the last drive; extends an existing map"
    parser.add_argument("--map", metavar="FILE", help=text)
    add_config(parser)
    add_topics(parser, "speed", "truth")
    add_pipeline(parser)


def run(options: argparse.Namespace) -> int:
    """Runs the drives that are not done yet and prints the path of the report."""
    output = Path(options.output)
    overrides, models = overrides_of(options)
    overrides.pop("output", None)
    if options.jobs is not None and options.jobs < 1:
        raise ConfigurationError(f"--jobs {options.jobs}: expected 1 or more")
    todo = tasks(find_drives(options.drives), sweep(options.sweep), options.config, overrides, models)
    if before := sum(done(output, task) for task in todo):
        print(f"{before} of {len(todo)} drives are done already")
    address, map_file = options.address if options.engine == "ray" else None, Path(options.map) if options.map else None
    outcome = run_batch(todo, output, options.jobs, address, map_file)
    if outcome.map is not None:
        size = f"{outcome.map.keyframes} keyframes, {outcome.map.size / 1e6:.2f} MB"
        print(f"{map_file}: {size}, {len(outcome.map.inside)} drives")
        if outcome.map.outside:
            print(f"not in the map, because they share no street with it: {', '.join(outcome.map.outside)}")
    ended = outcome.drives - outcome.failed - outcome.interrupted
    print(f"{ended} of {outcome.drives} drives: {output / 'report.html'}")
    return INTERRUPTED_STATUS if outcome.interrupted else int(outcome.failed > 0)
