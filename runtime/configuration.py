"""The typed configuration of the whole system, with its defaults.

The keys in `runtime/keys.py` are for users; the other fields are constants, which experiments may set too. An unknown
key or a wrong type raises a `ConfigurationError` with the file (or the option) and the key. Paths in a file are
relative to that file.
"""

from __future__ import annotations

import difflib
import hashlib
import re
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from birdslam.geometry.camera import Camera
from birdslam.lanes.amodal.atlas import AtlasConfig
from birdslam.paper import PAPER
from birdslam.perception import ModelError, ModelSpec
from birdslam.runtime.fields import differences, fields, laid_over
from birdslam.runtime.models import store as model_store
from birdslam.runtime.schemes import all_schemes, is_live
from birdslam.runtime.sections import (
    BudgetsConfig,
    DegradationConfig,
    FleetConfig,
    LooksConfig,
    ModelsConfig,
    NodeScheduling,
    PerceiveConfig,
    RealtimeConfig,
    RecordingConfig,
    ResultsConfig,
    RosConfig,
    RouterConfig,
    RuntimeConfig,
    SourceConfig,
    VehicleName,
)
from birdslam.slam import SlamConfig
from birdslam.sources.camera_file import load_camera
from birdslam.sources.recording import DatasetError
from birdslam.sources.schemes import scheme_of

__all__ = [
    "NO_MODEL",
    "BudgetsConfig",
    "Configuration",
    "ConfigurationError",
    "DegradationConfig",
    "FleetConfig",
    "LooksConfig",
    "ModelsConfig",
    "NodeScheduling",
    "PerceiveConfig",
    "RealtimeConfig",
    "RecordingConfig",
    "ResultsConfig",
    "RosConfig",
    "RouterConfig",
    "RuntimeConfig",
    "SourceConfig",
    "complete",
    "dump",
    "load",
    "parse_setting",
    "without_passwords",
]

FILM = "film"  # value of --gnss and --speed: the track inside the film
NO_MODEL = "none"  # value of --model: no shipped network
WATCHDOG_S, LOSSLESS_WATCHDOG_S = 2.0, 60.0  # the latter at rate "max", on slow computers too
_USER = re.compile(r"(?<=://)[^/@]*@")


class ConfigurationError(ValueError):
    """The configuration is invalid; the message names the file or option, the key, and the reason."""


