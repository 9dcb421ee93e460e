"""Position errors of the labelled road users of KITTI tracking, and leave-one-out cross-validation of constants."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec

from birdslam.bench.tracking.by_class.class_tracks import IMAGE, KINDS, METRES, TracksRow, class_tracks, tracks_row
from birdslam.bench.tracking.by_class.people import PeopleRow, boxes_of_hulls, has_labels, judge, summarise_people
from birdslam.bench.tracking.leave_one_out import LeftOut, PlaceError, left_out
from birdslam.bench.tracking.localisation import (
    CAMERA_OF_BOXES,
    CarError,
    LocalisationRow,
    TiltRow,
    as_reported,
    match_cars,
    measure,
    summarise_ranges,
    tilt_row,
)
from birdslam.bench.tracking.movers import MoversRow, movers_of_draws, movers_row
from birdslam.frontend import FrontEndConfig
from birdslam.graph.pose_graph import PoseGraph
from birdslam.perception import Detections
from birdslam.runtime.configuration import Configuration, ConfigurationError
from birdslam.runtime.progress import Progress
from birdslam.slam import SlamConfig
from birdslam.sources.kitti_tracking import TrackingSequence, open_tracking, read_detections
from birdslam.sources.recording import DatasetError
from birdslam.types import Measurements


class Sweep(NamedTuple):
    """A constant of the front end, its present value, and a configuration for each value of the sweep."""

    key: str
    as_it_is: str
    by_value: dict[str, FrontEndConfig]


def evaluate_localisation(
    root: Path,
    names: Sequence[str],
    detections: str,
    config: SlamConfig,
    tilt_from_images: bool = False,
    draws: int = 1,
) -> tuple[list[LocalisationRow], list[TiltRow], list[MoversRow]]:
    """Returns position errors of cars by range, errors of the road tilt, and false movers.

    `detections`: "rrc" or a directory with files as in det_02_rrc. `tilt_from_images`: as in `measure`; its error is
    drawn `draws` times and all draws are pooled. Raises DatasetError.
    """
    sequences = [open_tracking(root, name, CAMERA_OF_BOXES) for name in names]
    with Progress("localisation", draws * sum(map(len, sequences))) as progress:
        progress.reach(0)
        errors: list[CarError] = []
        reported: list[CarError] = []
        tilts: list[TiltRow] = []
        movers: list[MoversRow] = []
        for sequence in sequences:
            found = read_detections(_folder(root, detections), sequence.name, len(sequence))
            logs, drawn = [], []
            for draw in range(draws):
                log = measure(sequence, found, config.frontend, tilt_from_images, draw)
                errors += match_cars(sequence, log)
                graph = PoseGraph(config.graph, config.weights)
                estimates = [graph.optimise(record) for record in log]
                reported += match_cars(sequence, as_reported(log, estimates))
                drawn.append(movers_row(sequence, log, estimates, "truth"))
                logs += log
                progress.advance(len(sequence))
            tilts.append(tilt_row(sequence, logs))
            movers.append(movers_of_draws(drawn))
    return summarise_ranges(errors, reported), tilts, movers


def evaluate_people(
    root: Path, names: Sequence[str], detections: str, config: FrontEndConfig, kind: str, tilt_from_images: bool = False
) -> tuple[list[PeopleRow], list[TracksRow]]:
    """Returns position errors of pedestrians or cyclists by range, and their tracks in bird's-eye view.

    Skips sequences without labels of the class. Raises DatasetError.
    """
    logs = _logs_of_people(root, names, detections, config, kind, tilt_from_images)
    return summarise_people([judge(sequence, log, kind) for sequence, log in logs])


def evaluate_classes(
    root: Path, names: Sequence[str], detections: str, config: FrontEndConfig, tilt_from_images: bool = False
) -> list[TracksRow]:
    """Returns tracking metrics of each class, in bird's-eye view and in the image. Raises DatasetError."""
    rows: list[TracksRow] = []
    for kind in KINDS:
        tracks = [
            class_tracks(sequence, log, kind)
            for sequence, log in _logs_of_people(root, names, detections, config, kind, tilt_from_images)
        ]
        for view in (METRES, IMAGE):
            rows += [tracks_row(of.sequence, view, [of]) for of in tracks]
            rows.append(tracks_row("all", view, tracks))
    return rows


