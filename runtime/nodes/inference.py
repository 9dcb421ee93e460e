"""The networks on threads of their own: side by side, never two runs of one at once, and awaited to a deadline."""

from __future__ import annotations

import logging
import statistics
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from birdslam.frontend import Pending
from birdslam.geometry.camera import Camera
from birdslam.lanes.amodal.lane_mapper import LaneHead
from birdslam.perception import Detections, ModelSpec, Networks, Perception, Ready, load_network
from birdslam.perception.completion import GridCompletion, shipped_completion
from birdslam.perception.manifest import Role
from birdslam.perception.pointnet import PointNet, load_pointnet
from birdslam.perception.schedule import ROLES
from birdslam.runtime.configuration import Configuration, PerceiveConfig
from birdslam.runtime.models.providers import chosen
from birdslam.runtime.nodes.degradation import Mode
from birdslam.runtime.nodes.look_rate import Cost, LookRate, measure, threads_of_a_network
from birdslam.runtime.process import realtime
from birdslam.runtime.process.cores import usable_cores
from birdslam.runtime.transport.closing import Closing
from birdslam.sources.detection_file import read_detection_file
from birdslam.types import Frame

Run = Callable[..., Any]

# Of a multi-task network: vehicles that come with bodies are placed by these, and no map is asked (pseudolidar.py)
UNREAD_WITH_BODIES = ("depth",)
APART = ("segmentation",)  # of a multi-task network, what not every look needs
BOXES = "boxes alone"  # such a look, among what is measured
LANES_SPARING = 2  # lanes are found half as often at the least: a run takes the interpreter 20 ms from the frames

log = logging.getLogger(__name__)


def source_detections(configuration: Configuration) -> dict[int, Detections] | None:
    """Frame -> another detector's boxes of the file that is configured; None: there is none. Raises DatasetError."""
    source = configuration.source
    return read_detection_file(Path(source.detections).expanduser(), source.detector) if source.detections else None


