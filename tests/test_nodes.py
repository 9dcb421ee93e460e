"""The capture and optimize nodes alone, on a fake bus."""

from __future__ import annotations

import threading
import time
from collections.abc import Generator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from birdslam.geometry.se2 import SE2
from birdslam.runtime.configuration import Configuration, RuntimeConfig, SourceConfig
from birdslam.runtime.nodes import capture
from birdslam.runtime.nodes.capture import CaptureNode
from birdslam.runtime.nodes.optimize import OptimizeNode
from birdslam.runtime.nodes.sources import SourceError
from birdslam.runtime.process.restarts import FIRST, Assignment, Resume
from birdslam.runtime.transport.bus import Message
from birdslam.runtime.transport.presence import ring_path
from birdslam.runtime.transport.ring import FrameReader
from birdslam.sources.recording import RecordedFrame
from birdslam.types import Estimate, FrameRef, MapUpdate, Measurements, Status
from tests.fake_bus import FakeBus, Inbox
from tests.recordings import SMALL as CAMERA
from tests.records import new_estimate


class Source:
    """A camera or a recording of `count` frames; a camera then falls silent."""

    name, camera, rate_hz = "source", CAMERA, 10.0

    def __init__(self, count: int, live: bool) -> None:
        self.live = live
        self._count = count
        self.over = threading.Event()

    def frames(self) -> Generator[RecordedFrame]:
        for index in range(self._count):
            pixels = None if index == 1 else np.full((32, 64, 3), index, dtype=np.uint8)
            yield RecordedFrame(index, 1000 + index, pixels, "torn" if pixels is None else None)
        if self.live:
            self.over.wait(600.0)


def make_capture(
    monkeypatch: pytest.MonkeyPatch,
    place: Path,
    source: Source,
    rate: Any = "max",
    assignment: Assignment = FIRST,
    camera_timeout_s: float = 60.0,
    **limits: Any,
) -> tuple[CaptureNode, Inbox, FrameReader]:
    monkeypatch.setattr(capture, "open_source", lambda configuration, must_open: source)
    configuration = Configuration(
        vehicle="test",
        camera=CAMERA,
        source=SourceConfig(uri="kitti:none", rate=rate, camera_timeout_s=camera_timeout_s),
        runtime=RuntimeConfig(runtime_dir=str(place), **limits),
    )
    bus = FakeBus()
    node = CaptureNode(configuration, bus, lambda timeout_s: None, assignment)
    return node, bus.inboxes["estimate"], FrameReader(ring_path("test", place))


def receive(node: CaptureNode) -> Message:
    until_s = time.monotonic() + 60.0
    while time.monotonic() < until_s:
        message = node.receive(0.1)
        if message is not None:
            return message
    raise AssertionError("nothing came")


def come_back(inbox: Inbox, ref: FrameRef) -> None:
    """What optimize would send of this frame."""
    estimate = new_estimate(
        frame_id=ref.frame_id, T_world_ego=msgspec.convert([0.0, 0.0, 0.0], SE2), valid=False, status=ref.status
    )
    inbox.come(estimate)


