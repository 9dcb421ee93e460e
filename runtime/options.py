"""The configuration of a command line: its file, overridden by its options."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from birdslam.runtime.configuration import NO_MODEL, Configuration, ConfigurationError, load, parse_setting
from birdslam.runtime.models import store as model_store
from birdslam.runtime.schemes import all_schemes
from birdslam.sources.schemes import uri_of


def configuration_of(options: argparse.Namespace) -> Configuration:
    """Loads the configuration file, overridden by the options of the command line. Raises ConfigurationError."""
    take_inputs(options)
    overrides, named = overrides_of(options)
    return load(options.config, overrides, named)


def take_inputs(options: argparse.Namespace) -> None:
    """Sets `config` and `source` from the positional arguments of `birdslam run`. Raises ConfigurationError."""
    for text in getattr(options, "inputs", ()):
        if Path(text).suffix.lower() == ".toml":
            if options.config is not None:
                raise ConfigurationError(f"{text}: there is a configuration file already, {options.config}")
            options.config = Path(text)
        elif options.source is not None:
            raise ConfigurationError(f"{text}: there is a source already, {options.source}")
        else:
            try:
                options.source = uri_of(text, all_schemes())
            except ValueError as error:
                raise ConfigurationError(str(error)) from None
    options.inputs = ()


def overrides_of(options: argparse.Namespace) -> tuple[dict[str, Any], list[str]]:
    """Returns the keys and values, and the names of models, of the command line's options."""
    overrides: dict[str, Any] = dict(parse_setting(text) for text in options.set)
    named: list[str] = []
    for text in options.model:
        role, equals, path = text.partition("=")
        if text == NO_MODEL:
            overrides["models.shipped"] = False
        elif not equals and model_store.is_name(text):
            named.append(text)
        elif role and equals and path:
            overrides[f"models.{role}.path"] = path
        else:
            raise ConfigurationError(f"--model {text}: expected ROLE=PATH, or the name of a model")
    keys = {"source": "source.uri", "rate": "source.rate", "stride": "source.stride", "speed": "source.speed"}
    keys |= {"other_odometry": "source.odometry", "other_detections": "source.detections"}
    keys |= {"record": "recording.file", "record_images": "recording.images"}
    keys |= {"topic": "source.topics.image", "camera_info_topic": "source.topics.camera_info"}
    keys |= {"speed_topic": "source.topics.speed", "truth_topic": "source.topics.truth"}
    keys |= {"smooth": "results.smooth", "video": "results.video"}
    keys |= {"map": "results.map", "map_only": "results.map_only", "gnss": "results.gnss"}
    keys |= {"gnss_offset": "results.gnss_offset_s"}
    keys |= {"router": "ros.router", "domain": "ros.domain", "namespace": "ros.namespace"}
    keys |= {"runtime_dir": "runtime.runtime_dir"}
    for name in ("camera", "vehicle", "output", *keys):
        value = getattr(options, name, None)
        if value is not None:
            overrides[keys.get(name, name)] = _number(value) if name == "rate" else value
    if getattr(options, "no_map", False):
        overrides |= {"results.map": "", "results.map_only": ""}
    return overrides, named


def speeds_of(configuration: Configuration, drives: int) -> Path:
    """Returns the speed file of a drive, or the directory of several drives. Raises ConfigurationError."""
    path = Path(configuration.source.speed).expanduser()
    if drives > 1 and not path.is_dir():
        raise ConfigurationError(f"{path}: is the speed of one drive; for {drives} name a directory of NAME.txt files")
    return path


def _number(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text
