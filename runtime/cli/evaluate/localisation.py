"""`birdslam evaluate localisation`: position errors of labelled cars or people of KITTI tracking, by range."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from pathlib import Path

from birdslam.bench.tracking.by_class.class_tracks import table_of_tracks
from birdslam.bench.tracking.by_class.people import PEOPLE, PeopleRow
from birdslam.bench.tracking.leave_one_out import LeftOut
from birdslam.bench.tracking.localisation import LocalisationRow, TiltRow
from birdslam.bench.tracking.tables import movers_table
from birdslam.outputs.drive_files import claim_directory, write_json
from birdslam.runtime.cli.arguments import add_config, add_settings, add_tracking_root
from birdslam.runtime.configuration import ConfigurationError
from birdslam.runtime.evaluation.localisation import (
    evaluate_left_out,
    evaluate_localisation,
    evaluate_people,
    read_sweep,
    sequences_of,
)
from birdslam.runtime.options import configuration_of


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds sequences, boxes and settings."""
    add_tracking_root(parser)
    parser.add_argument("--detections", default="rrc", metavar="rrc|DIR", help="boxes; DIR: files as in det_02_rrc")
    parser.add_argument("--mode", choices=("default", "paper"), default="default", help="paper: Eq. 1 on level ground")
    text = "road pitch: with the error of visual odometry, or none"
    parser.add_argument("--tilt", choices=("images", "none"), default="images", help=text)
    text = "number of random draws of the tilt error, evaluated together"
    parser.add_argument("--draws", type=int, default=1, metavar="N", help=text)
    text = "class of road users; boxes of cyclists are projected labels with the noise of detections"
    parser.add_argument("--class", dest="kind", choices=("car", *PEOPLE), default="car", help=text)
    text = "leave-one-out cross-validation of a constant over these values; repeatable"
    parser.add_argument("--leave-one-out", action="append", default=[], metavar="KEY=V1,V2", help=text)
    add_config(parser)
    add_settings(parser)
    parser.add_argument("--output", required=True, metavar="DIR", help="directory of the report")
    parser.set_defaults(model=[])


def run(options: argparse.Namespace) -> int:
    """Writes report.json or leave_one_out.json, and prints it as a table."""
    if options.mode == "paper":
        options.set = ["method=paper", *options.set]
    configuration = configuration_of(options)
    output = Path(options.output)
    sweeps = [read_sweep(text, configuration) for text in options.leave_one_out]
    claim_directory(output)
    names = sequences_of(options.root, options.sequences)
    config, tilt_from_images = configuration.slam.frontend, options.tilt == "images"
    if options.kind != "car" and options.mode == "paper":
        raise ConfigurationError("--class: --mode paper evaluates cars only")
    if options.draws < 1:
        raise ConfigurationError(f"--draws {options.draws}: expected 1 or more")
    if options.draws > 1 and (sweeps or options.kind != "car" or not tilt_from_images):
        raise ConfigurationError("--draws: needs --class car and --tilt images, without --leave-one-out")
    if sweeps:
        left = evaluate_left_out(
            options.root, names, options.detections, config, sweeps, tilt_from_images, options.kind
        )
        write_json(output / "leave_one_out.json", left)
        print(_table_of_left_out(left))
    elif options.kind != "car":
        people, tracks = evaluate_people(
            options.root, names, options.detections, config, options.kind, tilt_from_images
        )
        write_json(output / "report.json", {"places": people, "tracks": tracks})
        print(_table_of_people(people))
        print(table_of_tracks(tracks))
    else:
        slam = configuration.slam
        rows, tilts, movers = evaluate_localisation(
            options.root, names, options.detections, slam, tilt_from_images, options.draws
        )
        write_json(output / "report.json", rows)
        write_json(output / "tilt.json", tilts)
        write_json(output / "movers.json", movers)
        print(_table(rows))
        print()
        print(_table_of_parts(rows))
        print()
        print(_table_of_tilts(tilts))
        print()
        print(movers_table(movers))
    print(f"results in {output}")
    return 0


