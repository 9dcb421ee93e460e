"""`birdslam run`: runs the three processes on a source. A first pass calibrates a film without a camera file."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from birdslam.calibration.camera_files import format_of
from birdslam.loops.gnss.files import GnssError
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
from birdslam.runtime.configuration import FILM, Configuration, ConfigurationError
from birdslam.runtime.maps import film_gnss
from birdslam.runtime.models.download import DownloadError
from birdslam.runtime.models.recommended import fetch, recommended
from birdslam.runtime.models.store import models_directory
from birdslam.runtime.options import configuration_of, take_inputs
from birdslam.runtime.schemes import all_schemes, is_live
from birdslam.runtime.supervision.run import run as run_processes
from birdslam.sources.films.container import films_in
from birdslam.sources.schemes import VIDEO, scheme_of

if TYPE_CHECKING:
    from birdslam.runtime.calibration.drive import Calibrated


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds source, rate, recording, results and pipeline."""
    parser.epilog = sources_note()
    text = "a film, a recording or another source; or a configuration file: differences from the defaults"
    parser.set_defaults(config=None)
    parser.add_argument("inputs", nargs="*", metavar="SOURCE|CONFIG.toml", help=text)
    parser.add_argument("--source", metavar="URI", help="source of the frames, in place of SOURCE")
    parser.add_argument("--rate", metavar="HZ|max", help='frames per second; "max": every frame, as fast as possible')
    parser.add_argument("--vehicle", metavar="NAME", help="name of the vehicle on the bus")
    parser.add_argument("--record", metavar="FILE.mcap", help="record the drive to a file; DIR: to a new file in it")
    parser.add_argument("--record-images", action="store_true", default=None, help="also record the frames, as JPEG")
    add_final_results(parser)
    add_map(parser)
    text = "speed of the vehicle during a recording: time in s, speed in m/s, or a GPS table with named columns; "
    text += "film: the GNSS track inside the film"
    parser.add_argument("--speed", metavar="FILE", help=text)
    add_other_odometry(parser, "FILE")
    add_detections(parser)
    add_topics(parser, "speed")
    text = "height of the camera above the road; without it car sizes and lane widths give the scale"
    parser.add_argument("--height", type=float, metavar="M", help=text)
    add_lens(parser)
    text = "download the networks for real roads without asking"
    parser.add_argument("--yes", action="store_true", help=text)
    add_pipeline(parser)


def run(options: argparse.Namespace) -> int:
    """Runs until the source ends and returns the exit status."""
    take_inputs(options)
    lens = _lens_of_another_project(options)
    configuration = configuration_of(options)
    scheme = scheme_of(configuration.source.uri, all_schemes())
    if scheme is VIDEO and not options.model and not configuration.models.given() and configuration.models.shipped:
        options.model = list(_networks(configuration, options.yes))
        configuration = configuration_of(options)
    configuration, film_track = _with_film_gnss(configuration)
    stated = (options.height, lens, options.known_length)
    if all(each is None for each in stated) and (scheme is not VIDEO or configuration.camera is not None):
        return run_processes(configuration, None, film_track)
    configuration, found = _calibrated(configuration, options, lens)
    return run_processes(configuration, found.lengths_by, film_track, found.kept)


def _lens_of_another_project(options: argparse.Namespace) -> Path | None:
    """Takes `--camera` out of the options where it names a calibration of another project, for the first pass.

    A live camera has no first pass, and the file lacks the height over the road.
    """
    if not options.camera or is_live(options.source or "") or format_of(Path(options.camera)) is None:
        return None
    path, options.camera = Path(options.camera), None
    return path


