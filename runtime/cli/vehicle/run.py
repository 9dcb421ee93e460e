"""`birdslam run`: the three processes on a source; of a film without a camera file a first pass finds its camera."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import msgspec

from birdslam.outputs.plain_words import LengthsBy
from birdslam.perception import ModelError
from birdslam.runtime.cli.arguments import (
    add_detections,
    add_final_results,
    add_lens,
    add_map,
    add_other_odometry,
    add_pipeline,
    add_topics,
)
from birdslam.runtime.cli.commands import sources_note
from birdslam.runtime.configuration import Configuration, ConfigurationError
from birdslam.runtime.models.download import DownloadError
from birdslam.runtime.models.recommended import fetch, recommended
from birdslam.runtime.models.store import models_directory
from birdslam.runtime.options import configuration_of
from birdslam.runtime.schemes import all_schemes, is_live
from birdslam.runtime.supervision.run import run as run_processes
from birdslam.sources.schemes import VIDEO, scheme_of


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
    text = "the car's own speed over a recording: time in s, speed in m/s, or a GPS table with named columns"
    parser.add_argument("--speed", metavar="FILE", help=text)
    add_other_odometry(parser, "FILE")
    add_detections(parser)
    add_topics(parser, "speed")
    text = "the camera's height over the road, for a film without --camera; left out, cars and lanes seen give it"
    parser.add_argument("--height", type=float, metavar="M", help=text)
    add_lens(parser)
    text = "fetch the networks that real roads want, once, without asking"
    parser.add_argument("--yes", action="store_true", help=text)
    add_pipeline(parser)


def run(options: argparse.Namespace) -> int:
    """Runs until the source ends; gives the exit status."""
    configuration = configuration_of(options)
    scheme = scheme_of(configuration.source.uri, all_schemes())
    if scheme is VIDEO and not options.model and not configuration.models.given() and configuration.models.shipped:
        options.model = list(_networks(configuration, options.yes))
        configuration = configuration_of(options)
    if options.height is None and (scheme is not VIDEO or configuration.camera is not None):
        return run_processes(configuration)
    configuration, lengths_by = _calibrated(configuration, options)
    return run_processes(configuration, lengths_by)


def _networks(configuration: Configuration, fetch_them: bool) -> tuple[str, ...]:
    """Names of the networks for real roads that are installed, once somebody who may have the others was asked."""
    directory = models_directory(configuration.runtime.models_dir)
    found = recommended(directory)
    if not found.missing:
        return found.at_hand
    if not fetch_them and sys.stdin.isatty() and sys.stdout.isatty():
        fetch_them = input(f"{found.question} [Y/n] ").strip().lower() in ("", "y", "yes")
    elif not fetch_them:
        missing = " ".join(found.missing)
        print(
            f"birdslam: networks for real roads are not installed (--yes fetches {missing}): the shipped one looks for "
            "vehicles, and finds fewer",
            file=sys.stderr,
        )
    if fetch_them:
        try:
            fetch(tuple(found.missing), directory)
        except (DownloadError, ModelError) as error:
            print(f"birdslam: {error}; the shipped network looks for vehicles", file=sys.stderr)
    return recommended(directory).at_hand


def _calibrated(configuration: Configuration, options: argparse.Namespace) -> tuple[Configuration, LengthsBy]:
    """With the camera that a first pass over the film finds, whose file lies with the results; and what its lengths
    rest on."""
    # Only where it is asked for: the whole front end comes with it
    from birdslam.runtime.calibration.drive import ROUGH, calibrate_drive
    from birdslam.runtime.calibration.given import Given
    from birdslam.runtime.calibration.report import write_camera_file

    source = configuration.source
    if configuration.camera is not None:
        raise ConfigurationError("--height: a camera is given, which has a height of its own")
    if is_live(source.uri):
        raise ConfigurationError(
            f"--height: {source.uri} can't be seen twice: `birdslam calibrate` a film of this camera"
        )
    speed = Path(source.speed).expanduser() if source.speed else None
    given = Given(height_m=options.height, fov_deg=options.fov, kind=options.kind, speed=speed)
    found = calibrate_drive(configuration, source.uri, given, source.stride, ROUGH, must_show=False)
    path = Path(configuration.output) / "camera.toml"
    write_camera_file(path, found.camera, found.report)
    print("\n".join((*found.report, f"camera file: {path}")), flush=True)
    if source.rate is None:  # nobody drives by a film that was seen before
        source = msgspec.structs.replace(source, rate="max")
    return msgspec.structs.replace(configuration, camera=found.camera, source=source), found.lengths_by