def _table_of_left_out(rows: Sequence[LeftOut]) -> str:
    titles = f"{'present':>10}{'selected':>10}{'score':>9}{'selected':>9}{'depth':>9}{'selected':>9}"
    lines = (
        f"{row.sequence:10}{row.as_it_is:>10}{row.chosen:>10}{row.score_as_it_is:9.3f}{row.score_chosen:9.3f}"
        f"{row.depth_error_as_it_is_rel:9.1%}{row.depth_error_chosen_rel:9.1%}  {row.key}"
        for row in rows
    )
    return "\n".join([f"{'sequence':10}{titles}  constant", *lines])


def _in_columns(cells: Iterable[tuple[float | None, str]]) -> str:
    """Formats values in columns; a missing value is a dash."""
    return "".join("-".rjust(len(format(0.0, form))) if value is None else format(value, form) for value, form in cells)


_PLACES = f"{'depth':>9}{'bias':>9}{'across m':>10}{'1 sigma':>9}{'2 sigma':>9}"


def _places(row: PeopleRow | LocalisationRow) -> str:
    """Returns the columns of _PLACES."""
    rels = (row.depth_error_median_rel, "9.1%"), (row.depth_bias_median_rel, "+9.1%")
    shares = (row.inside_1_sigma, "9.0%"), (row.inside_2_sigma, "9.0%")
    return _in_columns((*rels, (row.lateral_error_median_m, "10.2f"), *shares))


def _table_of_people(rows: Sequence[PeopleRow]) -> str:
    titles = f"{_PLACES}{'walking':>9}{'away':>7}{'across':>8}{'still':>9}"
    lines = [f"{'sequence':11}{'range m':>9}{'n':>7}{titles}  (m/s: error of walking, speed of stationary people)"]
    for row in rows:
        parts = (row.walking_along_ray_median_mps, "7.2f"), (row.walking_across_ray_median_mps, "8.2f")
        speeds = (row.walking_speed_error_median_mps, "9.2f"), *parts, (row.standing_speed_median_mps, "9.2f")
        lines.append(f"{row.sequence:11}{row.range:>9}{row.n:>7}{_places(row)}{_in_columns(speeds)}")
    return "\n".join(lines)


def _table(rows: Sequence[LocalisationRow]) -> str:
    titles = f"{_PLACES}{'NEES':>7}{'yaw >10':>9}{'1 sigma':>9}{'2 sigma':>9}  (last two: weighted per car)"
    lines = [f"{'':12}{'range m':>9}{'cars':>6}{'n':>7}{titles}"]
    for row in rows:
        shares = row.yaw_off_10_deg, row.inside_1_sigma_by_car, row.inside_2_sigma_by_car
        more = _in_columns(((row.nees, "7.2f"), *((share, "9.0%") for share in shares)))
        lines.append(f"{row.sequence:12}{row.range:>9}{row.cars:>6}{row.n:>7}{_places(row)}{more}")
    return "\n".join(lines)


def _table_of_parts(rows: Sequence[LocalisationRow]) -> str:
    titles = f"{'RMS':>9}{'stated':>9}{'in cars':>9}{'cars':>9}{'drives':>9}"
    lines = [f"{'':12}{'range m':>9}{titles}  depth error: within a car, between cars, between sequences"]
    for row in rows:
        of = row.within_cars_rel, row.between_cars_rel, row.between_sequences_rel
        parts = _in_columns((part, "9.1%") for part in (row.depth_rms_rel, row.depth_stated_rel, *of))
        lines.append(f"{row.sequence:12}{row.range:>9}{parts}")
    return "\n".join(lines)


def _table_of_tilts(rows: Sequence[TiltRow]) -> str:
    lines = [f"{'sequence':12}{'frames':>8}{'pitch mrad':>12}{'roll mrad':>11}  median errors from the labelled road"]
    for row in rows:
        numbers = _in_columns([(row.pitch_error_median_mrad, "12.1f"), (row.roll_error_median_mrad, "11.1f")])
        lines.append(f"{row.sequence:12}{row.n:>8}{numbers}")
    return "\n".join(lines)
