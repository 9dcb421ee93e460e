"""The tables of the configuration of the runtime; those of the method are beside its code."""

from __future__ import annotations

from typing import Annotated, Literal, get_args

import msgspec

from birdslam.perception import ModelSpec
from birdslam.perception.families import Family
from birdslam.perception.manifest import SHIPPED_MULTITASK, SHIPPED_NETWORKS, Role
from birdslam.perception.network import Provider
from birdslam.ros.bag import BagTopics

VehicleName = Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,31}$")]
ListenerName = Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z0-9_-]{1,64}$")]
PositiveInt = Annotated[int, msgspec.Meta(ge=1)]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]
Share = Annotated[float, msgspec.Meta(gt=0.0, le=1.0)]


class SourceConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The source of frames and its rate."""

    uri: str = ""  # source of frames, see docs/sources.md: video:FILE, v4l2:/dev/videoN, ...
    rate: Positive | Literal["max"] | None = None  # Hz; None: by the source's time stamps; "max": lossless
    stride: PositiveInt = 1  # use every n-th frame of a recording
    # FILE with the car's speed for a recording: lines of time in s, speed in m/s; "film": inside it; "": none
    speed: str = ""
    # FILE with external odometry for a recording, instead of visual odometry: TUM lines or KITTI rows; "": none
    odometry: str = ""
    detections: str = ""  # FILE with external detections for a recording: MOT, KITTI tracking or COCO; "": none
    detector: Family = "unknown"  # family of the external detector, which determines the noise of box edges
    topics: BagTopics = BagTopics()  # of a ROS bag
    frames: PositiveInt | None = None  # maximum number of frames; None: all
    loop: bool = False  # restart a recording at its end
    prefetch_frames: PositiveInt = 4  # frames decoded ahead
    reopen_ms: Positive = 100.0  # between attempts to reopen a camera; each gives a frame without an image
    camera_timeout_s: Positive = 5.0  # a camera or stream without a frame for this time has failed


class ModelsConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The network of each role; a role may have none."""

    detector: ModelSpec | None = None
    segmenter: ModelSpec | None = None
    depth: ModelSpec | None = None
    multitask: ModelSpec | None = None  # one network for all of these roles; the others override it for their roles
    pointnet: ModelSpec | None = None  # Frustum-PointNet: bodies from the depth network's points
    shipped: bool = True  # run the shipped network for roles that no other network has
    # run the multi-task network beside another detector and assign its bodies (depth, length, yaw) to the boxes
    bodies: bool = False
    completion: bool = True  # complete occluded lanes with the shipped ENet

    def given(self) -> dict[str, ModelSpec]:
        """Returns role -> network as configured, in a fixed order."""
        specs = {role: getattr(self, role) for role in get_args(Role)}
        return {role: spec for role, spec in specs.items() if spec is not None}

    def in_use(self) -> dict[str, ModelSpec]:
        """Returns role -> image network that runs, in a fixed order."""
        given = self.given()
        unfilled = not {"detector", "segmenter"} <= set(given)
        if self.shipped and "multitask" not in given and (unfilled or self.bodies):
            given["multitask"] = ModelSpec(path=str(SHIPPED_NETWORKS / SHIPPED_MULTITASK))
        return given


