"""One typed configuration for the whole system: the defaults live here and in the structs it holds.

A TOML file holds differences only. An unknown key or a wrong type is a `ConfigurationError` that names the file (or the
command-line option) and the key. Paths in a file are relative to that file.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from birdslam.camera import Camera
from birdslam.datasets import DatasetError, load_camera
from birdslam.perception import ModelSpec
from birdslam.slam import SlamConfig

FILE_SCHEMES = ("kitti", "video")  # sources whose address is a path, and so relative to the file that names it

PositiveInt = Annotated[int, msgspec.Meta(ge=1)]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]


class ConfigurationError(ValueError):
    """What the user asked for can't be: the message names the file or option, the key, and the reason."""


class SourceConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where frames come from, and how fast."""

    uri: str = ""  # kitti:DIR, video:FILE, v4l2:/dev/videoN, rtsp://...
    rate: Positive | Literal["max"] | None = None  # Hz; None: by the source's own time stamps; "max": lossless
    stride: PositiveInt = 1  # every so-manieth frame of a recording
    frames: PositiveInt | None = None  # end after so many; None: all
    loop: bool = False  # a recording begins anew at its end
    prefetch_frames: PositiveInt = 4  # decoded ahead of their time, so that a slow file is not a late frame
    camera_timeout_s: Positive = 5.0  # a camera or stream that delivers nothing for so long has failed


class ModelsConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The network of each role; a role without one goes unfilled."""

    detector: ModelSpec | None = None
    segmenter: ModelSpec | None = None

    def given(self) -> dict[str, ModelSpec]:
        """Role -> network, in a fixed order."""
        specs = {role: getattr(self, role) for role in self.__struct_fields__}
        return {role: spec for role, spec in specs.items() if spec is not None}


class PerceiveConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The perceive process."""

    # A frame waits for networks until its deadline, from its capture on; at rate "max" each is awaited to its end.
    deadline_ms: Positive | None = None  # None: by the frame rate
    deadline_periods: Positive = 0.75  # of the source's frames; the rest is for what comes after the networks
    opencv_threads: PositiveInt = 2


class RuntimeConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Processes, memory and time limits."""

    runtime_dir: str = ""  # sockets, locks and vitals; "": the user's own (runtime/presence.py)
    ring_slots: Annotated[int, msgspec.Meta(ge=2, le=64)] = 8
    in_flight_frames: PositiveInt = 4  # frames between capture and the estimate at rate "max"
    ready_timeout_s: Positive = 60.0  # for a node to load, warm up and find its peers
    drain_timeout_s: Positive = 2.0  # for the last frame's estimate to come back before the end is announced
    stop_timeout_s: Positive = 10.0  # for all nodes to end
    beat_s: Positive = 0.1  # a node's loop shows life at least so often
    watchdog_s: Positive = 10.0  # a ready node without a beat for so long has failed
    switch_interval_s: Positive = 5e-4  # of the GIL, for the threads that wait beside a busy one


class Configuration(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """All that a run can be told."""

    vehicle: Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,31}$")] = "car"
    source: SourceConfig = SourceConfig()
    camera: Camera | None = None  # None: the recording's own; in a file: a table, or the path of a camera file
    models: ModelsConfig = ModelsConfig()
    perceive: PerceiveConfig = PerceiveConfig()
    slam: SlamConfig = SlamConfig()
    runtime: RuntimeConfig = RuntimeConfig()
    output: str = "out"

    @property
    def lossless(self) -> bool:
        """Every frame is processed, as fast as it can be."""
        return self.source.rate == "max"

    @property
    def runtime_dir(self) -> Path | None:
        """Where sockets and locks go; None: the user's own place (runtime/presence.py)."""
        return Path(self.runtime.runtime_dir) if self.runtime.runtime_dir else None

    @property
    def deadline_ns(self) -> int | None:
        """From a frame's capture on, how long it waits for networks; None: for all of them, so that a run repeats."""
        deadline_ms = self.perceive.deadline_ms
        return None if self.lossless or deadline_ms is None else round(deadline_ms * 1e6)