def test_rate_max_keeps_a_window_and_ends_last(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    node, inbox, reader = make_capture(monkeypatch, tmp_path, Source(3, live=False), in_flight_frames=2)
    refs = [next(node.step(receive(node).record)) for _ in range(2)]
    assert node.receive(0.01) is None  # two are in flight
    come_back(inbox, refs[0])
    refs.append(next(node.step(receive(node).record)))
    assert [ref.frame_id for ref in refs] == [0, 1, 2]
    assert [ref.t_source_ns for ref in refs] == [1000, 1001, 1002]
    assert refs[1].slot == -1
    assert refs[1].status == (Status.FRAME_UNREADABLE,)
    pixels = reader.read(refs[2])
    assert pixels.shape == (32, 64, 3)
    assert (pixels == 2).all()
    come_back(inbox, refs[1])
    assert node.receive(0.01) is None  # the last frame first, then the end
    come_back(inbox, refs[2])
    (end,) = node.step(receive(node).record)
    assert (end.frame_id, end.status) == (3, (Status.END_OF_SOURCE,))
    assert node.receive(0.01) is None
    assert not node.ended  # the ring stays until all have read
    come_back(inbox, end)
    assert node.receive(0.01) is None
    assert node.ended
    node.close()
    reader.close()


def test_end_does_not_wait_forever_for_a_lost_frame(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    node, _, reader = make_capture(monkeypatch, tmp_path, Source(1, live=False), rate=1000.0, drain_timeout_s=0.05)
    next(node.step(receive(node).record))
    (end,) = node.step(receive(node).record)
    assert end.status == (Status.END_OF_SOURCE,)
    node.close()
    reader.close()


def test_draining_ends_an_endless_source(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    source = Source(1, live=True)
    node, inbox, reader = make_capture(monkeypatch, tmp_path, source, rate=None)
    ref = next(node.step(receive(node).record))
    assert ref.t_capture_ns == 1000  # a camera's own stamp
    node.drain()
    come_back(inbox, ref)
    (end,) = node.step(receive(node).record)
    assert (end.frame_id, end.status) == (1, (Status.END_OF_SOURCE,))
    source.over.set()
    node.close()
    reader.close()


def test_silent_camera_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    source = Source(1, live=True)
    node, _, reader = make_capture(monkeypatch, tmp_path, source, rate=None, camera_timeout_s=0.2)
    next(node.step(receive(node).record))
    with pytest.raises(SourceError, match=r"source: no frame for 0\.2 s"):
        receive(node)
    source.over.set()
    node.close()
    reader.close()


def test_a_resumed_capture_leaves_a_gap(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    source = Source(3, live=True)
    resumed: list[tuple[int, int]] = []
    monkeypatch.setattr(source, "resume", lambda *told: resumed.append(told), raising=False)
    assignment = Assignment(1, "was killed by SIGKILL", Resume(41, 700, time.monotonic_ns() - 350_000_000))
    node, _, reader = make_capture(monkeypatch, tmp_path, source, rate=None, assignment=assignment)
    ref = next(node.step(receive(node).record))
    assert ref.frame_id >= 41 + 3  # 0.35 s at 10 Hz
    assert [told[0] for told in resumed] == [ref.frame_id - ref.dropped]
    source.over.set()
    node.close()
    reader.close()


def test_new_optimizer_reports_a_new_epoch(tmp_path: Path) -> None:
    configuration = Configuration(vehicle="test", runtime=RuntimeConfig(runtime_dir=str(tmp_path)))
    stamps = {"t_source_ns": 5, "t_capture_ns": 6, "t_utc_ns": 7}
    epochs, told = [], []
    for number in range(3):  # each was killed
        node = OptimizeNode(configuration, FakeBus())
        for frame_id in (2 * number, 2 * number + 1):
            estimate, *_ = node.step(Measurements(frame_id=frame_id, **stamps))
            assert isinstance(estimate, Estimate)
            told.append(Status.GRAPH_RESET in estimate.status)
            epochs.append(estimate.epoch)
    assert epochs == sorted(epochs)
    assert len(set(epochs[::2])) == 3
    assert told[2::2] == [True, True]


def test_optimize_completes_the_map_before_the_end() -> None:
    node = OptimizeNode(Configuration(source=SourceConfig(rate="max")), FakeBus())
    stamps = {"t_source_ns": 5, "t_capture_ns": 6, "t_utc_ns": 7}
    first, *_ = node.step(Measurements(frame_id=0, **stamps, status=(Status.NOT_INITIALISED,)))
    assert isinstance(first, Estimate)
    gained, end = node.step(Measurements(frame_id=1, **stamps, status=(Status.END_OF_SOURCE,)))
    assert isinstance(gained, MapUpdate)
    assert gained.frame_id == 1
    assert isinstance(end, Estimate)
    assert (end.frame_id, end.valid, end.status) == (1, False, (Status.END_OF_SOURCE,))
    assert (end.epoch, end.T_world_ego) == (first.epoch, first.T_world_ego)
    assert node.ended
