"""One typed configuration for the whole system: the defaults live here and in the structs it holds.

A TOML file holds differences only. An unknown key or a wrong type is a `ConfigurationError` that names the file (or the
command-line option) and the key. Paths in a file are relative to that file.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import msgspec

from birdslam.atlas import AtlasConfig
from birdslam.camera import Camera
from birdslam.datasets import DatasetError, load_camera
from birdslam.motionwatch import MotionWatchConfig
from birdslam.perception import ModelError, ModelSpec
from birdslam.perception.manifest import SHIPPED_NETWORKS, Role
from birdslam.slam import SlamConfig
from runtime import model_store
from runtime.schedule import ScheduleConfig

NO_MODEL = "none"  # as --model: no network but those that are named beside it, not the shipped one either
_USER = re.compile(r"(?<=://)[^/@]*@|(?<=rtsp:)[^/@]*@")
# Sources that are no cameras; the address of each is a path, relative to the file that names it; `demo` has none
SHIPPED_MULTITASK = "multitask_int8.onnx"  # as good as the fp32 one in half the time; `--model multitask` is that
FILE_SCHEMES = ("kitti", "video", "mcap", "demo")

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
    reopen_ms: Positive = 100.0  # between tries to open a camera that is gone; each is a frame without an image
    camera_timeout_s: Positive = 5.0  # a camera or stream that delivers nothing for so long has failed


class ModelsConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The network of each role; a role without one goes unfilled."""

    detector: ModelSpec | None = None
    segmenter: ModelSpec | None = None
    depth: ModelSpec | None = None
    multitask: ModelSpec | None = None  # one network for all of these; the others stand before it, each for its own
    pointnet: ModelSpec | None = None  # Frustum-PointNet: bodies from the depth network's points
    shipped: bool = True  # the package's own network runs where no other finds vehicles or the road
    completion: bool = True  # the package's own ENet completes the lanes where something hid the road

    def given(self) -> dict[str, ModelSpec]:
        """Role -> network that the user names, in a fixed order."""
        specs = {role: getattr(self, role) for role in get_args(Role)}
        return {role: spec for role, spec in specs.items() if spec is not None}

    def in_use(self) -> dict[str, ModelSpec]:
        """Role -> network of images that runs, in a fixed order."""
        given = self.given()
        if self.shipped and "multitask" not in given and not {"detector", "segmenter"} <= set(given):
            given["multitask"] = ModelSpec(path=str(SHIPPED_NETWORKS / SHIPPED_MULTITASK))
        return given


class PerceiveConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The perceive process."""

    # A frame waits for networks until its deadline, from its capture on; at rate "max" each is awaited to its end.
    deadline_ms: Positive | None = None  # None: by the frame rate
    deadline_periods: Positive = 0.75  # of the source's frames; the rest is for what comes after the networks
    opencv_threads: PositiveInt = 2
    schedule: ScheduleConfig = ScheduleConfig()


class RuntimeConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Processes, memory and time limits."""

    runtime_dir: str = ""  # sockets, locks and vitals; "": the user's own (runtime/presence.py)
    models_dir: str = ""  # installed networks; "": the user's own (runtime/model_store.py)
    ring_slots: Annotated[int, msgspec.Meta(ge=2, le=64)] = 8
    in_flight_frames: PositiveInt = 4  # frames between capture and the estimate at rate "max"
    ready_timeout_s: Positive = 60.0  # for a node to load, warm up and find its peers
    drain_timeout_s: Positive = 2.0  # for the last frame's estimate to come back before the end is announced
    stop_timeout_s: Positive = 10.0  # for all nodes to end
    beat_s: Positive = 0.1  # a node's loop shows life at least so often
    watchdog_ms: Annotated[float, msgspec.Meta(ge=200.0)] = 2000.0  # a ready node without a beat for so long is stalled
    term_grace_ms: Positive = 200.0  # between a stalled node's SIGTERM and its SIGKILL
    switch_interval_s: Positive = 5e-4  # of the GIL, for the threads that wait beside a busy one
    # A node that died or stalled is begun anew; None: "always", but "never" at rate "max", which may lose no frame
    restart: Literal["always", "never"] | None = None
    restarts_max: PositiveInt = 5  # of one node within the window: one more ends the run
    restart_window_s: Positive = 60.0
    restart_backoff_ms: Positive = 100.0  # before the second restart within the window; then twice as long each time
    restart_backoff_max_ms: Positive = 2000.0
    checkpoint_ms: Positive = 250.0  # of the optimizer's graph, for the process after it
    catch_up_ms: Positive = 300.0  # it asks perceive for what it has missed since, and waits no longer
    stale_ms: Positive = 500.0  # a node that has received nothing for so long says so in its health
    spares: bool = True  # a process of each node stands by, loaded and warm, for the next restart


class BudgetsConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How long each node, each hop and the whole may take, from a frame's capture on, at `percentile` of the frames.

    Raises ValueError where the parts exceed the whole.
    """

    percentile: Annotated[float, msgspec.Meta(gt=0.0, le=100.0)] = 99.0
    capture_ms: Positive = 10.0
    capture_to_perceive_ms: Positive = 10.0
    perceive_ms: Positive = 100.0
    perceive_to_optimize_ms: Positive = 10.0
    optimize_ms: Positive = 10.0
    optimize_to_planner_ms: Positive = 10.0
    end_to_end_ms: Positive = 150.0

    def __post_init__(self) -> None:
        parts = [name for name in self.__struct_fields__ if name not in ("percentile", "end_to_end_ms")]
        total_ms = sum(getattr(self, name) for name in parts)
        if total_ms > self.end_to_end_ms:
            raise ValueError(f"{' + '.join(parts)} = {total_ms:g} is over end_to_end_ms = {self.end_to_end_ms:g}")

    def step_ms(self, node: str) -> float:
        """What one node may take for a frame."""
        limit_ms: float = getattr(self, f"{node}_ms")
        return limit_ms

    def hop_ms(self, node: str) -> float | None:
        """What a record may take on its way to a node; None for capture, to which none comes."""
        hops = {"perceive": self.capture_to_perceive_ms, "optimize": self.perceive_to_optimize_ms}
        return hops.get(node)

    @property
    def perceived_ms(self) -> float:
        """The age by which perceive must have sent its measurements."""
        return self.capture_ms + self.capture_to_perceive_ms + self.perceive_ms

    @property
    def received_ms(self) -> float:
        """The age by which a frame must have come to perceive."""
        return self.capture_ms + self.capture_to_perceive_ms


class DegradationConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """When perceive does less, to keep its budget, and when it does more again (runtime/degradation.py)."""

    enabled: bool = True  # never at rate "max"
    window_frames: PositiveInt = 10  # judged together
    late_share: Annotated[float, msgspec.Meta(gt=0.0, le=1.0)] = 0.5  # so many of them late: one mode less
    calm_frames: PositiveInt = 50  # in a row within `calm_share` of the budget: one mode more
    calm_share: Annotated[float, msgspec.Meta(gt=0.0, le=1.0)] = 0.7
    rate_divisor: PositiveInt = 3  # in mode "rate" the networks run on every so-manieth frame at the most
    coast_divisor: PositiveInt = 3  # in mode "coasting" every so-manieth frame is looked at
    coast_max_ms: Positive = 500.0  # of source time without a look: what comes then is invalid


class RecordingConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is kept of a drive in one file (runtime/recording.py)."""

    file: str = ""  # FILE.mcap, which must not exist yet; a directory: a new file in it, named by the time; "": none
    images: bool = False  # the frames too, as JPEG
    jpeg_quality: Annotated[int, msgspec.Meta(ge=1, le=100)] = 90
    flush_ms: Annotated[float, msgspec.Meta(gt=0.0, le=1000.0)] = 500.0  # what a kill may cost
    sync: bool = True  # each time to the disk itself: a power cut then costs no more than a kill
    queue: PositiveInt = 4096  # messages of a topic that wait for the recorder; what is pushed out is counted
    ready_timeout_s: Positive = 10.0  # for the recorder to be there before the first frame; then the run goes on


