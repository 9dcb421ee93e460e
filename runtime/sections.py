"""The tables of the configuration that are the shell's own; those of the method stand beside its code."""

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
    """Where frames come from, and how fast."""

    uri: str = ""  # where frames come from, as docs/sources.md lists: video:FILE, v4l2:/dev/videoN, ...
    rate: Positive | Literal["max"] | None = None  # Hz; None: by the source's own time stamps; "max": lossless
    stride: PositiveInt = 1  # one frame of a recording in so many
    speed: str = ""  # FILE of the car's own speed over a recording: lines of time in s, speed in m/s; "": none
    # FILE of another odometry over a recording, in place of the images': TUM lines or KITTI rows, metric; "": none
    odometry: str = ""
    detections: str = ""  # FILE of another detector's boxes over a recording: MOT, KITTI tracking or COCO; "": none
    detector: Family = "unknown"  # whose boxes these are, which says how sure their edges are
    topics: BagTopics = BagTopics()  # of a ROS bag
    frames: PositiveInt | None = None  # end after so many; None: all
    loop: bool = False  # a recording restarts at its end
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
    # the multi-task network looks beside another detector, whose boxes get the bodies (depth, length, yaw) it finds
    bodies: bool = False
    completion: bool = True  # the package's own ENet completes the lanes where something hid the road

    def given(self) -> dict[str, ModelSpec]:
        """Role -> network that the user names, in a fixed order."""
        specs = {role: getattr(self, role) for role in get_args(Role)}
        return {role: spec for role, spec in specs.items() if spec is not None}

    def in_use(self) -> dict[str, ModelSpec]:
        """Role -> network of images that runs, in a fixed order."""
        given = self.given()
        unfilled = not {"detector", "segmenter"} <= set(given)
        if self.shipped and "multitask" not in given and (unfilled or self.bodies):
            given["multitask"] = ModelSpec(path=str(SHIPPED_NETWORKS / SHIPPED_MULTITASK))
        return given