def _with_film_gnss(configuration: Configuration) -> tuple[Configuration, Path | None]:
    """Returns the configuration with the GNSS track inside a film where `film` is named; else that track, if any.

    Raises ConfigurationError, DatasetError, GnssError.
    """
    source, results = configuration.source, configuration.results
    is_named = FILM in (source.speed, results.gnss)
    scheme, _, address = source.uri.partition(":")
    if scheme != VIDEO.name and is_named:
        raise ConfigurationError(f"--gnss film, --speed film: the source is no film: {source.uri}")
    if scheme != VIDEO.name or (results.gnss and not is_named):
        return configuration, None
    track = Path(configuration.output) / film_gnss.TRACK_FILE
    try:
        films = films_in(Path(address).expanduser(), VIDEO.suffixes)
        if not (is_named or film_gnss.is_readable() or any(map(film_gnss.fixes_beside, films))):
            return configuration, None
        count = film_gnss.track_of_films(films, track)
    except GnssError as error:
        if is_named:
            raise
        print(f"birdslam: {error}", file=sys.stderr)
        return configuration, None
    if not count and is_named:
        raise ConfigurationError(f"--gnss film, --speed film: {address}: has no GNSS track")
    if not count:
        return configuration, None
    print(f"{count} GNSS fixes of the film: {track}", flush=True)
    if source.speed == FILM:
        source = msgspec.structs.replace(source, speed=str(track))
    if results.gnss == FILM:
        results = msgspec.structs.replace(results, gnss=str(track))
    configuration = msgspec.structs.replace(configuration, source=source, results=results)
    return configuration, None if results.gnss else track


def _networks(configuration: Configuration, fetch_them: bool) -> tuple[str, ...]:
    """Returns the names of the installed networks for real roads, after offering to download the others."""
    directory = models_directory(configuration.runtime.models_dir)
    found = recommended(directory)
    if not found.missing:
        return found.at_hand
    if not fetch_them and sys.stdin.isatty() and sys.stdout.isatty():
        fetch_them = input(f"{found.question} [Y/n] ").strip().lower() in ("", "y", "yes")
    elif not fetch_them:
        missing = " ".join(found.missing)
        print(
            f"birdslam: the networks for real roads are not installed ({missing}); the shipped network finds fewer "
            "vehicles. --yes downloads them",
            file=sys.stderr,
        )
    if fetch_them:
        try:
            fetch(tuple(found.missing), directory)
        except (DownloadError, ModelError) as error:
            print(f"birdslam: {error}; the shipped network detects vehicles", file=sys.stderr)
    return recommended(directory).at_hand


def _calibrated(
    configuration: Configuration, options: argparse.Namespace, lens: Path | None
) -> tuple[Configuration, Calibrated]:
    """Returns the configuration with the camera estimated by a first pass, and the results of that pass.

    `lens` is a calibration of another project. Writes the camera file beside the results.
    """
    # A late import: it loads the whole front end
    from birdslam.runtime.calibration.drive import ROUGH, calibrate_drive
    from birdslam.runtime.calibration.given import Given, known_length_of
    from birdslam.runtime.calibration.report import write_camera_file

    source = configuration.source
    if configuration.camera is not None:
        raise ConfigurationError(
            "--height, --known-length: the camera file has a height already; leave them out or edit the file"
        )
    if is_live(source.uri):
        raise ConfigurationError(
            f"--height, --known-length: {source.uri} is live and has no first pass; "
            "run `birdslam calibrate` on a film of this camera"
        )
    speed = Path(source.speed).expanduser() if source.speed else None
    given = Given(
        intrinsics=lens,
        height_m=options.height,
        fov_deg=options.fov,
        fov_sigma_percent=options.fov_sigma,
        kind=options.kind,
        speed=speed,
        size=known_length_of(options.known_length),
    )
    found = calibrate_drive(configuration, source.uri, given, source.stride, ROUGH, must_show=False)
    path = Path(configuration.output) / "camera.toml"
    write_camera_file(path, found.camera, found.report)
    print("\n".join((*found.report, f"camera file: {path}")), flush=True)
    if source.rate is None:  # a film has no real time
        source = msgspec.structs.replace(source, rate="max")
    return msgspec.structs.replace(configuration, camera=found.camera, source=source), found
