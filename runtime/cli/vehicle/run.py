"""`birdslam run`: the three processes on a source."""

from __future__ import annotations

import argparse
from pathlib import Path

import msgspec

from birdslam.runtime.cli.arguments import (
    add_final_results,
    add_lens,
    add_map,
    add_other_odometry,
    add_pipeline,
    add_topics,
)
from birdslam.runtime.cli.commands import sources_note
from birdslam.runtime.configuration import Configuration, ConfigurationError
from birdslam.runtime.options import configuration_of
from birdslam.runtime.schemes import is_live
from birdslam.runtime.supervision.run import run as run_processes


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Source, rate, recording and results, and the pipeline."""
    parser.epilog = sources_note()
    parser.add_argument("config", nargs="?", type=Path, metavar="CONFIG.toml", help="differences from the defaults")
    parser.add_argument("--source", metavar="URI", help="where frames come from")
    parser.add_argument("--rate", metavar="HZ|max", help='frames a second, or "max": every frame, as fast as can be')
    parser.add_argument("--vehicle", metavar="NAME", help="its name on the bus")
    parser.add_argument("--record", metavar="FILE.mcap", help="record the drive; a directory: a new file in it")
    parser.add_argument("--record-images", action="store_true", default=None, help="with its frames, as JPEG")
    add_final_results(parser)
    add_map(parser)
    parser.add_argument("--speed", metavar="FILE", help="the car's own speed over a recording: time in s, speed in m/s")
    add_other_odometry(parser, "FILE")
    add_topics(parser, "speed")
    text = "the camera's height over the road: without --camera a first pass over a film finds the rest"
    parser.add_argument("--height", type=float, metavar="M", help=text)
    add_lens(parser)
    add_pipeline(parser)


def run(options: argparse.Namespace) -> int:
    """Runs until the source ends; gives the exit status."""
    configuration = configuration_of(options)
    if options.height is not None:
        configuration = _calibrated(configuration, options)
    return run_processes(configuration)


def _calibrated(configuration: Configuration, options: argparse.Namespace) -> Configuration:
    """With the camera that a first pass over the film finds; its file lies with the results."""
    # Only where it is asked for: the whole front end comes with it
    from birdslam.runtime.calibration import Given, calibrate_drive, write_camera_file

    uri = configuration.source.uri
    if configuration.camera is not None:
        raise ConfigurationError("--height: a camera is given, which has a height of its own")
    if is_live(uri):
        raise ConfigurationError(f"--height: {uri} can't be seen twice: `birdslam calibrate` a film of this camera")
    given = Given(height_m=options.height, fov_deg=options.fov, kind=options.kind)
    camera, report = calibrate_drive(configuration, uri, given)
    path = Path(configuration.output) / "camera.toml"
    write_camera_file(path, camera, report)
    print("\n".join((*report, f"camera file: {path}")), flush=True)
    return msgspec.structs.replace(configuration, camera=camera)