def load(path: Path | None, overrides: Mapping[str, Any] | None = None) -> Configuration:
    """The configuration of a TOML file, then `overrides` ({"slam.graph.ego_nodes": 8}) on top of it.

    Raises ConfigurationError.
    """
    tree: dict[str, Any] = {}
    if path is not None:
        try:
            tree = tomllib.loads(path.read_text())
        except OSError as error:
            raise ConfigurationError(f"{path}: {error.strerror}") from error
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise ConfigurationError(f"{path}: not TOML: {error}") from error
        _anchor_paths(tree, path.resolve().parent)
    overrides = overrides or {}
    for key, value in overrides.items():
        _put(tree, key, value)
    _read_camera_file(tree)
    try:
        return msgspec.convert(tree, Configuration)
    except msgspec.ValidationError as error:
        key, reason = _explain(str(error))
        raise ConfigurationError(f"{_origin(key, path, overrides)}: {key}: {reason}") from error


def complete(configuration: Configuration, camera: Camera, rate_hz: float) -> Configuration:
    """The configuration with what its source knows: the camera, and how long a frame may wait at that frame rate."""
    rate, perceive = configuration.source.rate, configuration.perceive
    if perceive.deadline_ms is None:
        hz = rate if isinstance(rate, float) else rate_hz
        perceive = msgspec.structs.replace(perceive, deadline_ms=perceive.deadline_periods * 1e3 / hz)
    return msgspec.structs.replace(configuration, camera=camera, perceive=perceive)


def parse_setting(text: str) -> tuple[str, Any]:
    """KEY=VALUE of the command line; the value is TOML, or a plain string where it is none."""
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise ConfigurationError(f"--set {text}: expected KEY=VALUE")
    try:
        return key.strip(), tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return key.strip(), value


def dump(configuration: Configuration) -> dict[str, Any]:
    """Plain JSON-able data; `msgspec.convert(dump(c), Configuration) == c`."""
    return msgspec.to_builtins(configuration)


def _put(tree: dict[str, Any], key: str, value: Any) -> None:
    *parents, leaf = key.split(".")
    for parent in parents:
        branch = tree.setdefault(parent, {})
        if not isinstance(branch, dict):
            raise ConfigurationError(f"command line: {key}: {parent} is no table")
        tree = branch
    tree[leaf] = value


def _anchor_paths(tree: dict[str, Any], base: Path) -> None:
    """Makes the paths of a file absolute; whatever has a wrong type is left for the validation to name."""

    def anchor(table: Any, *keys: str) -> None:
        for key in keys:
            if isinstance(table, dict) and isinstance(table.get(key), str) and table[key]:
                table[key] = str(base / Path(table[key]).expanduser())

    anchor(tree, "camera", "output")
    anchor(tree.get("runtime"), "runtime_dir")
    models = tree.get("models")
    for spec in models.values() if isinstance(models, dict) else ():
        anchor(spec, "path")
        if isinstance(spec, dict) and str(spec.get("manifest", "")).endswith(".toml"):  # else a shipped one's name
            anchor(spec, "manifest")
    source = tree.get("source")
    if isinstance(source, dict) and isinstance(source.get("uri"), str):
        scheme, colon, address = source["uri"].partition(":")
        if colon and scheme in FILE_SCHEMES:
            source["uri"] = f"{scheme}:{base / Path(address).expanduser()}"


def _read_camera_file(tree: dict[str, Any]) -> None:
    camera = tree.get("camera")
    if not isinstance(camera, str):
        return
    try:
        tree["camera"] = msgspec.to_builtins(load_camera(Path(camera)))
    except DatasetError as error:
        raise ConfigurationError(str(error)) from error


def _explain(message: str) -> tuple[str, str]:
    """The key and the reason in a message of msgspec."""
    match = re.fullmatch(r"(.*) - at `(?:key in )?\$\.?(.*)`", message, re.DOTALL)
    reason, key = match.groups() if match else (message, "")
    unknown = re.fullmatch(r"Object contains unknown field `(.*)`", reason)
    if unknown:
        return f"{key}.{unknown[1]}".lstrip("."), "there is no such key"
    return key or "configuration", reason


def _origin(key: str, path: Path | None, overridden: Iterable[str]) -> str:
    if path is None or any(key == k or k.startswith(f"{key}.") or key.startswith(f"{k}.") for k in overridden):
        return "command line"
    return str(path)
