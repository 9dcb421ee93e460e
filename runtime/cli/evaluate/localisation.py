"""`birdslam evaluate localisation`: where the front end puts the labelled cars, or people, of KITTI tracking."""

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
    """Sequences, boxes, and how they are placed."""
    add_tracking_root(parser)
    parser.add_argument("--detections", default="rrc", metavar="rrc|DIR", help="DIR: as det_02_rrc")
    parser.add_argument("--mode", choices=("default", "paper"), default="default", help="paper: Eq. 1 on level ground")
    text = "the road's pitch: with the images' error of it, as odometry on images reports it, or none"
    parser.add_argument("--tilt", choices=("images", "none"), default="images", help=text)
    text = "how often the tilt's error is drawn again; all draws count together"
    parser.add_argument("--draws", type=int, default=1, metavar="N", help=text)
    text = "of whom; cyclists by boxes of the labels' hulls, with the noise of real ones"
    parser.add_argument("--class", dest="kind", choices=("car", *PEOPLE), default="car", help=text)
    text = "how each sequence fares by a constant that the others chose of these values; may be repeated"
    parser.add_argument("--leave-one-out", action="append", default=[], metavar="KEY=V1,V2", help=text)
    add_config(parser)
    add_settings(parser)
    parser.add_argument("--output", required=True, metavar="DIR", help="where the report goes")
    parser.set_defaults(model=[])


def run(options: argparse.Namespace) -> int:
    """Writes report.json, or leave_one_out.json, and prints a table of it."""
    if options.mode == "paper":
        options.set = ["method=paper", *options.set]
    configuration = configuration_of(options)
    output = Path(options.output)
    sweeps = [read_sweep(text, configuration) for text in options.leave_one_out]
    claim_directory(output)
    names = sequences_of(options.root, options.sequences)
    config, tilt_from_images = configuration.slam.frontend, options.tilt == "images"
    if options.kind != "car" and options.mode == "paper":
        raise ConfigurationError("--class: --mode paper is of cars alone")
    if options.draws < 1:
        raise ConfigurationError(f"--draws {options.draws}: expected 1 or more")
    if options.draws > 1 and (sweeps or options.kind != "car" or not tilt_from_images):
        raise ConfigurationError("--draws: of cars, by the tilt of images, without --leave-one-out")
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
    titles = f"{'as it is':>10}{'chosen':>10}{'score':>9}{'chosen':>9}{'depth':>9}{'chosen':>9}"
    lines = (
        f"{row.sequence:10}{row.as_it_is:>10}{row.chosen:>10}{row.score_as_it_is:9.3f}{row.score_chosen:9.3f}"
        f"{row.depth_error_as_it_is_rel:9.1%}{row.depth_error_chosen_rel:9.1%}  {row.key}"
        for row in rows
    )
    return "\n".join([f"{'sequence':10}{titles}  constant", *lines])


def _in_columns(cells: Iterable[tuple[float | None, str]]) -> str:
    """Each value by its format; one that there is not keeps its column."""
    return "".join("-".rjust(len(format(0.0, form))) if value is None else format(value, form) for value, form in cells)


_PLACES = f"{'depth':>9}{'bias':>9}{'across m':>10}{'1 sigma':>9}{'2 sigma':>9}"


def _places(row: PeopleRow | LocalisationRow) -> str:
    """The columns of _PLACES."""
    rels = (row.depth_error_median_rel, "9.1%"), (row.depth_bias_median_rel, "+9.1%")
    shares = (row.inside_1_sigma, "9.0%"), (row.inside_2_sigma, "9.0%")
    return _in_columns((*rels, (row.lateral_error_median_m, "10.2f"), *shares))


def _table_of_people(rows: Sequence[PeopleRow]) -> str:
    titles = f"{_PLACES}{'walking':>9}{'away':>7}{'across':>8}{'standing':>9}"
    lines = [f"{'sequence':11}{'range m':>9}{'n':>7}{titles}  (m/s: error of walking people, speed of standing people)"]
    for row in rows:
        parts = (row.walking_along_ray_median_mps, "7.2f"), (row.walking_across_ray_median_mps, "8.2f")
        speeds = (row.walking_speed_error_median_mps, "9.2f"), *parts, (row.standing_speed_median_mps, "9.2f")
        lines.append(f"{row.sequence:11}{row.range:>9}{row.n:>7}{_places(row)}{_in_columns(speeds)}")
    return "\n".join(lines)


def _table(rows: Sequence[LocalisationRow]) -> str:
    titles = f"{_PLACES}{'NEES':>7}{'yaw >10':>9}{'1 sigma':>9}{'2 sigma':>9}  (the last two: each car once)"
    lines = [f"{'':12}{'range m':>9}{'cars':>6}{'n':>7}{titles}"]
    for row in rows:
        shares = row.yaw_off_10_deg, row.inside_1_sigma_by_car, row.inside_2_sigma_by_car
        more = _in_columns(((row.nees, "7.2f"), *((share, "9.0%") for share in shares)))
        lines.append(f"{row.sequence:12}{row.range:>9}{row.cars:>6}{row.n:>7}{_places(row)}{more}")
    return "\n".join(lines)


def _table_of_parts(rows: Sequence[LocalisationRow]) -> str:
    titles = f"{'RMS':>9}{'stated':>9}{'in cars':>9}{'cars':>9}{'drives':>9}"
    lines = [f"{'':12}{'range m':>9}{titles}  error of depth: within a car's sights, between cars, between sequences"]
    for row in rows:
        of = row.within_cars_rel, row.between_cars_rel, row.between_sequences_rel
        parts = _in_columns((part, "9.1%") for part in (row.depth_rms_rel, row.depth_stated_rel, *of))
        lines.append(f"{row.sequence:12}{row.range:>9}{parts}")
    return "\n".join(lines)


def _table_of_tilts(rows: Sequence[TiltRow]) -> str:
    lines = [f"{'sequence':12}{'frames':>8}{'pitch mrad':>12}{'roll mrad':>11}  median errors against the labels' road"]
    for row in rows:
        numbers = _in_columns([(row.pitch_error_median_mrad, "12.1f"), (row.roll_error_median_mrad, "11.1f")])
        lines.append(f"{row.sequence:12}{row.n:>8}{numbers}")
    return "\n".join(lines)
