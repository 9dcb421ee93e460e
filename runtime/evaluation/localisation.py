"""`birdslam evaluate localisation`: where the front end puts the labelled cars of KITTI tracking."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import msgspec

from birdslam.bench.tracking.leave_one_out import LeftOut, left_out
from birdslam.bench.tracking.localisation import (
    CAMERA_OF_BOXES,
    PAPER,
    CarError,
    LocalisationRow,
    match_cars,
    measure,
    summarise_ranges,
)
from birdslam.frontend import FrontEndConfig
from birdslam.outputs.drive_files import claim_directory
from birdslam.runtime.configuration import Configuration, ConfigurationError
from birdslam.runtime.progress import Progress
from birdslam.sources.kitti_tracking import TrackingSequence, open_tracking, read_detections
from birdslam.sources.recording import DatasetError


def evaluate(options: argparse.Namespace, configuration: Configuration) -> int:
    """Writes report.json and prints a table; gives the exit status."""
    modes = {"default": configuration.slam.frontend, "paper": PAPER}
    output = Path(options.output)
    sweeps = [_sweep(text, configuration) for text in options.leave_one_out]
    claim_directory(output)
    if sweeps:
        return _leave_one_out(options, sweeps, configuration, output)
    errors: list[CarError] = []
    sequences = [open_tracking(options.root, name, CAMERA_OF_BOXES) for name in _sequences(options)]
    with Progress("localisation", sum(map(len, sequences))) as progress:
        progress.reach(0)
        for sequence in sequences:
            errors += _errors(options.root, sequence, options.detections, modes[options.mode])
            progress.advance(len(sequence))
    rows = summarise_ranges(errors)
    (output / "report.json").write_bytes(msgspec.json.format(msgspec.json.encode(rows), indent=2) + b"\n")
    print(_table(rows))
    print(f"results in {output}")
    return 0


def _sweep(text: str, configuration: Configuration) -> tuple[str, str, dict[str, FrontEndConfig]]:
    """KEY=V1,V2 as the key, its value as it is, and the front ends by value. Raises ConfigurationError."""
    key, _, values = text.partition("=")
    if not key.startswith("slam.frontend.") or not values:
        raise ConfigurationError(f"--leave-one-out {text}: expected slam.frontend.KEY=V1,V2")
    tree = msgspec.to_builtins(configuration.slam.frontend)
    *parents, leaf = key.split(".")[2:]
    branch = tree
    for parent in parents:
        branch = branch.get(parent) if isinstance(branch, dict) else None
    if not isinstance(branch, dict) or type(branch.get(leaf)) not in (int, float):
        raise ConfigurationError(f"--leave-one-out {text}: {key} is no number of the configuration")
    as_it_is, found = branch[leaf], {str(branch[leaf]): configuration.slam.frontend}
    for value in values.split(","):
        try:
            branch[leaf] = type(as_it_is)(value)
            found[str(branch[leaf])] = msgspec.convert(tree, FrontEndConfig)
        except (ValueError, msgspec.ValidationError) as error:
            raise ConfigurationError(f"--leave-one-out {text}: {value}: {error}") from None
    return key, str(as_it_is), found


def _leave_one_out(
    options: argparse.Namespace,
    sweeps: Sequence[tuple[str, str, dict[str, FrontEndConfig]]],
    configuration: Configuration,
    output: Path,
) -> int:
    sequences = [open_tracking(options.root, name, CAMERA_OF_BOXES) for name in _sequences(options)]
    drives = 1 + sum(len(by_value) - 1 for _, _, by_value in sweeps)
    rows: list[LeftOut] = []
    with Progress("localisation", drives * sum(map(len, sequences))) as progress:

        def errors_of(config: FrontEndConfig) -> dict[str, list[CarError]]:
            out = {}
            for sequence in sequences:
                out[sequence.name] = _errors(options.root, sequence, options.detections, config)
                progress.advance(len(sequence))
            return out

        as_they_are = errors_of(configuration.slam.frontend)
        for key, as_it_is, by_value in sweeps:
            found = {value: errors_of(config) for value, config in by_value.items() if value != as_it_is}
            try:
                rows += left_out(key, as_it_is, {as_it_is: as_they_are, **found})
            except ValueError as error:
                raise ConfigurationError(f"--leave-one-out: {error}") from None
    (output / "leave_one_out.json").write_bytes(msgspec.json.format(msgspec.json.encode(rows), indent=2) + b"\n")
    print(f"{'sequence':10}{'as it is':>10}{'chosen':>10}{'score':>9}{'chosen':>9}{'depth':>9}{'chosen':>9}  constant")
    for row in rows:
        print(
            f"{row.sequence:10}{row.as_it_is:>10}{row.chosen:>10}{row.score_as_it_is:9.3f}{row.score_chosen:9.3f}"
            f"{row.depth_error_as_it_is_rel:9.1%}{row.depth_error_chosen_rel:9.1%}  {row.key}"
        )
    print(f"results in {output}")
    return 0


def _sequences(options: argparse.Namespace) -> list[str]:
    labels = options.root / "label_02"
    if not labels.is_dir():
        raise DatasetError(f"{options.root}: is no KITTI tracking folder: it has no label_02")
    known = sorted(path.stem for path in labels.glob("*.txt"))
    chosen = list(dict.fromkeys(options.sequences.split(","))) if options.sequences else known
    missing = [name for name in chosen if name not in known]
    if missing or not chosen:
        raise ConfigurationError(f"--sequences: {options.root} has no {', '.join(missing) or 'sequences'}")
    return chosen


def _errors(root: Path, sequence: TrackingSequence, detections: str, config: FrontEndConfig) -> list[CarError]:
    folder = root / "det_02_rrc" if detections == "rrc" else Path(detections)
    found = read_detections(folder, sequence.name, len(sequence))
    return match_cars(sequence, measure(sequence, found, config))


def _table(rows: Sequence[LocalisationRow]) -> str:
    lines = [
        f"{'sequence':10}{'range m':>9}{'n':>7}{'depth':>9}{'bias':>9}{'across m':>10}{'1 sigma':>9}{'2 sigma':>9}"
    ]
    for row in rows:
        cells = (
            (row.depth_error_median_rel, "9.1%"),
            (row.depth_bias_median_rel, "+9.1%"),
            (row.lateral_error_median_m, "10.2f"),
            (row.inside_1_sigma, "9.0%"),
            (row.inside_2_sigma, "9.0%"),
        )
        numbers = "".join(format(value, form) for value, form in cells if value is not None)
        lines.append(f"{row.sequence:10}{row.range:>9}{row.n:>7}{numbers}")
    return "\n".join(lines)