class Configuration(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The whole configuration of a run."""

    vehicle: VehicleName = "car"  # its name on the bus
    source: SourceConfig = SourceConfig()
    camera: Camera | None = None  # None: the recording's own; in a file: a table, or the path of a camera file
    # Of the camera file, where it is pinned
    camera_sha256: Annotated[str, msgspec.Meta(pattern=r"^([0-9a-f]{64})?$")] = ""
    models: ModelsConfig = ModelsConfig()
    perceive: PerceiveConfig = PerceiveConfig()
    method: Literal["birdslam", "paper"] = "birdslam"  # what `load` began `slam` from: the defaults, or birdslam.paper
    slam: SlamConfig = SlamConfig()
    runtime: RuntimeConfig = RuntimeConfig()
    budgets: BudgetsConfig = BudgetsConfig()
    degradation: DegradationConfig = DegradationConfig()
    realtime: RealtimeConfig = RealtimeConfig()
    atlas: AtlasConfig = AtlasConfig()  # what planners may ask for of the drive so far
    recording: RecordingConfig = RecordingConfig()
    results: ResultsConfig = ResultsConfig()  # beside the live ones, when the drive is over
    fleet: FleetConfig = FleetConfig()  # of `birdslam uplink`, and of those who listen to many vehicles
    router: RouterConfig = RouterConfig()  # of `birdslam router` alone
    ros: RosConfig = RosConfig()  # of `birdslam ros`, and of the source `ros:/TOPIC`
    output: str = "out"  # the folder of results

    @property
    def lossless(self) -> bool:
        """Whether every frame is processed, as fast as possible."""
        return self.source.rate == "max"

    def as_lossless(self) -> Configuration:
        """Returns the configuration with rate "max"."""
        return msgspec.structs.replace(self, source=msgspec.structs.replace(self.source, rate="max"))

    @property
    def restarts(self) -> bool:
        """Whether dead nodes are restarted."""
        restart = self.runtime.restart
        return not self.lossless if restart is None else restart == "always"

    @property
    def live(self) -> bool:
        """Whether frames come from a camera, not from a file."""
        return is_live(self.source.uri)

    @property
    def maps_live(self) -> bool:
        """Whether a process localises the drive in its map during the drive; else that is done afterwards."""
        return not self.lossless and bool(self.results.map or self.results.map_only)

    @property
    def spares(self) -> bool:
        """Whether spare processes are kept."""
        return self.runtime.spares and self.restarts

    @property
    def runtime_dir(self) -> Path | None:
        """The directory of sockets and locks; None: the user's default (runtime/transport/presence.py)."""
        return Path(self.runtime.runtime_dir) if self.runtime.runtime_dir else None

    @property
    def watchdog_s(self) -> float:
        """A ready node without a heartbeat for this time is stalled."""
        watchdog_ms = self.runtime.watchdog_ms
        return (LOSSLESS_WATCHDOG_S if self.lossless else WATCHDOG_S) if watchdog_ms is None else watchdog_ms / 1e3

    @property
    def deadline_ns(self) -> int | None:
        """How long a frame waits for networks after its capture; None: without limit, for reproducible runs."""
        deadline_ms = self.perceive.deadline_ms
        return None if self.lossless or deadline_ms is None else round(deadline_ms * 1e6)


def load(
    path: Path | None,
    overrides: Mapping[str, Any] | None = None,
    models: Iterable[str] = (),
) -> Configuration:
    """Loads the configuration of a TOML file with `overrides` ({"source.stride": 2}).

    `models`: names of installed networks, each for the role of its manifest. Raises ConfigurationError.
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
    if tree.get("method") == "paper":
        preset = differences(msgspec.to_builtins(PAPER), msgspec.to_builtins(SlamConfig()))
        tree["slam"] = laid_over(preset, tree.get("slam", {}))
    _read_camera_file(tree)
    _put_models(tree, models)
    try:
        configuration = msgspec.convert(tree, Configuration)
    except msgspec.ValidationError as error:
        key, reason = _explain(str(error))
        raise ConfigurationError(f"{_origin(key, path, overrides)}: {key}: {reason}") from error
    configuration = _with_models_found(configuration)
    key, deadline_ms = "perceive.deadline_ms", configuration.perceive.deadline_ms
    if deadline_ms is not None and deadline_ms > configuration.budgets.perceived_ms:
        limit = "budgets.capture_ms + capture_to_perceive_ms + perceive_ms"
        reason = f"{deadline_ms:g} is over {limit} = {configuration.budgets.perceived_ms:g}"
        raise ConfigurationError(f"{_origin(key, path, overrides)}: {key}: {reason}")
    return configuration


def complete(configuration: Configuration, camera: Camera, rate_hz: float) -> Configuration:
    """Adds the source's camera and the settings that depend on its frame rate: deadline and schedule of networks."""
    rate, perceive = configuration.source.rate, configuration.perceive
    hz = rate if isinstance(rate, float) else rate_hz
    perceive = msgspec.structs.replace(perceive, schedule=perceive.schedule.at(hz), period_ms=1e3 / hz)
    if perceive.deadline_ms is None:
        deadline_ms = min(perceive.deadline_periods * 1e3 / hz, configuration.budgets.perceived_ms)
        perceive = msgspec.structs.replace(perceive, deadline_ms=deadline_ms)
    return msgspec.structs.replace(configuration, camera=camera, perceive=perceive)


def parse_setting(text: str, option: str = "--set") -> tuple[str, Any]:
    """Parses KEY=VALUE of the command line; the value is TOML, or else a plain string."""
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise ConfigurationError(f"{option} {text}: expected KEY=VALUE")
    try:
        return key.strip(), tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return key.strip(), value


def without_passwords(configuration: Configuration) -> Configuration:
    """Removes the password from the camera's address."""
    uri = _USER.sub("", configuration.source.uri)
    scheme = scheme_of(uri, all_schemes())
    if scheme is not None and scheme.address == "network":  # rtsp:NAME:PASSWORD@HOST is valid without slashes
        uri = f"{scheme.name}:{re.sub(r'^[^/@]*@', '', uri.removeprefix(f'{scheme.name}:'))}"
    return msgspec.structs.replace(configuration, source=msgspec.structs.replace(configuration.source, uri=uri))


def dump(configuration: Configuration) -> dict[str, Any]:
    """Returns JSON-compatible data; `msgspec.convert(dump(c), Configuration) == c`."""
    return msgspec.to_builtins(configuration)


def _put(tree: dict[str, Any], key: str, value: Any) -> None:
    *parents, leaf = key.split(".")
    for parent in parents:
        branch = tree.setdefault(parent, {})
        if not isinstance(branch, dict):
            raise ConfigurationError(f"command line: {key}: {parent} is not a table")
        tree = branch
    tree[leaf] = value


def _anchor_paths(tree: dict[str, Any], base: Path) -> None:
    """Makes the paths of a file absolute; values of a wrong type are left to the validation."""

    def anchor(table: Any, *keys: str) -> None:
        for key in keys:
            if isinstance(table, dict) and isinstance(table.get(key), str) and table[key] not in ("", FILM):
                table[key] = str(base / Path(table[key]).expanduser())

    anchor(tree, "camera", "output")
    anchor(tree.get("runtime"), "runtime_dir", "models_dir")
    anchor(tree.get("results"), "video", "map", "map_only")
    results = tree.get("results")
    if isinstance(results, dict) and not str(results.get("gnss", "")).startswith(("topic:", "/dev/")):
        anchor(results, "gnss")
    for name in ("fleet", "router"):
        anchor(tree.get(name), "ca", "certificate", "key")
    models = tree.get("models")
    for spec in models.values() if isinstance(models, dict) else ():
        if isinstance(spec, dict) and not model_store.is_name(str(spec.get("path", ""))):
            anchor(spec, "path")
        if isinstance(spec, dict) and str(spec.get("manifest", "")).endswith(".toml"):  # else the name of a shipped one
            anchor(spec, "manifest")
    anchor(tree.get("source"), "speed", "odometry", "detections")
    source = tree.get("source")
    if isinstance(source, dict) and isinstance(source.get("uri"), str):
        scheme, address = scheme_of(source["uri"], all_schemes()), source["uri"].partition(":")[2]
        if scheme is not None and scheme.address == "path" and address:
            source["uri"] = f"{scheme.name}:{base / Path(address).expanduser()}"


def _put_models(tree: dict[str, Any], names: Iterable[str]) -> None:
    """Adds installed models by name, each for the role of its manifest."""
    runtime = tree.get("runtime")
    models_dir = runtime.get("models_dir") if isinstance(runtime, dict) else None
    for name in names:
        try:
            network = model_store.find(name, models_dir)
            _put(tree, f"models.{model_store.role_of(network)}.path", str(network))
        except ModelError as error:
            raise ConfigurationError(f"--model {name}: {error}") from error


def _with_models_found(configuration: Configuration) -> Configuration:
    """Replaces names of installed models by their files."""
    found: dict[str, ModelSpec] = {}
    models = configuration.models
    for role, spec in (*models.given().items(), *([("pointnet", models.pointnet)] if models.pointnet else [])):
        if model_store.is_name(spec.path) and not Path(spec.path).is_file():
            try:
                network = model_store.find(spec.path, configuration.runtime.models_dir)
            except ModelError as error:
                raise ConfigurationError(f"models.{role}.path: {error}") from error
            found[role] = msgspec.structs.replace(spec, path=str(network))
    return msgspec.structs.replace(configuration, models=msgspec.structs.replace(models, **found))


def _read_camera_file(tree: dict[str, Any]) -> None:
    camera, pinned = tree.get("camera"), tree.get("camera_sha256")
    if not isinstance(camera, str):
        if pinned:
            raise ConfigurationError("camera_sha256: there is no camera file")
        return
    try:
        found = hashlib.sha256(Path(camera).read_bytes()).hexdigest() if pinned else pinned
    except OSError as error:
        raise ConfigurationError(f"{camera}: {error.strerror}") from error
    if found != pinned:
        raise ConfigurationError(f"{camera}: its sha256 is {found}, but camera_sha256 is {pinned}")
    try:
        tree["camera"] = msgspec.to_builtins(load_camera(Path(camera)))
    except DatasetError as error:
        raise ConfigurationError(str(error)) from error


def _explain(message: str) -> tuple[str, str]:
    """Returns the key and the reason in a message of msgspec."""
    match = re.fullmatch(r"(.*) - at `(?:key in )?\$\.?(.*)`", message, re.DOTALL)
    reason, key = match.groups() if match else (message, "")
    unknown = re.fullmatch(r"Object contains unknown field `(.*)`", reason)
    if unknown:
        table = f"{key}.".lstrip(".")
        inside = (field.key.removeprefix(table) for field in fields(Configuration) if field.key.startswith(table))
        near = difflib.get_close_matches(unknown[1], sorted({rest.partition(".")[0] for rest in inside}), 1)
        return f"{table}{unknown[1]}", "no such key" + "".join(f"; the nearest is {table}{n}" for n in near)
    return key or "configuration", reason


def _origin(key: str, path: Path | None, overridden: Iterable[str]) -> str:
    if path is None or any(key == k or k.startswith(f"{key}.") or key.startswith(f"{k}.") for k in overridden):
        return "command line"
    return str(path)
