"""The map process and estimates that come late: a busy computer's, whose age is many frames."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from birdslam.bench.simulation.places import CAMERA, along, build, drive
from birdslam.runtime.configuration import load
from birdslam.runtime.maps.map_process import WAITING_IMAGES, LiveMap
from birdslam.runtime.process.restarts import FIRST
from birdslam.runtime.process.vitals import Vitals
from birdslam.runtime.transport.endpoints import Message
from birdslam.runtime.transport.presence import ring_path
from birdslam.runtime.transport.ring import FrameRing
from birdslam.runtime.wire import Trace
from birdslam.types import FrameRef

FRAMES = 30


class Queue:
    """What a subscriber gives, put in by hand."""

    dropped = malformed = 0

    def __init__(self) -> None:
        self.waiting: deque[Message] = deque()

    def put(self, record: Any, trace: Trace | None = None) -> None:
        self.waiting.append(Message(record, trace or Trace(), 0))

    def recv(self, timeout_s: float) -> Message | None:
        return self.waiting.popleft() if self.waiting else None


class Topics:
    """In place of the bus."""

    def __init__(self) -> None:
        self.frame, self.estimate = Queue(), Queue()

    def subscriber(self, topic: str, depth: int) -> Queue:
        queue: Queue = getattr(self, topic)
        queue.waiting = deque(maxlen=depth)
        return queue

    def publisher(self, topic: str) -> Queue:
        return Queue()


@pytest.fixture
def ring(tmp_path: Path) -> Iterator[FrameRing]:
    with FrameRing(ring_path("late", tmp_path / "rt"), CAMERA.height_px, CAMERA.width_px, 1) as ring:
        yield ring


@pytest.mark.parametrize("late", [0, WAITING_IMAGES + 3])
def test_frames_are_looked_at_however_late_their_estimates_come(tmp_path: Path, ring: FrameRing, late: int) -> None:
    settings = {
        "vehicle": "late",
        "output": str(tmp_path),
        "runtime.runtime_dir": str(tmp_path / "rt"),
        "results.map": str(tmp_path / "new.map"),
    }
    configuration = msgspec.structs.replace(load(None, settings), camera=CAMERA)
    topics, image = Topics(), np.zeros((CAMERA.height_px, CAMERA.width_px), np.uint8)
    live = LiveMap(configuration, topics, Vitals(), FIRST)  # type: ignore[arg-type]
    began_ns = time.monotonic_ns()
    estimates = [estimate for estimate, _, _ in drive(build(along([0.0] * 40), seed=1), range(FRAMES), 1)]
    for number, newest in enumerate(estimates):
        slot, sequence = ring.write(image)
        of_frame = {"slot": slot, "sequence": sequence, "ring_epoch": ring.epoch, "channels": 1}
        of_frame |= {"width_px": CAMERA.width_px, "height_px": CAMERA.height_px}
        times = {"t_source_ns": newest.t_source_ns, "t_utc_ns": 0}
        far_ns = began_ns + number * 10**12  # whatever the budget says
        topics.frame.put(FrameRef(frame_id=newest.frame_id, t_capture_ns=far_ns, **times, **of_frame))
        if number >= late:
            topics.estimate.put(estimates[number - late])
        live.turn(0.0)
    (tmp_path / "logs").mkdir()
    assert live.finish() == ""
    assert live.torn == 0
    assert live.looks >= 0.2 * (FRAMES - late)
