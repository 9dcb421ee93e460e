"""Runs the method on recordings in one process and compares it with true poses and LiDAR."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from birdslam.bench.ego.trajectory_errors import OdometryReport, evaluate_recordings, has_evo
from birdslam.runtime.batch.offline import Drive, pipeline
from birdslam.runtime.configuration import Configuration, ConfigurationError
from birdslam.runtime.nodes.sources import open_recorded, recording_uri
from birdslam.runtime.options import speeds_of
from birdslam.runtime.progress import Progress
from birdslam.sources.odometry_file import check_odometry
from birdslam.sources.recording import Recording
from birdslam.sources.speed_file import of_sequence, with_speeds
from birdslam.types import Estimate, MapUpdate, Measurements


def evaluate_odometry(configuration: Configuration, sequences: Sequence[str], compared: slice) -> list[OdometryReport]:
    """Processes each sequence, compares the frames `compared` with the truth, writes report.json and trajectories.

    `sequences`: KITTI directories or URIs of sources. Raises ConfigurationError, DatasetError, ResultsError.
    """
    if not has_evo():
        raise ConfigurationError("trajectories are compared by evo: pip install 'birdslam[evaluate]'")
    source = configuration.source
    if source.frames is not None or source.loop:
        raise ConfigurationError("source.frames, source.loop: evaluate processes whole recordings once; remove both")
    recordings = [
        open_recorded(recording_uri(text), configuration.camera, source.stride, source.topics) for text in sequences
    ]
    twice = [name for name, n in Counter(recording.name for recording in recordings).items() if n > 1]
    if twice:
        raise ConfigurationError(f"two sequences have the name {twice[0]}; their results would overwrite each other")
    if source.speed:
        for recording in recordings:
            with_speeds(recording, of_sequence(speeds_of(configuration, len(recordings)), recording.name))
    if source.odometry:
        for recording in recordings:
            check_odometry(recording, of_sequence(Path(source.odometry).expanduser(), recording.name), source.stride)
    for recording in recordings:
        if len(range(*compared.indices(len(recording)))) < 2:
            raise ConfigurationError(f"--frames: fewer than two of the {len(recording)} frames of {recording.name}")
    with pipeline(configuration) as drive:
        return evaluate_recordings(recordings, _with_progress(drive), Path(configuration.output), compared=compared)


def _with_progress(drive: Drive) -> Drive:
    def shown_drive(recording: Recording) -> Iterator[Measurements | Estimate | MapUpdate]:
        with Progress(recording.name, len(recording) or None) as progress:
            for record in drive(recording):
                yield record
                progress.advance(isinstance(record, Estimate))

    return shown_drive