class Inference(Closing):
    """The configured networks, checked against their manifests and warm. A context manager.

    At rate "max" every network is awaited, so that a run can be repeated. Else a frame waits for those that are worth
    it (`ModelSpec.awaited`) until its deadline, which counts from its capture: a frame that comes late waits less, and
    the delay does not grow. What is not there by then is carried, with its age. Nor does a frame wait for the lanes
    then, which come with a later one. Raises perception.ModelError.
    """

    def __init__(self, configuration: Configuration) -> None:
        schedule, looks = configuration.perceive.schedule, configuration.perceive.looks
        specs = {role: schedule.of(role, spec) for role, spec in configuration.models.in_use().items()}
        self._adapts = looks.adaptive and not configuration.lossless
        most_threads = threads_of_a_network(usable_cores()) if self._adapts else None
        pointnet = configuration.models.pointnet
        unread = UNREAD_WITH_BODIES if pointnet is None else ()
        chosen = any(spec.every is not None for spec in specs.values())  # by the user: nothing is to be adapted
        boxes = source_detections(configuration)
        if boxes is not None:
            specs.pop("detector", None)
        whole = boxes is not None or chosen or bool({"detector", "segmenter"} & specs.keys())
        apart = APART if self._adapts and not whole else ()
        specs = self._computed_by(specs, configuration, most_threads)
        heads = [load_network(role, spec, most_threads, unread, apart) for role, spec in specs.items()]
        for head in heads:
            if head.fell_back:
                log.warning("%s runs on the CPU: %s", head.role, head.fell_back)
        self._specs = specs
        self._lanes_every = schedule.lanes.every or 1
        self.frustum_network: PointNet | None = None if pointnet is None else load_pointnet(pointnet)
        self.completion: GridCompletion | None = None  # of lane grids, where there are lanes to see
        if configuration.models.completion and any("segmenter" in ROLES.get(h.role, (h.role,)) for h in heads):
            self.completion = shipped_completion(configuration.slam.frontend.lanes.shape)
        self._deadline_ns = configuration.deadline_ns
        # What a frame has of its budget, with as much left over as lets a mode of degradation end
        self._budget_ns = round(configuration.budgets.perceived_ms * configuration.degradation.calm_share * 1e6)
        self._after_ns: deque[int] = deque(maxlen=looks.window_frames)  # what frames took when they had waited
        self._resumed_ns: int | None = None
        self._awaited: set[Run] = {head.run for head in heads if head.schedule.awaited}
        many = next((head for head in heads if head.role in ROLES), None)
        self._boxes_alone: Run | None = many.run_without if many is not None and apart else None
        if many is not None and self._boxes_alone is not None and many.schedule.awaited:
            self._awaited.add(self._boxes_alone)
        self._rate_divisor = configuration.degradation.rate_divisor
        self._ran_frame = -self._rate_divisor  # the last frame that networks were offered
        self._started: list[Future[Any]] = []  # for the frame at hand, and awaited
        self._threads = ThreadPoolExecutor(max(1, len(heads)), "network", initializer=realtime.below_frames)
        self._behind = ThreadPoolExecutor(max(1, len(heads)), "network-behind", initializer=realtime.lower_priority)
        self._beside = ThreadPoolExecutor(1, "beside", initializer=realtime.as_frames)
        self._frame_over = threading.Event()
        patience_s = None if self._deadline_ns is None else 0.0
        self.networks = Networks(
            heads,
            self._submit,
            patience_s,
            bodies=configuration.models.bodies,
            boxes_alone=self._boxes_alone,
            detections=boxes,
        )

    @staticmethod
    def _computed_by(
        specs: dict[str, ModelSpec], configuration: Configuration, most_threads: int | None
    ) -> dict[str, ModelSpec]:
        """Each network with what computes it. At rate "max" nothing is measured, so that a run repeats."""
        from birdslam.perception.session import providers_here

        asked, here = configuration.perceive.provider, ("cpu",) if configuration.lossless else providers_here()
        return {role: chosen(role, spec, asked, here, most_threads) for role, spec in specs.items()}

    def _submit(self, run: Run, *arguments: Any) -> Future[Any]:
        if run not in self._awaited and self._deadline_ns is not None:
            return self._behind.submit(run, *arguments)  # no frame waits for it: frames go first
        future = self._threads.submit(run, *arguments)
        self._started.append(future)
        return future

    def fit(self, camera: Camera | None, perceive: PerceiveConfig, measured_s: float) -> LookRate | None:
        """Measures the networks for `measured_s` and chooses for this computer how often they look, and who is awaited.

        None where nothing is to be chosen: at rate "max", or where the user has said on which frames a network runs.
        """
        heads, period_ms = self.networks.heads, perceive.period_ms
        if not (self._adapts and heads) or any(self._specs[head.role].every is not None for head in heads):
            return None
        if camera is None or period_ms is None:  # the frames are not known yet
            return None
        runs: dict[str, Run] = {head.role: head.run for head in heads}
        if self._boxes_alone is not None:
            runs[BOXES] = self._boxes_alone
        took_ms = measure(runs, camera, measured_s)
        costs: dict[str, Cost] = {
            h.role: Cost(
                took_ms[h.role], h.schedule.threads, h.schedule.every, took_ms.get(BOXES) if h.role in ROLES else None
            )
            for h in heads
        }
        for head in heads:
            if self._specs[head.role].awaited is None and took_ms[head.role] > perceive.looks.awaited_share * period_ms:
                self._awaited -= {head.run, *((self._boxes_alone,) if head.role in ROLES and self._boxes_alone else ())}
        rate = LookRate(perceive.looks, costs, usable_cores(), period_ms)
        self.look_as(rate)
        log.info("%s", rate.describe(costs, {head.role for head in heads if head.run in self._awaited}))
        return rate

    def look_as(self, rate: LookRate) -> None:
        """From now on the networks look as often as this says."""
        self.networks.slowdown, self.networks.masks_every = rate.sparing, rate.masks_every

    @property
    def aside(self) -> Run | None:
        """Runs a function on a thread of its own; None at rate "max", where nothing may depend on the clock.

        It begins when the frame at hand is over: it would take the interpreter's lock from what goes out. A frame that
        comes meanwhile it lets pass, where it calls `yield_core`.
        """
        return None if self._deadline_ns is None else self._run_aside

    def yield_core(self) -> None:
        """Waits for the end of the frame at hand, if there is one."""
        if self._deadline_ns is not None:
            self._frame_over.wait()

    def _run_aside(self, run: Run, *arguments: Any) -> Future[Any]:
        def when_over() -> Any:
            self.yield_core()
            return run(*arguments)

        return self._beside.submit(when_over)

    def over(self) -> None:
        """What the frame at hand gave is sent."""
        self._frame_over.set()
        if self._resumed_ns is not None:
            self._after_ns.append(time.monotonic_ns() - self._resumed_ns)
            self._resumed_ns = None

    @property
    def lane_head(self) -> LaneHead:
        """Lanes, on their schedule; half as often where the networks look less often than on theirs."""
        return LaneHead(
            self.completion,
            self.aside,
            self._lanes_every,
            lambda: min(self.networks.slowdown, LANES_SPARING),
            self.yield_core,
        )

    @property
    def roles(self) -> frozenset[str]:
        """Those that a network fills."""
        return frozenset(head.role for head in self.networks.heads)

    def start(self, frame: Frame, mode: Mode = Mode.FULL) -> Pending:
        """Starts the networks that are due on a frame, and that the mode allows."""
        self._started = []
        self._frame_over.clear()
        if mode in (Mode.ODOMETRY, Mode.COASTING):
            return Ready(Perception())
        image = frame.image
        only: tuple[Role, ...] | None = None
        if mode is Mode.RATE and frame.frame_id - self._ran_frame < self._rate_divisor:
            image = None
        elif mode is Mode.BOXES:
            only = ("detector",)
        pending = self.networks.start(frame.frame_id, image, only)
        if image is not None:
            self._ran_frame = frame.frame_id
        if mode is Mode.BOXES:
            pending = _BoxesOnly(pending)
        if self._deadline_ns is None:
            return pending
        return _UntilDeadline(pending, self._started, frame.t_capture_ns + self._patience_ns(), self._resume)

    def _patience_ns(self) -> int:
        """From its capture on, how long a frame waits: no longer than what comes after leaves of its budget.

        A slow computer would wait for networks to the deadline, be late with each frame for it, and leave networks out.
        """
        assert self._deadline_ns is not None
        if not (self._adapts and self._after_ns):
            return self._deadline_ns
        return min(self._deadline_ns, max(0, self._budget_ns - round(statistics.fmean(self._after_ns))))

    def _resume(self) -> None:
        self._resumed_ns = time.monotonic_ns()

    def close(self) -> None:
        """Ends the threads, after the runs at hand."""
        self._frame_over.set()
        self._beside.shutdown(wait=True, cancel_futures=True)
        self._behind.shutdown(wait=True, cancel_futures=True)
        self._threads.shutdown(wait=True, cancel_futures=True)


@dataclass(frozen=True)
class _BoxesOnly:
    """A pending perception whose road and lanes are too old to be used."""

    pending: Pending

    def result(self) -> Perception:
        perception = self.pending.result()
        ages = {name: age for name, age in perception.ages.items() if name != "segmenter"}
        return replace(perception, segmentation=None, ages=ages)


@dataclass(frozen=True)
class _UntilDeadline:
    """A pending perception that is awaited until a deadline; what is ready then is used."""

    pending: Pending
    awaited: list[Future[Any]]
    deadline_ns: int  # CLOCK_MONOTONIC
    resumed: Callable[[], None]  # called when the wait is over

    def result(self) -> Perception:
        wait(self.awaited, timeout=max(0.0, (self.deadline_ns - time.monotonic_ns()) / 1e9))
        self.resumed()
        return self.pending.result()
