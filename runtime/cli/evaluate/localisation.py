"""`birdslam evaluate localisation`: position errors of labelled cars or people of KITTI tracking, by range."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from pathlib import Path

from birdslam.bench.tracking.by_class.class_tracks import TracksRow
from birdslam.bench.tracking.by_class.people import PEOPLE
from birdslam.bench.tracking.localisation import PlacesRow
from birdslam.bench.tracking.stationary import StationaryRow
from birdslam.outputs.drive_files import claim_directory, write_json
from birdslam.runtime.cli.arguments import add_config, add_settings, add_tracking_root
from birdslam.runtime.configuration import ConfigurationError
from birdslam.runtime.evaluation.localisation import evaluate_localisation, evaluate_people, sequences_of
from birdslam.runtime.options import configuration_of


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds sequences, the class and settings."""
    add_tracking_root(parser)
    text = "number of random draws of the tilt error, evaluated together"
    parser.add_argument("--draws", type=int, default=1, metavar="N", help=text)
    text = "class of road users; boxes of cyclists are projected labels with the noise of detections"
    parser.add_argument("--class", dest="kind", choices=("car", *PEOPLE), default="car", help=text)
    add_config(parser)
    add_settings(parser)
    parser.add_argument("--output", required=True, metavar="DIR", help="directory of the report")
    parser.set_defaults(model=[])


def run(options: argparse.Namespace) -> int:
    """Writes report.json, and prints it as a table."""
    config = configuration_of(options).slam
    output = Path(options.output)
    if options.draws < 1:
        raise ConfigurationError(f"--draws {options.draws}: expected 1 or more")
    if options.draws > 1 and options.kind != "car":
        raise ConfigurationError("--draws: needs --class car")
    claim_directory(output)
    names = sequences_of(options.root, options.sequences)
    if options.kind == "car":
        rows, stationary = evaluate_localisation(options.root, names, config, options.draws)
        write_json(output / "report.json", rows)
        write_json(output / "stationary.json", stationary)
        print(_table(rows))
        print(_line_of_stationary(stationary))
    else:
        people, tracks = evaluate_people(options.root, names, config.frontend, options.kind)
        write_json(output / "report.json", {"places": people, "tracks": tracks})
        print(_table_of_people(people))
        print(_table_of_tracks(tracks))
    print(f"results in {output}")
    return 0


def _in_columns(cells: Iterable[tuple[float | None, str]]) -> str:
    """Formats values in columns; a missing value is a dash."""
    return "".join("-".rjust(len(format(0.0, form))) if value is None else format(value, form) for value, form in cells)


_PLACES = f"{'depth':>9}{'bias':>9}{'across m':>10}{'1 sigma':>9}{'2 sigma':>9}"


def _places(row: PlacesRow) -> str:
    """Returns the columns of _PLACES."""
    rels = (row.depth_error_median_rel, "9.1%"), (row.depth_bias_median_rel, "+9.1%")
    shares = (row.inside_1_sigma, "9.0%"), (row.inside_2_sigma, "9.0%")
    return _in_columns((*rels, (row.lateral_error_median_m, "10.2f"), *shares))


def _table(rows: Sequence[PlacesRow]) -> str:
    lines = [f"{'':12}{'range m':>9}{'cars':>6}{'n':>7}{_PLACES}{'NEES':>7}"]
    for row in rows:
        places = f"{_places(row)}{_in_columns([(row.nees, '7.2f')])}"
        lines.append(f"{row.sequence:12}{row.range:>9}{row.tracks:>6}{row.n:>7}{places}")
    return "\n".join(lines)


def _line_of_stationary(row: StationaryRow | None) -> str:
    if row is None:
        return "stationary vehicles: none"
    return (
        f"stationary vehicles, {row.tracks} tracks: drift in world {row.drift_median_m:.2f} m from first to last sight "
        f"(median), {row.inside_2_sigma:.0%} inside 2 sigma, path {row.path_median_m:.2f} m (median), "
        f"{row.false_movers} reported as moving"
    )


def _table_of_people(rows: Sequence[PlacesRow]) -> str:
    lines = [f"{'sequence':11}{'range m':>9}{'n':>7}{_PLACES}{'walking':>9}  (velocity error of walking people, m/s)"]
    for row in rows:
        speed = _in_columns([(row.walking_speed_error_median_mps, "9.2f")])
        lines.append(f"{row.sequence:11}{row.range:>9}{row.n:>7}{_places(row)}{speed}")
    return "\n".join(lines)


def _table_of_tracks(rows: Sequence[TracksRow]) -> str:
    titles = "".join(f"{title:>9}" for title in ("labels", "HOTA", "IDF1", "MOTA", "switches"))
    lines = [f"{'class':12}{'sequence':11}{titles}"]
    for row in rows:
        numbers = f"{row.labels:9}{row.hota:9.3f}{row.idf1:9.3f}{row.mota:9.3f}{row.switches:9}"
        lines.append(f"{row.kind:12}{row.sequence:11}{numbers}")
    return "\n".join(lines)