def _logs_of_people(
    root: Path, names: Sequence[str], detections: str, config: FrontEndConfig, kind: str, tilt_from_images: bool
) -> Iterator[tuple[TrackingSequence, list[Measurements]]]:
    """Yields the sequences with labels of a class and the measurements of the front end."""
    sequences = [open_tracking(root, name, CAMERA_OF_BOXES) for name in names]
    sequences = [sequence for sequence in sequences if has_labels(sequence, kind)]
    if not sequences:
        raise DatasetError(f"{root}: none of these sequences has labels of a {kind}")
    with Progress(kind, sum(map(len, sequences))) as progress:
        progress.reach(0)
        for sequence in sequences:
            yield sequence, measure(sequence, _boxes(root, detections, sequence, kind), config, tilt_from_images)
            progress.advance(len(sequence))


def evaluate_left_out(
    root: Path,
    names: Sequence[str],
    detections: str,
    config: FrontEndConfig,
    sweeps: Sequence[Sweep],
    tilt_from_images: bool = False,
    kind: str = "car",
) -> list[LeftOut]:
    """Evaluates each sequence with the value that the other sequences select, per sweep. Raises ConfigurationError."""
    sequences = [open_tracking(root, name, CAMERA_OF_BOXES) for name in names]
    sequences = [sequence for sequence in sequences if has_labels(sequence, kind)]
    drives = 1 + sum(len(sweep.by_value) - 1 for sweep in sweeps)
    rows: list[LeftOut] = []
    with Progress("localisation", drives * sum(map(len, sequences))) as progress:
        present = _errors(root, sequences, detections, config, progress.advance, kind, tilt_from_images)
        for key, as_it_is, by_value in sweeps:
            found = {
                value: _errors(root, sequences, detections, varied, progress.advance, kind, tilt_from_images)
                for value, varied in by_value.items()
                if value != as_it_is
            }
            try:
                rows += left_out(key, as_it_is, {as_it_is: present, **found})
            except ValueError as error:
                raise ConfigurationError(f"--leave-one-out: {error}") from None
    return rows


def _errors(
    root: Path,
    sequences: Sequence[TrackingSequence],
    detections: str,
    config: FrontEndConfig,
    advance: Callable[[int], None],
    kind: str,
    tilt_from_images: bool = False,
) -> dict[str, Sequence[PlaceError]]:
    out: dict[str, Sequence[PlaceError]] = {}
    for sequence in sequences:
        log = measure(sequence, _boxes(root, detections, sequence, kind), config, tilt_from_images)
        out[sequence.name] = match_cars(sequence, log) if kind == "car" else judge(sequence, log, kind).errors
        advance(len(sequence))
    return out


def _boxes(root: Path, detections: str, sequence: TrackingSequence, kind: str) -> list[Detections]:
    """Reads the boxes. RRC has no cyclists: their boxes are the projected labels."""
    found = read_detections(_folder(root, detections), sequence.name, len(sequence))
    return boxes_of_hulls(sequence, found, kind) if kind == "cyclist" and detections == "rrc" else found


def _folder(root: Path, detections: str) -> Path:
    return root / "det_02_rrc" if detections == "rrc" else Path(detections)


def read_sweep(text: str, configuration: Configuration) -> Sweep:
    """Parses KEY=V1,V2 of `--leave-one-out`. Raises ConfigurationError."""
    key, _, values = text.partition("=")
    if not key.startswith("slam.frontend.") or not values:
        raise ConfigurationError(f"--leave-one-out {text}: expected slam.frontend.KEY=V1,V2")
    tree = msgspec.to_builtins(configuration.slam.frontend)
    *parents, leaf = key.split(".")[2:]
    branch = tree
    for parent in parents:
        branch = branch.get(parent) if isinstance(branch, dict) else None
    if not isinstance(branch, dict) or type(branch.get(leaf)) not in (int, float):
        raise ConfigurationError(f"--leave-one-out {text}: {key} is not a number of the configuration")
    as_it_is, found = branch[leaf], {str(branch[leaf]): configuration.slam.frontend}
    for value in values.split(","):
        try:
            branch[leaf] = type(as_it_is)(value)
            found[str(branch[leaf])] = msgspec.convert(tree, FrontEndConfig)
        except (ValueError, msgspec.ValidationError) as error:
            raise ConfigurationError(f"--leave-one-out {text}: {value}: {error}") from None
    return Sweep(key, str(as_it_is), found)


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