class Turn(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """When a head of perceive runs: on each n-th frame, or at a rate that the source's frame rate makes n."""

    every: PositiveInt | None = None  # on each n-th frame
    hz: Positive | None = None  # runs a second; not beside `every`

    def __post_init__(self) -> None:
        if self.every is not None and self.hz is not None:
            raise ValueError("every and hz say the same: one of them")

    def at(self, rate_hz: float) -> Turn:
        """In frames of a source of that rate."""
        if self.hz is None:
            return self
        return msgspec.structs.replace(self, every=max(1, round(rate_hz / self.hz)), hz=None)


class NetworkTurn(Turn, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Of a network of images. What is None is its manifest's to say."""

    awaited: bool | None = None  # False: no frame waits for it, not even up to its deadline


class ScheduleConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Which head runs when. A head that is late is skipped and its last result carried, with its age and a status."""

    detector: NetworkTurn = NetworkTurn()
    segmenter: NetworkTurn = NetworkTurn()
    depth: NetworkTurn = NetworkTurn()
    multitask: NetworkTurn = NetworkTurn()
    lanes: Turn = Turn(hz=5.0)  # made out of many frames, their completion with it; on a thread that nobody awaits

    def of(self, role: str, spec: ModelSpec) -> ModelSpec:
        """The network of a role as this schedule has it run; `at` comes before."""
        turn: NetworkTurn = getattr(self, role)
        said = {key: value for key in ("every", "awaited") if (value := getattr(turn, key)) is not None}
        return msgspec.structs.replace(spec, **said)

    def at(self, rate_hz: float) -> ScheduleConfig:
        """In frames of a source of that rate."""
        return ScheduleConfig(**{head: getattr(self, head).at(rate_hz) for head in self.__struct_fields__})


class LooksConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How often networks look where the user does not say it; never at rate "max" (runtime/nodes/look_rate.py)."""

    adaptive: bool = True  # False: as each network's manifest says, whatever the computer
    measured_s: Positive = 1.0  # all networks together are measured for so long before the first frame
    least_hz: Positive = 3.0  # not fewer looks a second than this
    # Cores: networks that keep no more busy look no less often. Less than pays by itself, since each look also has its
    # vehicles placed and tracked; on the shipped drive with two slow cores, where every 3rd frame was too often
    slight_load: Positive = 0.16
    awaited_share: Share = 0.45  # of a frame's period: a network that takes longer is not awaited
    room_share: Share = 0.6  # of the cores that the front end leaves, the networks begin with so much
    busy_share: Share = 0.92  # of the period: perceive's mean step takes longer, and the networks look less often
    calm_share: Share = 0.72  # ... and they look more often where it takes less
    window_frames: PositiveInt = 10  # over which the step's mean is taken
    calm_frames: PositiveInt = 60  # in a row, before they look more often; twice as many after a try that failed
    most_calm_frames: PositiveInt = 2000  # but no more than this


class PerceiveConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The perceive process."""

    # From its capture on a frame waits so long for networks, at rate "max" to their end; None: by the frame rate
    deadline_ms: Positive | None = None
    # The same in periods of the source's frames: the rest of a period is for what comes after the networks
    deadline_periods: Positive = 0.75
    period_ms: Positive | None = None  # from one frame of the source to the next; None: by the frame rate
    opencv_threads: PositiveInt = 1  # of OpenCV in perceive: a second one spins, and takes the networks' core
    provider: Provider = "auto"  # what computes the networks (runtime/models/providers.py)
    schedule: ScheduleConfig = ScheduleConfig()
    looks: LooksConfig = LooksConfig()


class RuntimeConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Processes, memory and time limits."""

    runtime_dir: str = ""  # sockets, locks and vitals; "": the user's own (runtime/transport/presence.py)
    models_dir: str = ""  # installed networks; "": the user's own (runtime/models/store.py)
    ring_slots: Annotated[int, msgspec.Meta(ge=2, le=64)] = 8  # frames in shared memory
    in_flight_frames: PositiveInt = 4  # frames between capture and the estimate at rate "max"
    ready_timeout_s: Positive = 60.0  # for a node to load, warm up and find its peers
    drain_timeout_s: Positive = 2.0  # for the last frame's estimate to come back before the end is announced
    stop_timeout_s: Positive = 10.0  # for all nodes to end
    beat_s: Positive = 0.1  # a node's loop shows life at least so often
    # A ready node without a beat for so long is stalled; None: 2 s, at rate "max", where nobody waits for it, a minute
    watchdog_ms: Annotated[float, msgspec.Meta(ge=200.0)] | None = None
    term_grace_ms: Positive = 200.0  # between a stalled node's SIGTERM and its SIGKILL
    switch_interval_s: Positive = 5e-4  # of the GIL, for the threads that wait beside a busy one
    # A node that died or stalled is restarted; None: "always", but "never" at rate "max", which may lose no frame
    restart: Literal["always", "never"] | None = None
    restarts_max: PositiveInt = 5  # of one node within the window: one more ends the run
    restart_window_s: Positive = 60.0  # in which they count
    restart_backoff_ms: Positive = 100.0  # before the second restart within the window; then twice as long each time
    restart_backoff_max_ms: Positive = 2000.0  # at most
    checkpoint_ms: Positive = 250.0  # of the optimizer's graph, for the process after it
    catch_up_ms: Positive = 300.0  # it asks perceive for what it has missed since, and waits no longer
    stale_ms: Positive = 500.0  # a node that has received nothing for so long says so in its health
    spares: bool = True  # a process of each node stands by, loaded and warm, for the next restart


class BudgetsConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How long each node, each hop and the whole may take, from a frame's capture on, at `percentile` of the frames.

    What waits in a node's queue waits because that node is at another record: the node's budget holds both together.
    Raises ValueError where the parts exceed the whole.
    """

    # of the frames must keep each limit, in percent
    percentile: Annotated[float, msgspec.Meta(gt=0.0, le=100.0)] = 99.0
    capture_ms: Positive = 10.0  # capture's step
    capture_to_perceive_ms: Positive = 10.0  # the hop, until the frame has arrived there
    perceive_ms: Positive = 100.0  # perceive's step, with the frame's wait in its queue
    perceive_to_optimize_ms: Positive = 10.0  # the hop, until the measurements have arrived there
    optimize_ms: Positive = 10.0  # optimize's step, with the measurements' wait in its queue
    optimize_to_planner_ms: Positive = 10.0  # the hop, with its wait in a queue
    end_to_end_ms: Positive = 150.0  # the whole, from the frame's capture to the planner

    def __post_init__(self) -> None:
        parts = [name for name in self.__struct_fields__ if name not in ("percentile", "end_to_end_ms")]
        total_ms = sum(getattr(self, name) for name in parts)
        if total_ms > self.end_to_end_ms:
            raise ValueError(f"{' + '.join(parts)} = {total_ms:g} is over end_to_end_ms = {self.end_to_end_ms:g}")

    def step_ms(self, node: str) -> float:
        """What one node may take for a frame, its wait in the queue included."""
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
    """When perceive does less, to keep its budget, and when it does more again (runtime/nodes/degradation.py)."""

    enabled: bool = True  # never at rate "max"
    window_frames: PositiveInt = 10  # judged together
    late_share: Share = 0.5  # so many of them late: one mode less
    calm_frames: PositiveInt = 50  # in a row within `calm_share` of the budget: one mode more
    calm_share: Share = 0.7  # of the budget; see calm_frames
    rate_divisor: PositiveInt = 3  # in mode "rate" the networks run on one frame in so many at the most
    coast_divisor: PositiveInt = 3  # in mode "coasting" one frame in so many is looked at
    coast_max_ms: Positive = 500.0  # of source time without a look: what comes then is invalid


class RecordingConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is kept of a drive in one file (runtime/recording/recording.py)."""

    file: str = ""  # FILE.mcap, which must not exist yet; a directory: a new file in it, named by the time; "": none
    images: bool = False  # the frames too, as JPEG
    jpeg_quality: Annotated[int, msgspec.Meta(ge=1, le=100)] = 90  # of the frames
    flush_ms: Annotated[float, msgspec.Meta(gt=0.0, le=1000.0)] = 500.0  # what a kill may cost
    sync: bool = True  # each time to the disk itself: a power cut then costs no more than a kill
    queue: PositiveInt = 4096  # messages of a topic that wait for the recorder; what is pushed out is counted
    ready_timeout_s: Positive = 10.0  # for the recorder to be there before the first frame; then the run goes on


class ResultsConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is made of a drive when it is over, beside the live results (runtime/supervision/final_results.py)."""

    smooth: bool = False  # final trajectories too, by the RTS smoother: tracks/ID.final.tum.txt, ego.final.*
    video: str = ""  # FILE.mp4: the frames with the estimated boxes beside the bird's-eye view; "": none
    map: str = ""  # FILE: the map of places, localised in and made longer; "": none
    gnss: str = ""  # FILE: fixes, by which the drive and its map come to Earth; "": none
    gnss_offset_s: float | None = None  # from the file's first fix to the first frame; None: by their clocks and shapes
    map_only: str = ""  # FILE: localised in it, and it stays as it is; "": none


class FleetConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How this computer reaches the router of a fleet: as a vehicle that publishes, or as a listener to all of them."""

    router: str = ""  # tls/HOST:PORT; "": there is none
    ca: str = ""  # FILE.pem: the fleet's authority
    certificate: str = ""  # FILE.pem: this computer's own
    key: str = ""  # FILE: its private key
    estimates_hz: Positive | None = None  # of the vehicle's estimates at most so many a second are sent; None: all
    # The vehicles that a listener expects: it lists them even before they have published anything
    vehicles: tuple[VehicleName, ...] = ()


class RosConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How this computer is a node of ROS 2: of `birdslam ros`, and of the source `ros:/TOPIC`."""

    router: str = "tcp/localhost:7447"  # of rmw_zenoh
    domain: Annotated[int, msgspec.Meta(ge=0, le=232)] | None = None  # None: that of ROS_DOMAIN_ID, else 0
    # "" or /NAME: before the names of our own topics, and of our frames, where several cars are in one domain
    namespace: str = ""
    release: Literal["humble", "jazzy"] = "jazzy"  # of the others; jazzy: since Iron types have hashes


class RouterConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The router of a fleet: who may publish, who may listen, and how much of it passes."""

    listen: str = "tls/127.0.0.1:7448"  # where vehicles and listeners connect to
    ca: str = ""  # FILE.pem: the fleet's authority
    certificate: str = ""  # FILE.pem: the router's own
    key: str = ""  # FILE: its private key
    vehicles: tuple[VehicleName, ...] = ()  # each may write its own keys, by a certificate named "vehicle NAME"
    # The common names of the certificates that may read all vehicles, and write nothing
    listeners: tuple[ListenerName, ...] = ()
    # Of a vehicle's messages on one key so many a second pass, the rest is dropped: a flood meets it alone
    messages_hz: Positive = 200.0


class NodeScheduling(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Of one node."""

    priority: Annotated[int, msgspec.Meta(ge=1, le=98)] = 10  # under SCHED_FIFO
    cpus: tuple[Annotated[int, msgspec.Meta(ge=0)], ...] = ()  # the cores it may run on; none: all


class RealtimeConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The scheduling of the nodes, where the system permits it (process/realtime.py); a line in the log where not."""

    # SCHED_FIFO; "auto": all nodes with a live camera, else capture and optimize; of perceive the frames go by nice -20
    fifo: Literal["auto", "on", "off"] = "auto"
    lock_memory: Literal["auto", "on", "off"] = "auto"  # nothing is paged out; "auto": with a live camera
    capture: NodeScheduling = NodeScheduling(priority=30)
    perceive: NodeScheduling = NodeScheduling(priority=10)
    optimize: NodeScheduling = NodeScheduling(priority=20)

    def of(self, node: str) -> NodeScheduling:
        """The scheduling of one node."""
        scheduling: NodeScheduling = getattr(self, node)
        return scheduling
