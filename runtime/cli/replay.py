"""`birdslam replay`: a recording through the back end again, to be compared or with other results."""

from __future__ import annotations

import argparse
import importlib.metadata
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import msgspec

from birdslam.graph.g2o import g2o_lines
from birdslam.outputs.drive_files import Recorder, claim_directory
from birdslam.outputs.drive_video import DriveVideo, check_video
from birdslam.outputs.final_trajectories import FinalTracks, last_seen, write_final_ego
from birdslam.runtime.configuration import ConfigurationError, parse_setting
from birdslam.runtime.progress import Progress
from birdslam.runtime.recording.recorded_drive import measurements_of
from birdslam.runtime.recording.recording import Recording, RecordingError
from birdslam.runtime.replay import replay as replaying
from birdslam.runtime.replay.report import told
from birdslam.runtime.supervision.final_results import recorded_frames
from birdslam.runtime.supervision.logbook import Results
from birdslam.types import Estimate, MapUpdate


def replay(options: argparse.Namespace) -> int:
    """`birdslam replay`: 0 where the back end gives the recorded estimates, 1 where not; or new results."""
    with Progress("replay", _size(options.recording), "MB", 1e6) as progress:
        recording = Recording(options.recording, progress.reach)
        if options.g2o:
            said, status = _written_g2o(recording, options), 0
        elif options.set or options.output or options.smooth or options.video:
            said, status = _results(recording, options), 0
        else:
            said, status = _compared(recording)
    print(said)
    return status


def _compared(recording: Recording) -> tuple[str, int]:
    """What is said of the comparison, and the exit status."""
    verdict = replaying.compare(recording)
    lines = [told(verdict, recording)]
    if verdict.difference is not None:
        for name, version in recording.about.versions.items():
            now = _version(name)
            if now is not None and now != version:
                lines.append(f"  recorded with {name} {version}, here it is {now}")
    return "\n".join(lines), int(not verdict.same)


def _written_g2o(recording: Recording, options: argparse.Namespace) -> str:
    """Writes the graph of the recorded measurements; says so."""
    _, weights = _changed(replaying.back_end(recording), dict(parse_setting(text) for text in options.set))
    try:
        options.g2o.write_text("".join(f"{line}\n" for line in g2o_lines(measurements_of([recording]), weights)))
    except OSError as error:
        raise RecordingError(f"{options.g2o}: can't be written: {error.strerror}") from None
    return f"graph in {options.g2o}"


def _size(path: Path) -> int | None:
    return path.stat().st_size if path.is_file() else None


def _version(library: str) -> str | None:
    try:
        return importlib.metadata.version(library)
    except importlib.metadata.PackageNotFoundError:
        return None


def _results(recording: Recording, options: argparse.Namespace) -> str:
    """Writes what the back end makes of the recorded measurements; says so."""
    if recording.camera is None:
        raise RecordingError(f"{recording.path}: its configuration has no camera")
    config = _changed(replaying.back_end(recording), dict(parse_setting(text) for text in options.set))
    output: Path = options.output or Path("out") / recording.path.stem
    with ExitStack() as stack:
        video = None
        if options.video:
            camera, rate_hz, frames = recorded_frames([recording.path])
            claim_directory(output)
            check_video(Path(options.video), camera, rate_hz)
            video = stack.enter_context(DriveVideo(Path(options.video), camera, rate_hz, frames))
        recorder = stack.enter_context(Recorder(output, recording.camera))
        everything: list[Results] = [recorder, *([video] if video is not None else [])]
        final = None
        if options.smooth:
            final = FinalTracks(output / "tracks", last_seen(measurements_of([recording])))
        for record in replaying.estimates(recording, config):
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
    return f"results in {output}" + (f", video {options.video}" if options.video else "")


def _changed(config: replaying.BackEnd, settings: Mapping[str, Any]) -> replaying.BackEnd:
    """With other values. Raises ConfigurationError for what is no number of the back end's."""
    parts = {"slam.graph": config[0], "slam.weights": config[1]}
    for key, value in settings.items():
        name, _, field = key.rpartition(".")
        if name not in parts:
            raise ConfigurationError(f"--set {key}: replay runs the back end alone: {' or '.join(parts)}.KEY=VALUE")
        try:
            tree = {**msgspec.to_builtins(parts[name]), field: value}
            parts[name] = msgspec.convert(tree, type(parts[name]))
        except msgspec.ValidationError as error:
            raise ConfigurationError(f"--set {key}: {error}") from None
    return parts["slam.graph"], parts["slam.weights"]  # type: ignore[return-value]
