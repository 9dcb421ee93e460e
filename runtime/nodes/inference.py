"""Runs the networks concurrently on threads, one run per network at a time, and waits for them until a deadline."""

from __future__ import annotations

import logging
import statistics
import sys
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
from birdslam.perception import Detections, KeptFindings, ModelSpec, Networks, Perception, Ready, load_network
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

# Output of a multi-task network that is not needed if its bodies place the vehicles (pseudolidar.py)
UNREAD_WITH_BODIES = ("depth",)
APART = ("segmentation",)  # outputs of a multi-task network that some runs omit
BOXES = "boxes alone"  # name of the run without them in the timings
MAX_LANE_SLOWDOWN = 2  # lane detection runs at least half as often as scheduled

log = logging.getLogger(__name__)


def source_detections(configuration: Configuration) -> dict[int, Detections] | None:
    """Returns the boxes of the configured file by frame; None if none is configured. Raises DatasetError."""
    source = configuration.source
    return read_detection_file(Path(source.detections).expanduser(), source.detector) if source.detections else None


class Inference(Closing):
    """The configured networks, checked against their manifests and warmed up. A context manager.

    At rate "max" a frame waits for every network, so that runs are reproducible. Otherwise it waits for the networks
    with `ModelSpec.awaited` until its deadline after capture; later results go with a later frame, with their age, and
    so do the lanes. Raises perception.ModelError.
    """

    def __init__(
        self, configuration: Configuration, boxes_only: bool = False, kept: KeptFindings | None = None
    ) -> None:
        """With `boxes_only` only the boxes of road users are computed, bit-identical; `kept` has earlier findings."""
        schedule, looks = configuration.perceive.schedule, configuration.perceive.looks
        specs = {role: schedule.of(role, spec) for role, spec in configuration.models.in_use().items()}
        self._adapts = looks.adaptive and not configuration.lossless
        max_threads = threads_of_a_network(usable_cores()) if self._adapts else None
        pointnet = configuration.models.pointnet
        unread = UNREAD_WITH_BODIES if pointnet is None else ()
        chosen = any(spec.every is not None for spec in specs.values())  # by the user: no adaptation
        boxes = source_detections(configuration)
        if boxes is not None:
            specs.pop("detector", None)
        if boxes_only:
            role = "detector" if "detector" in specs else "multitask"
            specs = {role: specs[role]} if role in specs and boxes is None else {}
        whole = boxes is not None or chosen or bool({"detector", "segmenter"} & specs.keys())
        apart = APART if boxes_only or (self._adapts and not whole) else ()
        specs = self._computed_by(specs, configuration, max_threads)
        heads = [load_network(role, spec, max_threads, unread, apart) for role, spec in specs.items()]
        for head in heads:
            if head.fell_back:
                log.warning("%s runs on the CPU: %s", head.role, head.fell_back)
        self._specs = specs
        self._lanes_every = schedule.lanes.every or 1
        self.frustum_network: PointNet | None = None if pointnet is None else load_pointnet(pointnet)
        self.completion: GridCompletion | None = None  # of lane grids
        finds_road = any("segmenter" in ROLES.get(h.role, (h.role,)) for h in heads) and not boxes_only
        if configuration.models.completion and finds_road:
            self.completion = shipped_completion(configuration.slam.frontend.lanes.shape)
        self._deadline_ns = configuration.deadline_ns
        # Within this share of the budget a mode of degradation can end
        self._budget_ns = round(configuration.budgets.perceived_ms * configuration.degradation.calm_share * 1e6)
        self._after_ns: deque[int] = deque(
            maxlen=looks.window_frames
        )  # from the end of the wait to the end of the frame
        self._resumed_ns: int | None = None
        self._awaited: set[Run] = {head.run for head in heads if head.schedule.awaited}
        many = next((head for head in heads if head.role in ROLES), None)
        self._boxes_alone: Run | None = many.run_without if many is not None and apart else None
        if many is not None and self._boxes_alone is not None and many.schedule.awaited:
            self._awaited.add(self._boxes_alone)
        self._rate_divisor = configuration.degradation.rate_divisor
        self._ran_frame = -self._rate_divisor  # the last frame that networks were offered
        self._started: list[Future[Any]] = []  # awaited runs of the current frame
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
            kept=kept,
        )
        if boxes_only:
            self.networks.masks_every = sys.maxsize

    @staticmethod
    def _computed_by(
        specs: dict[str, ModelSpec], configuration: Configuration, max_threads: int | None
    ) -> dict[str, ModelSpec]:
        """Selects the provider of each network; at rate "max" the CPU, so that runs are reproducible."""
        from birdslam.perception.session import available_providers

        asked, here = configuration.perceive.provider, ("cpu",) if configuration.lossless else available_providers()
        return {role: chosen(role, spec, asked, here, max_threads) for role, spec in specs.items()}

    def _submit(self, run: Run, *arguments: Any) -> Future[Any]:
        if run not in self._awaited and self._deadline_ns is not None:
            return self._behind.submit(run, *arguments)  # at a lower priority: no frame waits for it
        future = self._threads.submit(run, *arguments)
        self._started.append(future)
        return future

    def fit(self, camera: Camera | None, perceive: PerceiveConfig, measured_s: float) -> LookRate | None:
        """Times the networks for `measured_s` and selects their rate and which of them frames wait for.

        Returns None at rate "max", or if the user configured on which frames a network runs.
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
        self.set_rate(rate)
        log.info("%s", rate.describe(costs, {head.role for head in heads if head.run in self._awaited}))
        return rate

    def set_rate(self, rate: LookRate) -> None:
        """Sets how often the networks run."""
        self.networks.slowdown, self.networks.masks_every = rate.sparing, rate.masks_every

    @property
    def run_in_background(self) -> Run | None:
        """Runs a function on a background thread; None at rate "max", where nothing may depend on the clock.

        The function starts after the current frame, so that it does not hold the interpreter's lock while the frame is
        processed. It yields to a new frame where it calls `yield_core`.
        """
        return None if self._deadline_ns is None else self._submit_background

    def yield_core(self) -> None:
        """Waits for the end of the current frame."""
        if self._deadline_ns is not None:
            self._frame_over.wait()

    def _submit_background(self, run: Run, *arguments: Any) -> Future[Any]:
        def run_after_frame() -> Any:
            self.yield_core()
            return run(*arguments)

        return self._beside.submit(run_after_frame)

    def finish_frame(self) -> None:
        """Marks the current frame as sent."""
        self._frame_over.set()
        if self._resumed_ns is not None:
            self._after_ns.append(time.monotonic_ns() - self._resumed_ns)
            self._resumed_ns = None

    @property
    def lane_head(self) -> LaneHead:
        """The lane head, on its schedule; half as often if the networks run at a reduced rate."""
        return LaneHead(
            self.completion,
            self.run_in_background,
            self._lanes_every,
            lambda: min(self.networks.slowdown, MAX_LANE_SLOWDOWN),
            self.yield_core,
        )

    @property
    def roles(self) -> frozenset[str]:
        """Roles of the networks."""
        return frozenset(head.role for head in self.networks.heads)

    def start(self, frame: Frame, mode: Mode = Mode.FULL) -> Pending:
        """Starts the networks that are due on a frame and that the mode allows."""
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
        pending = self.networks.start(frame.frame_id, image, only, t_source_ns=frame.t_source_ns)
        if image is not None:
            self._ran_frame = frame.frame_id
        if mode is Mode.BOXES:
            pending = _BoxesOnly(pending)
        if self._deadline_ns is None:
            return pending
        return _UntilDeadline(pending, self._started, frame.t_capture_ns + self._patience_ns(), self._resume)

    def _patience_ns(self) -> int:
        """Returns how long a frame waits after its capture: its budget less the mean time of the steps that follow.

        Without this limit a slow computer waits until the deadline, is late with every frame, and degrades.
        """
        assert self._deadline_ns is not None
        if not (self._adapts and self._after_ns):
            return self._deadline_ns
        return min(self._deadline_ns, max(0, self._budget_ns - round(statistics.fmean(self._after_ns))))

    def _resume(self) -> None:
        self._resumed_ns = time.monotonic_ns()

    def close(self) -> None:
        """Ends the threads after their current runs."""
        self._frame_over.set()
        self._beside.shutdown(wait=True, cancel_futures=True)
        self._behind.shutdown(wait=True, cancel_futures=True)
        self._threads.shutdown(wait=True, cancel_futures=True)


@dataclass(frozen=True)
class _BoxesOnly:
    """A pending perception without the segmentation, which is too old to be used."""

    pending: Pending

    def result(self) -> Perception:
        perception = self.pending.result()
        ages = {name: age for name, age in perception.ages.items() if name != "segmenter"}
        return replace(perception, segmentation=None, ages=ages)


@dataclass(frozen=True)
class _UntilDeadline:
    """A pending perception that is awaited until a deadline; later results are not used."""

    pending: Pending
    awaited: list[Future[Any]]
    deadline_ns: int  # CLOCK_MONOTONIC
    resumed: Callable[[], None]  # called after the wait

    def result(self) -> Perception:
        wait(self.awaited, timeout=max(0.0, (self.deadline_ns - time.monotonic_ns()) / 1e9))
        self.resumed()
        return self.pending.result()
