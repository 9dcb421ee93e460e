"""Schedule of the networks: which one runs on which frame, and which results a frame gets."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, wait
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from birdslam.perception.decoding.depth import DepthMap
from birdslam.perception.decoding.detection import Detections, with_bodies
from birdslam.perception.decoding.multitask import Findings
from birdslam.perception.decoding.segmentation import Segmentation
from birdslam.perception.kept_findings import KeptFindings
from birdslam.perception.manifest import Role, Schedule
from birdslam.types import Frame, Status

CARRIED: dict[Role, Status] = {
    "detector": Status.DETECTIONS_CARRIED,
    "segmenter": Status.SEGMENTATION_CARRIED,
    "depth": Status.DEPTH_CARRIED,
}
FIELDS: dict[Role, str] = {"detector": "detections", "segmenter": "segmentation", "depth": "depth"}  # of `Perception`
ROLES_BESIDE_BOXES: tuple[Role, ...] = ("segmenter", "depth")  # that networks keep beside an external detector
ROLES: dict[Role, tuple[Role, ...]] = {"multitask": ("detector", "segmenter", "depth")}  # others have only their own
NO_DETECTIONS = Detections(np.zeros((0, 4)), np.zeros(0), ())


@dataclass(frozen=True)
class Perception:
    """The latest results of the networks at one frame.

    `ages` maps a head's name to the age of its result in frames; a head without a result is absent. A head with several
    roles has an entry for each role, not for its name. A result of an earlier frame has its status in `status`.
    `awaited_from`: the detections of all earlier frames are complete.
    """

    detections: Detections | None = None
    segmentation: Segmentation | None = None
    ages: dict[str, int] = field(default_factory=dict)
    status: tuple[Status, ...] = ()
    depth: DepthMap | None = None
    awaited_from: int = 0


class Pending(Protocol):
    """A perception that may still be running."""

    def result(self) -> Perception: ...


@dataclass(frozen=True)
class Ready:
    """A finished perception."""

    perception: Perception

    def result(self) -> Perception:
        return self.perception


@dataclass(frozen=True)
class WithDetections:
    """A pending perception whose boxes come from an external detector, computed on the frame itself.

    Without `depth` no depth map is used: the depth map of a multi-task network belongs to its own detector.
    """

    pending: Pending
    detections: Detections
    frame_id: int
    depth: bool

    def result(self) -> Perception:
        perception = self.pending.result()
        status = tuple(each for each in perception.status if each is not CARRIED["detector"])
        found = replace(perception, detections=self.detections, status=status, awaited_from=self.frame_id + 1)
        if self.depth:
            return replace(found, ages=perception.ages | {"detector": 0})
        ages = {name: age for name, age in perception.ages.items() if name != "depth"}
        return replace(found, depth=None, ages=ages | {"detector": 0})


@dataclass(frozen=True)
class Followed:
    """A pending perception; calls `then` as soon as its result is taken."""

    pending: Pending
    then: Callable[[], None]

    def result(self) -> Perception:
        perception = self.pending.result()
        self.then()
        return perception


class Head(Protocol):
    """The part of `Network` that `Networks` uses."""

    @property
    def name(self) -> str: ...
    @property
    def role(self) -> Role: ...
    @property
    def schedule(self) -> Schedule: ...
    @property
    def fell_back(self) -> str: ...
    def run(self, image: NDArray[np.uint8]) -> Findings | None: ...


@dataclass
class _Slot:
    """The current run of one head and its last results."""

    head: Head
    fills: tuple[Role, ...]  # the roles that its findings are used for
    running: Future[Findings | None] | None = None
    started_frame: int | None = None
    masks: bool = True  # the last run started includes masks
    without_masks: int = 0  # runs since the last one that included them
    outdated: bool = False  # the current run belongs to frames before a restart of the source
    findings: Findings = field(default_factory=Findings)
    found: dict[Role, int] = field(default_factory=dict)  # the frame that each result was computed on

    def begin(self, frame_id: int, masks: bool) -> None:
        """Records the start of a run on this frame."""
        self.started_frame, self.masks = frame_id, masks
        self.without_masks = 0 if masks else self.without_masks + 1

    def take(self, findings: Findings) -> None:
        """Stores the result of the last run."""
        assert self.started_frame is not None
        roles = ROLES.get(self.head.role, (self.head.role,))
        if not self.masks:
            findings = replace(findings, segmentation=self.findings.segmentation)
            roles = tuple(role for role in roles if role != "segmenter")
        self.findings = findings
        self.found |= dict.fromkeys(roles, self.started_frame)

    def ages(self, frame_id: int) -> dict[str, int]:
        """As in `Perception.ages`."""
        names = {role: role if self.head.role in ROLES else self.head.name for role in self.fills}
        return {names[role]: frame_id - self.found[role] for role in self.fills if role in self.found}


class Networks:
    """Starts each head on the frames where it is due and carries its last result in between.

    A head is due `every` * `slowdown` frames after its last start, unless it is still running. `slowdown` may be set
    between two frames. A multi-task head yields each role that another head has; with `bodies` its 3-D boxes still
    complete the other detector's boxes of the same image (`decoding.detection.with_bodies`). `boxes_alone` runs such a
    head without its masks; one run in `masks_every` includes them. `submit(run, image) -> Future` belongs to an
    executor with a thread per head. A head does not run on an image whose findings are `kept`. With `patience_s` None
    every running head is awaited, so the results depend only on the frames. Otherwise `result()` waits at most that
    long for the `awaited` heads that started on its frame; all other heads continue in the background and their last
    results are carried.
    """

    def __init__(
        self,
        heads: Sequence[Head],
        submit: Callable[..., Future[Any]],
        patience_s: float | None = None,
        bodies: bool = False,
        boxes_alone: Callable[[NDArray[np.uint8]], Findings | None] | None = None,
        detections: Mapping[int, Detections] | None = None,
        kept: KeptFindings | None = None,
    ) -> None:
        for key in ("name", "role"):
            values = [getattr(head, key) for head in heads]
            if len(set(values)) != len(values):
                raise ValueError(f"networks: each {key} must be unique, got {', '.join(values)}")
        if patience_s is not None and not patience_s >= 0.0:
            raise ValueError(f"networks: patience_s must not be negative, got {patience_s}")
        self.heads = tuple(heads)
        self._submit = submit
        self._patience_s = patience_s
        self._bodies = bodies
        self._boxes_alone = boxes_alone
        self._detections = detections
        self._kept = kept
        own = {head.role for head in heads}
        self._slots = [
            _Slot(
                head, tuple(role for role in ROLES.get(head.role, (head.role,)) if role == head.role or role not in own)
            )
            for head in heads
        ]
        self._last_frame = -1
        self.slowdown = self.masks_every = 1
        self.frames_with_start = 0  # frames on which a head was started

    def start(
        self,
        frame_id: int,
        image: NDArray[np.uint8] | None,
        only: Collection[Role] | None = None,
        detections: Detections | None = None,
        t_source_ns: int = 0,
    ) -> Pending:
        """Starts the heads that are due, of the roles in `only` (None: all). `detections` are an external detector's.

        Call `result()` of the returned object once, before the next start. The image must not change while a head may
        read it; None (a frame without pixels) starts nothing. A frame_id that does not grow means that the source
        restarted: earlier results are discarded.
        """
        if frame_id <= self._last_frame:
            self._slots = [_Slot(s.head, s.fills, s.running, outdated=s.running is not None) for s in self._slots]
        self._last_frame = frame_id
        if detections is None and self._detections is not None:
            detections = self._detections.get(frame_id, NO_DETECTIONS)
            if image is not None:
                detections = detections.inside(image.shape[1], image.shape[0])
        if detections is not None:
            only = ROLES_BESIDE_BOXES if only is None else tuple(role for role in only if role in ROLES_BESIDE_BOXES)
        started_any = False
        for slot in self._slots:
            every = slot.head.schedule.every * self.slowdown
            due = slot.started_frame is None or frame_id - slot.started_frame >= every
            feeds = {*slot.fills, *(("detector",) if self._bodies and slot.head.role in ROLES else ())}
            wanted = bool(feeds) and (only is None or not feeds.isdisjoint(only))
            if image is not None and due and wanted and slot.running is None:
                run = self._begin(slot, frame_id)
                if self._kept is not None:
                    run = partial(self._kept.run, slot.head.name, t_source_ns, run)
                slot.running = self._submit(run, image)
                started_any = True
        self.frames_with_start += started_any
        pending = _Started(self, frame_id)
        if detections is None:
            return pending
        return WithDetections(pending, detections, frame_id, depth=any(head.role == "depth" for head in self.heads))

    def in_order(self, frames: Iterable[Frame]) -> Iterator[tuple[Frame, Pending]]:
        """Yields each frame with its perception, and starts the next frame as soon as the result of one is taken.

        The networks then run while the caller processes the frame before. With `patience_s` None the results are those
        of `start` on each frame.
        """
        remaining = iter(frames)
        started: deque[tuple[Frame, Pending]] = deque()

        def start_next() -> None:
            frame = next(remaining, None) if not started else None
            if frame is not None:
                started.append((frame, self.start(frame.frame_id, frame.image, t_source_ns=frame.t_source_ns)))

        start_next()
        while started:
            frame, pending = started.popleft()
            yield frame, Followed(pending, start_next)
            start_next()  # for a frame whose result was not taken

    def _begin(self, slot: _Slot, frame_id: int) -> Callable[[NDArray[np.uint8]], Findings | None]:
        """Records the start of a run of this slot and returns the function to run."""
        boxes = self._boxes_alone if slot.head.role in ROLES and "segmenter" in slot.found else None
        slot.begin(frame_id, masks=boxes is None or slot.without_masks + 1 >= self.masks_every)
        return slot.head.run if slot.masks or boxes is None else boxes

    def _collect(self, frame_id: int) -> Perception:
        self._await(frame_id)
        status = self._take_results(frame_id)
        found = {FIELDS[role]: getattr(s.findings, FIELDS[role]) for s in self._slots for role in s.fills}
        found["detections"] = self._with_bodies(found.get("detections"))
        ages = {name: age for slot in self._slots for name, age in slot.ages(frame_id).items()}
        return Perception(
            **found, ages=ages, status=tuple(dict.fromkeys(status)), awaited_from=self._awaited_from(frame_id)
        )

    def _awaited_from(self, frame_id: int) -> int:
        """The frame of the detector's current run; the next frame if it is idle."""
        under_way = (s.started_frame for s in self._slots if s.running is not None and "detector" in s.fills)
        return min((frame for frame in under_way if frame is not None), default=frame_id + 1)

    def _with_bodies(self, detections: Detections | None) -> Detections | None:
        """The detector's boxes with the bodies that the multi-task head found in the same image."""
        own = next((s for s in self._slots if s.head.role == "detector"), None)
        many = next((s for s in self._slots if s.head.role in ROLES), None)
        if not self._bodies or detections is None or own is None or many is None:
            return detections
        same_image = own.found.get("detector") == many.found.get("detector")
        return with_bodies(detections, many.findings.detections) if same_image else detections

    def _await(self, frame_id: int) -> None:
        """Waits for the heads of this frame, at most `patience_s`."""
        if self._patience_s is None:
            wait([s.running for s in self._slots if s.running is not None])
        else:
            wait(
                [
                    s.running
                    for s in self._slots
                    if s.running is not None and s.started_frame == frame_id and s.head.schedule.awaited
                ],
                timeout=self._patience_s,
            )

    def _take_results(self, frame_id: int) -> list[Status]:
        """Stores the finished results; returns a status for each that failed or is carried."""
        status = [Status.PROVIDER_MISSING] if any(slot.head.fell_back for slot in self._slots) else []
        for slot in self._slots:
            if slot.running is not None and slot.running.done():
                findings = slot.running.result()  # a head's exception is a bug and surfaces here
                slot.running = None
                if slot.outdated:
                    slot.outdated = False
                elif findings is None:
                    status.append(Status.NETWORK_FAILED)
                else:
                    slot.take(findings)
            status.extend(CARRIED[role] for role in slot.fills if slot.found.get(role) != frame_id)
        return status


@dataclass(frozen=True)
class _Started:
    networks: Networks
    frame_id: int

    def result(self) -> Perception:
        return self.networks._collect(self.frame_id)
