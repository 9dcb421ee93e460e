"""Position errors of the labelled road users of KITTI tracking, from recorded boxes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from birdslam.bench.tracking.by_class.class_tracks import TracksRow
from birdslam.bench.tracking.by_class.people import boxes_of_hulls, has_labels, judge, summarise_people
from birdslam.bench.tracking.localisation import (
    BOXES,
    CAMERA_OF_BOXES,
    CAR_RANGES_M,
    PlaceError,
    PlacesRow,
    match_cars,
    measure,
    summarise_ranges,
)
from birdslam.bench.tracking.stationary import StationaryRow, stationary_tracks, summarise_stationary
from birdslam.frontend import FrontEndConfig
from birdslam.runtime.configuration import ConfigurationError
from birdslam.runtime.progress import Progress
from birdslam.slam import SlamConfig
from birdslam.sources.kitti_tracking import open_tracking, read_detections
from birdslam.sources.recording import DatasetError


def evaluate_localisation(
    root: Path, names: Sequence[str], config: SlamConfig, draws: int = 1
) -> tuple[list[PlacesRow], StationaryRow | None]:
    """Returns position errors of cars by range, and the drift of stationary vehicles in the pose graph.

    The tilt error is drawn `draws` times, evaluated together. Raises DatasetError.
    """
    sequences = [open_tracking(root, name, CAMERA_OF_BOXES) for name in names]
    errors: list[PlaceError] = []
    stationary = []
    with Progress("localisation", draws * sum(map(len, sequences))) as progress:
        progress.reach(0)
        for sequence in sequences:
            found = read_detections(root / BOXES, sequence.name, len(sequence))
            for draw in range(draws):
                measurements = measure(sequence, found, config.frontend, draw)
                errors += match_cars(sequence, measurements)
                stationary += stationary_tracks(sequence, measurements, config)
                progress.advance(len(sequence))
    return summarise_ranges(errors, CAR_RANGES_M), summarise_stationary(stationary)


def evaluate_people(
    root: Path, names: Sequence[str], config: FrontEndConfig, kind: str
) -> tuple[list[PlacesRow], list[TracksRow]]:
    """Returns position errors of pedestrians or cyclists by range, and their tracks in bird's-eye view.

    Skips sequences without labels of the class. RRC has no cyclists: their boxes are projected labels with the noise
    of detections. Raises DatasetError.
    """
    sequences = [open_tracking(root, name, CAMERA_OF_BOXES) for name in names]
    sequences = [sequence for sequence in sequences if has_labels(sequence, kind)]
    if not sequences:
        raise DatasetError(f"{root}: none of these sequences has labels of a {kind}")
    results = []
    with Progress(kind, sum(map(len, sequences))) as progress:
        progress.reach(0)
        for sequence in sequences:
            found = read_detections(root / BOXES, sequence.name, len(sequence))
            boxes = boxes_of_hulls(sequence, found, kind) if kind == "cyclist" else found
            results.append(judge(sequence, measure(sequence, boxes, config, draw=0), kind))
            progress.advance(len(sequence))
    return summarise_people(results)


def sequences_of(root: Path, asked: str | None, known: Sequence[str] | None = None) -> list[str]:
    """Returns the names in "0002,0003"; None: those of `known` in the KITTI tracking folder, or all.

    Raises ConfigurationError, DatasetError.
    """
    labels = root / "label_02"
    if not labels.is_dir():
        raise DatasetError(f"{root}: not a KITTI tracking folder: label_02 is missing")
    existing = sorted(path.stem for path in labels.glob("*.txt"))
    chosen = list(dict.fromkeys(asked.split(","))) if asked else [n for n in existing if known is None or n in known]
    missing = [name for name in chosen if name not in existing]
    if missing or not chosen:
        raise ConfigurationError(f"--sequences: {root} has no {', '.join(missing) or 'sequences'}")
    return chosen
