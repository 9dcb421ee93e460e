"""`birdslam replay`: runs the back end on a recording, to compare its estimates or to write new results."""

from __future__ import annotations

import argparse
from pathlib import Path

from birdslam.runtime.cli.arguments import RECORDING, add_final_results, add_settings
from birdslam.runtime.configuration import parse_setting
from birdslam.runtime.progress import file_progress
from birdslam.runtime.recording.recording import Recording
from birdslam.runtime.replay.replay import back_end, compare
from birdslam.runtime.replay.report import report
from birdslam.runtime.replay.results import changed_back_end, write_g2o, write_results


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the recording and the results. Without results, the estimates are compared."""
    parser.add_argument("recording", type=Path, metavar=RECORDING)
    text = "change the back end (method, slam.graph.*, slam.weights.*) and write results instead of comparing"
    add_settings(parser, text)
    parser.add_argument("--output", type=Path, metavar="DIR", help="write results to this directory")
    add_final_results(parser)
    parser.add_argument("--g2o", type=Path, metavar="FILE.g2o", help="only write the edges of the graph, in g2o format")


def run(options: argparse.Namespace) -> int:
    """Returns 0 if the back end reproduces the recorded estimates, 1 if not; or writes new results."""
    with file_progress("replay", options.recording) as progress:
        recording = Recording(options.recording, progress.reach)
        if options.g2o or options.set or options.output or options.smooth or options.video:
            settings = dict(parse_setting(text) for text in options.set)
            config = changed_back_end(back_end(recording), settings)
            if options.g2o:
                write_g2o(recording, config, options.g2o)
                text, status = f"graph in {options.g2o}", 0
            else:
                output = options.output or Path("out") / recording.path.stem
                video = Path(options.video) if options.video else None
                write_results(recording, config, output, bool(options.smooth), video)
                text, status = f"results in {output}{f', video {video}' if video else ''}", 0
        else:
            verdict = compare(recording)
            text, status = report(verdict, recording), int(not verdict.same)
    print(text)
    return status