class Turn(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """When a head of perceive runs: on every n-th frame, or at a rate."""

    every: PositiveInt | None = None  # on every n-th frame
    hz: Positive | None = None  # runs per second; excludes `every`

    def __post_init__(self) -> None:
        if self.every is not None and self.hz is not None:
            raise ValueError("every and hz exclude each other")

    def at(self, rate_hz: float) -> Turn:
        """Converts the rate to frames of a source with this frame rate."""
        if self.hz is None:
            return self
        return msgspec.structs.replace(self, every=max(1, round(rate_hz / self.hz)), hz=None)


class NetworkTurn(Turn, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The schedule of an image network; None: as in its manifest."""

    awaited: bool | None = None  # False: frames do not wait for it


class ScheduleConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The schedule of the heads. For a late head the last result is used, with its age and a status."""

    detector: NetworkTurn = NetworkTurn()
    segmenter: NetworkTurn = NetworkTurn()
    depth: NetworkTurn = NetworkTurn()
    multitask: NetworkTurn = NetworkTurn()
    lanes: Turn = Turn(hz=5.0)  # from many frames, with completion; on a background thread

    def of(self, role: str, spec: ModelSpec) -> ModelSpec:
        """Returns the network of a role with this schedule; call `at` before."""
        turn: NetworkTurn = getattr(self, role)
        changes = {key: value for key in ("every", "awaited") if (value := getattr(turn, key)) is not None}
        return msgspec.structs.replace(spec, **changes)

    def at(self, rate_hz: float) -> ScheduleConfig:
        """Converts the rates to frames of a source with this frame rate."""
        return ScheduleConfig(**{head: getattr(self, head).at(rate_hz) for head in self.__struct_fields__})


class LooksConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Adaptive rate of the networks, not at rate "max" (runtime/nodes/look_rate.py)."""

    adaptive: bool = True  # False: as in each network's manifest
    measured_s: Positive = 1.0  # duration of the timing of all networks before the first frame
    least_hz: Positive = 3.0  # minimum rate
    slight_load: Positive = 0.16  # cores: below this load of the networks the rate is not reduced further
    awaited_share: Share = 0.45  # of a frame's period: frames do not wait for slower networks
    room_share: Share = 0.6  # initial load of the networks, as a share of the cores left by the front end
    busy_share: Share = 0.92  # of the period: above this mean step of perceive the rate is reduced
    calm_share: Share = 0.72  # of the period: below this mean step the rate is raised
    window_frames: PositiveInt = 10  # for the mean of the step
    calm_frames: PositiveInt = 60  # consecutive frames before the rate is raised; doubled after a failed attempt
    most_calm_frames: PositiveInt = 2000  # limit of this doubling


class PerceiveConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The perceive process."""

    # how long a frame waits for networks after its capture, at rate "max" without limit; None: by the frame rate
    deadline_ms: Positive | None = None
    # the deadline in periods of the source's frames; the rest of a period is for the steps after the networks
    deadline_periods: Positive = 0.75
    period_ms: Positive | None = None  # between two frames of the source; None: by the frame rate
    opencv_threads: PositiveInt = 1  # of OpenCV in perceive; a second one would take the networks' core
    provider: Provider = "auto"  # execution provider of the networks (runtime/models/providers.py)
    schedule: ScheduleConfig = ScheduleConfig()
    looks: LooksConfig = LooksConfig()


class RuntimeConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Processes, memory and time limits."""

    runtime_dir: str = ""  # sockets, locks and vitals; "": the user's default (runtime/transport/presence.py)
    models_dir: str = ""  # installed networks; "": the user's default (runtime/models/store.py)
    ring_slots: Annotated[int, msgspec.Meta(ge=2, le=64)] = 8  # frames in shared memory
    in_flight_frames: PositiveInt = 4  # frames between capture and the estimate at rate "max"
    ready_timeout_s: Positive = 60.0  # for a node to load, warm up and find its peers
    drain_timeout_s: Positive = 2.0  # for the last frame's estimate to arrive before END_OF_SOURCE is sent
    stop_timeout_s: Positive = 10.0  # for all nodes to end
    beat_s: Positive = 0.1  # maximum interval of a node's heartbeat
    # a ready node without a heartbeat for this time is stalled; None: 2 s, at rate "max" 60 s
    watchdog_ms: Annotated[float, msgspec.Meta(ge=200.0)] | None = None
    term_grace_ms: Positive = 200.0  # between a stalled node's SIGTERM and its SIGKILL
    switch_interval_s: Positive = 5e-4  # of the GIL
    # restart of dead and stalled nodes; None: "always", but "never" at rate "max", which must not lose a frame
    restart: Literal["always", "never"] | None = None
    restarts_max: PositiveInt = 5  # of one node within the window; one more ends the run
    restart_window_s: Positive = 60.0  # window of restarts_max
    restart_backoff_ms: Positive = 100.0  # before the second restart within the window, then doubled each time
    restart_backoff_max_ms: Positive = 2000.0  # limit of this doubling
    checkpoint_ms: Positive = 250.0  # interval of checkpoints of the optimizer's graph
    catch_up_ms: Positive = 300.0  # timeout of a restarted optimizer for the measurements that perceive retains
    stale_ms: Positive = 500.0  # a node without input for this time has the status INPUT_STALE
    spares: bool = True  # keep a loaded spare process of each node for the next restart


class BudgetsConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Latency budgets of each node, each hop and the whole, from a frame's capture on, at a percentile of the frames.

    A node's budget includes the wait in its queue. Raises ValueError if the parts exceed the whole.
    """

    # percentage of frames that must meet each budget
    percentile: Annotated[float, msgspec.Meta(gt=0.0, le=100.0)] = 99.0
    capture_ms: Positive = 10.0  # step of capture
    capture_to_perceive_ms: Positive = 10.0  # hop to perceive
    perceive_ms: Positive = 100.0  # step of perceive, with the wait in its queue
    perceive_to_optimize_ms: Positive = 10.0  # hop to optimize
    optimize_ms: Positive = 10.0  # step of optimize, with the wait in its queue
    optimize_to_planner_ms: Positive = 10.0  # hop to the planner, with the wait in its queue
    end_to_end_ms: Positive = 150.0  # from the frame's capture to the planner

    def __post_init__(self) -> None:
        parts = [name for name in self.__struct_fields__ if name not in ("percentile", "end_to_end_ms")]
        total_ms = sum(getattr(self, name) for name in parts)
        if total_ms > self.end_to_end_ms:
            raise ValueError(f"{' + '.join(parts)} = {total_ms:g} is over end_to_end_ms = {self.end_to_end_ms:g}")

    def step_ms(self, node: str) -> float:
        """Returns the budget of one node per frame, including the wait in its queue."""
        limit_ms: float = getattr(self, f"{node}_ms")
        return limit_ms

    def hop_ms(self, node: str) -> float | None:
        """Returns the budget of the hop to a node; None for capture."""
        hops = {"perceive": self.capture_to_perceive_ms, "optimize": self.perceive_to_optimize_ms}
        return hops.get(node)

    @property
    def perceived_ms(self) -> float:
        """Maximum age at which perceive sends its measurements."""
        return self.capture_ms + self.capture_to_perceive_ms + self.perceive_ms

    @property
    def received_ms(self) -> float:
        """Maximum age at which a frame arrives at perceive."""
        return self.capture_ms + self.capture_to_perceive_ms


class DegradationConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Load shedding of perceive (runtime/nodes/degradation.py)."""

    enabled: bool = True  # no effect at rate "max"
    window_frames: PositiveInt = 10  # window of late_share
    late_share: Share = 0.5  # share of late frames that lowers the mode
    calm_frames: PositiveInt = 50  # consecutive frames within `calm_share` of the budget that raise the mode
    calm_share: Share = 0.7  # of the budget; see calm_frames
    rate_divisor: PositiveInt = 3  # in mode "rate" the networks run at most on every n-th frame
    coast_divisor: PositiveInt = 3  # in mode "coasting" every n-th frame is processed
    coast_max_ms: Positive = 500.0  # source time without measured ego motion until estimates are invalid


class RecordingConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The recording of a drive (runtime/recording/recording.py)."""

    file: str = ""  # FILE.mcap, which must not exist yet; a directory: a new file in it, named by the time; "": none
    images: bool = False  # record the frames as JPEG
    jpeg_quality: Annotated[int, msgspec.Meta(ge=1, le=100)] = 90  # of the frames
    flush_ms: Annotated[float, msgspec.Meta(gt=0.0, le=1000.0)] = 500.0  # interval of writes; a kill loses so much
    sync: bool = True  # sync each write to the disk, for the same guarantee at a power cut
    queue: PositiveInt = 4096  # length of the recorder's queue per topic; dropped messages are counted
    ready_timeout_s: Positive = 10.0  # maximum wait for the recorder before the first frame


class ResultsConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Results in addition to the live ones (runtime/supervision/final_results.py)."""

    smooth: bool = False  # write final trajectories by the RTS smoother: tracks/ID.final.tum.txt, ego.final.*
    video: str = ""  # FILE.mp4: the frames with the estimated boxes beside the bird's-eye view; "": none
    map: str = ""  # FILE: the map to localise in and to extend; "": none
    gnss: str = ""  # FILE: GNSS fixes that georeference the drive and its map; "film": inside it; "": none
    gnss_offset_s: float | None = None  # from the first fix of the file to the first frame; None: by clocks and shapes
    map_only: str = ""  # FILE: the map to localise in without extending it; "": none


class FleetConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The connection of this computer to the router of a fleet, as a vehicle or as a listener."""

    router: str = ""  # tls/HOST:PORT; "": none
    ca: str = ""  # FILE.pem: the fleet's authority
    certificate: str = ""  # FILE.pem: this computer's own
    key: str = ""  # FILE: its private key
    estimates_hz: Positive | None = None  # maximum rate of the sent estimates; None: all
    # expected vehicles of a listener, listed before their first message
    vehicles: tuple[VehicleName, ...] = ()


class RosConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The ROS 2 node of `birdslam ros` and of the source `ros:/TOPIC`."""

    router: str = "tcp/localhost:7447"  # of rmw_zenoh
    domain: Annotated[int, msgspec.Meta(ge=0, le=232)] | None = None  # None: that of ROS_DOMAIN_ID, else 0
    # "" or /NAME: prefix of BirdSLAM's topics and frames, for several cars in one domain
    namespace: str = ""
    release: Literal["humble", "jazzy"] = "jazzy"  # of the other nodes; jazzy: with type hashes, from Iron on


class RouterConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The router of a fleet: permissions and rate limit."""

    listen: str = "tls/127.0.0.1:7448"  # address for vehicles and listeners
    ca: str = ""  # FILE.pem: the fleet's authority
    certificate: str = ""  # FILE.pem: the router's own
    key: str = ""  # FILE: its private key
    vehicles: tuple[VehicleName, ...] = ()  # each may write its own keys, by a certificate named "vehicle NAME"
    # common names of the certificates that may read all vehicles
    listeners: tuple[ListenerName, ...] = ()
    # rate limit of a vehicle's messages per key; the rest is dropped
    messages_hz: Positive = 200.0


class NodeScheduling(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The scheduling of one node."""

    priority: Annotated[int, msgspec.Meta(ge=1, le=98)] = 10  # under SCHED_FIFO
    cpus: tuple[Annotated[int, msgspec.Meta(ge=0)], ...] = ()  # allowed cores; empty: all


class RealtimeConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The scheduling of the nodes, if permitted, else with a warning (process/realtime.py)."""

    # SCHED_FIFO; "auto": all nodes with a live camera, else capture and optimize, and nice -20 for perceive's frames
    fifo: Literal["auto", "on", "off"] = "auto"
    lock_memory: Literal["auto", "on", "off"] = "auto"  # lock memory against paging; "auto": with a live camera
    capture: NodeScheduling = NodeScheduling(priority=30)
    perceive: NodeScheduling = NodeScheduling(priority=10)
    optimize: NodeScheduling = NodeScheduling(priority=20)

    def of(self, node: str) -> NodeScheduling:
        """Returns the scheduling of one node."""
        scheduling: NodeScheduling = getattr(self, node)
        return scheduling
