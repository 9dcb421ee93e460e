"""`birdslam replay`: a recording through the back end again, to be compared or with other results."""

from __future__ import annotations

import argparse
import importlib.metadata
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec

from birdslam.evaluation.results import Recorder
from birdslam.runtime.configuration import ConfigurationError, parse_setting
from birdslam.runtime.recording.recording import Recording, RecordingError
from birdslam.runtime.replay import replay as replaying
from birdslam.runtime.replay.report import told
from birdslam.types import Estimate


def replay(options: argparse.Namespace) -> int:
    """`birdslam replay`: 0 where the back end gives the recorded estimates, 1 where not; or new results."""
    recording = Recording(options.recording)
    if options.set or options.output:
        settings = dict(parse_setting(text) for text in options.set)
        print(_results(recording, settings, options.output or Path("out") / options.recording.stem))
        return 0
    verdict = replaying.compare(recording)
    print(told(verdict, recording))
    if verdict.difference is not None:
        for name, version in recording.about.versions.items():
            now = _version(name)
            if now is not None and now != version:
                print(f"  recorded with {name} {version}, here it is {now}")
    return int(not verdict.same)


def _version(library: str) -> str | None:
    try:
        return importlib.metadata.version(library)
    except importlib.metadata.PackageNotFoundError:
        return None


def _results(recording: Recording, settings: Mapping[str, Any], output: Path) -> str:
    """Writes what the back end makes of the recorded measurements; says so."""
    if recording.camera is None:
        raise RecordingError(f"{recording.path}: its configuration has no camera")
    config = _changed(replaying.back_end(recording), settings)
    with Recorder(output, recording.camera) as recorder:
        for record in replaying.estimates(recording, config):
            if isinstance(record, Estimate):
                recorder.add(record)
            else:
                recorder.add_map(record)
        graph, weights = map(msgspec.to_builtins, config)
        recorder.finish({"source": str(recording.path), "slam": {"graph": graph, "weights": weights}})
    return f"results in {output}"


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
