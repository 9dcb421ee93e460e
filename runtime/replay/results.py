"""Writes results of recorded measurements: trajectories, map, video, and the graph's edges as g2o."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import msgspec

from birdslam.graph.g2o import g2o_lines
from birdslam.outputs.drive_files import Recorder, claim_directory
from birdslam.outputs.drive_video import DriveVideo, check_video
from birdslam.outputs.final_trajectories import FinalTracks, last_seen, write_final_ego
from birdslam.runtime.configuration import ConfigurationError, load
from birdslam.runtime.recording.recorded_drive import measurements_of
from birdslam.runtime.recording.recording import Recording, RecordingError
from birdslam.runtime.replay.replay import BackEnd, estimates
from birdslam.runtime.supervision.final_results import recorded_frames
from birdslam.runtime.supervision.logbook import Results
from birdslam.types import Estimate, MapUpdate


def write_g2o(recording: Recording, config: BackEnd, path: Path) -> None:
    """Writes the graph of the recorded measurements. Raises RecordingError."""
    try:
        path.write_text("".join(f"{line}\n" for line in g2o_lines(measurements_of([recording]), config[1])))
    except OSError as error:
        raise RecordingError(f"{path}: can't be written: {error.strerror}") from None


def write_results(recording: Recording, config: BackEnd, output: Path, smooth: bool, video_file: Path | None) -> None:
    """Writes the results of the recorded measurements into the folder `output`.

    `smooth`: also the final trajectories. Raises RecordingError, ResultsError.
    """
    if recording.camera is None:
        raise RecordingError(f"{recording.path}: its configuration has no camera")
    with ExitStack() as stack:
        video = None
        if video_file is not None:
            camera, rate_hz, frames = recorded_frames([recording.path])
            claim_directory(output)
            check_video(video_file, camera, rate_hz)
            video = stack.enter_context(DriveVideo(video_file, camera, rate_hz, frames))
        recorder = stack.enter_context(Recorder(output, recording.camera))
        everything: list[Results] = [recorder, *([video] if video is not None else [])]
        final = None
        if smooth:
            final = FinalTracks(output / "tracks", last_seen(measurements_of([recording])))
        for record in estimates(recording, config):
            if final is not None:
                final.take(record)
            for results in everything:
                if isinstance(record, Estimate):
                    results.add(record)
                elif isinstance(record, MapUpdate):
                    results.add_map(record)
        graph, weights = map(msgspec.to_builtins, config)
        recorder.finish({"source": str(recording.path), "slam": {"graph": graph, "weights": weights}})
        if final is not None:
            final.finish()
            write_final_ego(output)
        if video is not None:
            video.finish()


def changed_back_end(config: BackEnd, settings: Mapping[str, Any]) -> BackEnd:
    """Returns the back end with changed settings. Raises ConfigurationError for unknown keys."""
    if "method" in settings:
        slam = load(None, {"method": settings["method"]}).slam
        config = slam.graph, slam.weights
    parts = {"slam.graph": config[0], "slam.weights": config[1]}
    for key, value in settings.items():
        name, _, field = key.rpartition(".")
        if key == "method":
            continue
        if name not in parts:
            raise ConfigurationError(f"{key}: replay runs the back end alone: method, {', '.join(parts)}.KEY=VALUE")
        try:
            tree = {**msgspec.to_builtins(parts[name]), field: value}
            parts[name] = msgspec.convert(tree, type(parts[name]))
        except msgspec.ValidationError as error:
            raise ConfigurationError(f"{key}: {error}") from None
    return parts["slam.graph"], parts["slam.weights"]  # type: ignore[return-value]