class NodeScheduling(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Of one node."""

    priority: Annotated[int, msgspec.Meta(ge=1, le=98)] = 10  # under SCHED_FIFO
    cpus: tuple[Annotated[int, msgspec.Meta(ge=0)], ...] = ()  # the cores it may run on; none: all


class RealtimeConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The scheduling of the nodes, where the system permits it (runtime/realtime.py); a line in the log where not."""

    fifo: Literal["auto", "on", "off"] = "auto"  # SCHED_FIFO; "auto": with a live camera
    lock_memory: Literal["auto", "on", "off"] = "auto"  # nothing is paged out; "auto": with a live camera
    capture: NodeScheduling = NodeScheduling(priority=30)
    perceive: NodeScheduling = NodeScheduling(priority=10)
    optimize: NodeScheduling = NodeScheduling(priority=20)

    def of(self, node: str) -> NodeScheduling:
        """The scheduling of one node."""
        scheduling: NodeScheduling = getattr(self, node)
        return scheduling


class Configuration(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """All that a run can be told."""

    vehicle: Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,31}$")] = "car"
    source: SourceConfig = SourceConfig()
    camera: Camera | None = None  # None: the recording's own; in a file: a table, or the path of a camera file
    models: ModelsConfig = ModelsConfig()
    perceive: PerceiveConfig = PerceiveConfig()
    slam: SlamConfig = SlamConfig()
    runtime: RuntimeConfig = RuntimeConfig()
    budgets: BudgetsConfig = BudgetsConfig()
    degradation: DegradationConfig = DegradationConfig()
    motion_watch: MotionWatchConfig = MotionWatchConfig()  # live alone: what is evaluated is what was measured
    realtime: RealtimeConfig = RealtimeConfig()
    atlas: AtlasConfig = AtlasConfig()  # what planners may ask for of the drive so far
    recording: RecordingConfig = RecordingConfig()
    output: str = "out"

    @property
    def lossless(self) -> bool:
        """Every frame is processed, as fast as it can be."""
        return self.source.rate == "max"

    @property
    def restarts(self) -> bool:
        """Whether a node that died is begun anew."""
        restart = self.runtime.restart
        return not self.lossless if restart is None else restart == "always"

    @property
    def live(self) -> bool:
        """Frames come from a camera, not from a file."""
        return self.source.uri.partition(":")[0] not in FILE_SCHEMES

    @property
    def spares(self) -> bool:
        """Whether processes stand by."""
        return self.runtime.spares and self.restarts

    @property
    def runtime_dir(self) -> Path | None:
        """Where sockets and locks go; None: the user's own place (runtime/presence.py)."""
        return Path(self.runtime.runtime_dir) if self.runtime.runtime_dir else None

    @property
    def deadline_ns(self) -> int | None:
        """From a frame's capture on, how long it waits for networks; None: for all of them, so that a run repeats."""
        deadline_ms = self.perceive.deadline_ms
        return None if self.lossless or deadline_ms is None else round(deadline_ms * 1e6)


def load(path: Path | None, overrides: Mapping[str, Any] | None = None, models: Iterable[str] = ()) -> Configuration:
    """The configuration of a TOML file, then `overrides` ({"slam.graph.ego_nodes": 8}) on top of it.

    `models` are names of networks at hand, each for the role that its manifest states. Raises ConfigurationError.
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
    """The configuration with what its source knows: the camera, and what comes of its frame rate.

    That is how long a frame may wait, and on which frames each head runs.
    """
    rate, perceive = configuration.source.rate, configuration.perceive
    hz = rate if isinstance(rate, float) else rate_hz
    perceive = msgspec.structs.replace(perceive, schedule=perceive.schedule.at(hz))
    if perceive.deadline_ms is None:
        deadline_ms = min(perceive.deadline_periods * 1e3 / hz, configuration.budgets.perceived_ms)
        perceive = msgspec.structs.replace(perceive, deadline_ms=deadline_ms)
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


def without_passwords(configuration: Configuration) -> Configuration:
    """With nothing in it that lets anybody in: a camera's address may bear a password."""
    source = configuration.source
    return msgspec.structs.replace(configuration, source=msgspec.structs.replace(source, uri=_USER.sub("", source.uri)))


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
    anchor(tree.get("runtime"), "runtime_dir", "models_dir")
    models = tree.get("models")
    for spec in models.values() if isinstance(models, dict) else ():
        if isinstance(spec, dict) and not model_store.is_name(str(spec.get("path", ""))):
            anchor(spec, "path")
        if isinstance(spec, dict) and str(spec.get("manifest", "")).endswith(".toml"):  # else a shipped one's name
            anchor(spec, "manifest")
    source = tree.get("source")
    if isinstance(source, dict) and isinstance(source.get("uri"), str):
        scheme, _, address = source["uri"].partition(":")
        if address and scheme in FILE_SCHEMES:
            source["uri"] = f"{scheme}:{base / Path(address).expanduser()}"


def _put_models(tree: dict[str, Any], names: Iterable[str]) -> None:
    """Adds models at hand by name, each for the role that its manifest states."""
    runtime = tree.get("runtime")
    models_dir = runtime.get("models_dir") if isinstance(runtime, dict) else None
    for name in names:
        try:
            network = model_store.find(name, models_dir)
            _put(tree, f"models.{model_store.role_of(network)}.path", str(network))
        except ModelError as error:
            raise ConfigurationError(f"--model {name}: {error}") from error


def _with_models_found(configuration: Configuration) -> Configuration:
    """The configuration with the files of models at hand where their names stood."""
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
