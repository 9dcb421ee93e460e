"""`birdslam evaluate localisation`: where the front end puts the labelled cars of KITTI tracking."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import msgspec

from birdslam.datasets.kitti_tracking import TrackingSequence, open_tracking, read_detections
from birdslam.datasets.recording import DatasetError
from birdslam.evaluation.localisation import (
    CAMERA_OF_BOXES,
    PAPER,
    CarError,
    LocalisationRow,
    match_cars,
    measure,
    summarise_ranges,
)
from birdslam.evaluation.results import claim_directory
from birdslam.frontend import FrontEndConfig
from birdslam.runtime.configuration import Configuration, ConfigurationError
from birdslam.runtime.progress import Progress


def evaluate(options: argparse.Namespace, configuration: Configuration) -> int:
    """Writes report.json and prints a table; gives the exit status."""
    modes = {"default": configuration.slam.frontend, "paper": PAPER}
    output = Path(options.output)
    claim_directory(output)
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
