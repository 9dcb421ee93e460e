"""Degraded modes: load is shed when time is short and restored only with spare time."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from birdslam.frontend import FrontEnd
from birdslam.geometry.camera import Camera
from birdslam.perception import ModelSpec
from birdslam.runtime.configuration import (
    Configuration,
    DegradationConfig,
    ModelsConfig,
    RuntimeConfig,
    SourceConfig,
    complete,
)
from birdslam.runtime.nodes import inference
from birdslam.runtime.nodes.degradation import Degradation, Mode, modes
from birdslam.runtime.nodes.inference import Inference
from birdslam.runtime.nodes.nodes import PerceiveNode
from birdslam.runtime.process.restarts import FIRST
from birdslam.runtime.transport.presence import ring_path
from birdslam.runtime.transport.ring import FrameRing
from birdslam.types import INVALIDATING, Frame, FrameRef, Measurements, Status
from tests.fake_bus import FakeBus, Inbox
from tests.heads import Head

CONFIG = DegradationConfig(window_frames=4, late_share=0.5, calm_frames=6, calm_share=0.5)
BOTH = ("detector", "segmenter")


def test_only_modes_that_save_time_are_used() -> None:
    assert modes(BOTH) == tuple(Mode)
    assert modes(("detector",)) == (Mode.FULL, Mode.RATE, Mode.ODOMETRY, Mode.COASTING)
    assert modes(()) == (Mode.FULL, Mode.COASTING)


def test_modes_degrade_and_recover_step_by_step() -> None:
    degradation = Degradation(CONFIG, BOTH, budget_ms=100.0)
    down = [degradation.mode for _ in range(4 * 6) if degradation.judge(150.0)]
    assert down == list(Mode)[1:]
    up = [degradation.mode for _ in range(5 * 6) if degradation.judge(20.0)]
    assert up == list(Mode)[-2::-1]


def test_mode_is_stable_between_thresholds() -> None:
    degradation = Degradation(CONFIG, BOTH, budget_ms=100.0)
    for _ in range(4):
        degradation.judge(150.0)
    assert degradation.mode is Mode.RATE
    assert not any(degradation.judge(75.0) for _ in range(100))


@given(st.lists(st.floats(0.0, 300.0), max_size=200))
def test_at_most_one_step_per_window(ages_ms: list[float]) -> None:
    degradation = Degradation(CONFIG, BOTH, budget_ms=100.0)
    order = list(Mode)
    last = 0
    for number, age_ms in enumerate(ages_ms, start=1):
        before = order.index(degradation.mode)
        if degradation.judge(age_ms):
            assert abs(order.index(degradation.mode) - before) == 1
            assert number - last >= CONFIG.window_frames
            last = number


@pytest.mark.parametrize(
    ("mode", "runs", "road"),
    [
        (Mode.FULL, {"detector": 9, "segmenter": 9}, True),
        (Mode.RATE, {"detector": 3, "segmenter": 3}, True),
        (Mode.BOXES, {"detector": 9, "segmenter": 0}, False),
        (Mode.ODOMETRY, {"detector": 0, "segmenter": 0}, False),
    ],
)
def test_what_runs_in_each_mode(monkeypatch: pytest.MonkeyPatch, mode: Mode, runs: dict[str, int], road: bool) -> None:
    heads = {role: Head(role) for role in BOTH}
    monkeypatch.setattr(inference, "load_network", lambda role, spec, *others: heads[role])
    spec = ModelSpec("none.onnx")
    configuration = Configuration(
        source=SourceConfig(rate="max"), models=ModelsConfig(detector=spec, segmenter=spec, shipped=False)
    )  # at rate "max" each is awaited, so that they can be counted
    image = np.zeros((4, 4), dtype=np.uint8)
    with Inference(configuration) as networks:
        assert networks.roles == frozenset(BOTH)
        for number in range(9):
            perception = networks.start(Frame(number, 0, 0, 0, image), mode).result()
            assert (perception.segmentation is not None) == road
    assert {role: head.runs for role, head in heads.items()} == runs


class Blind(FrontEnd):
    """Counts what it is shown."""

    def __init__(self) -> None:
        self.shown: list[int] = []

    def measure(self, frame: Frame, pending: Any) -> Measurements:
        self.shown.append(frame.frame_id)
        pending.result()
        return Measurements(frame_id=frame.frame_id, t_source_ns=frame.t_source_ns, t_capture_ns=0, t_utc_ns=0)


@pytest.fixture
def pixels(tmp_path: Path) -> Iterator[dict[str, int]]:
    """The position of a small black image in the ring of the vehicle `test`."""
    with FrameRing(ring_path("test", tmp_path), 4, 4, channels=1) as ring:
        slot, sequence = ring.write(np.zeros((4, 4), dtype=np.uint8))
        place = {"slot": slot, "sequence": sequence, "ring_epoch": ring.epoch}
        yield {**place, "height_px": 4, "width_px": 4, "channels": 1}


def test_coasting_processes_few_frames_and_reports_it(tmp_path: Path, pixels: dict[str, int]) -> None:
    configuration = Configuration(
        vehicle="test",
        runtime=RuntimeConfig(runtime_dir=str(tmp_path)),
        models=ModelsConfig(shipped=False),
        degradation=DegradationConfig(window_frames=1, late_share=1.0, coast_divisor=5, coast_max_ms=250.0),
    )
    frontend = Blind()
    with Inference(configuration) as networks:
        node = PerceiveNode(configuration, networks, frontend, FakeBus(), FIRST)
        records: list[Measurements] = []
        for number in range(12):  # each a second old when it is done
            stamps = {"t_source_ns": number * 100_000_000, "t_capture_ns": 0, "t_utc_ns": 0}
            records += node.step(FrameRef(frame_id=number, **pixels, **stamps))
        assert node.mode == Mode.COASTING
    assert frontend.shown == [0, 5, 10]
    coasted = [r for r in records if Status.COASTING in r.status]
    assert [r.frame_id for r in coasted] == [1, 2, 3, 4, 6, 7, 8, 9, 11]
    assert [r.frame_id for r in coasted if not INVALIDATING.isdisjoint(r.status)] == [3, 4, 8, 9]
    assert all(r.cc is None for r in coasted)
    assert Status.DEGRADED_ODOMETRY in records[5].status
    assert all(Status.INPUT_STALE in r.status for r in records if r.frame_id in frontend.shown)


def test_overtaken_frame_is_predicted(tmp_path: Path, pixels: dict[str, int]) -> None:
    runtime = RuntimeConfig(runtime_dir=str(tmp_path))
    configuration = Configuration(vehicle="test", models=ModelsConfig(shipped=False), runtime=runtime)
    stamps = {"t_source_ns": 0, "t_capture_ns": 0, "t_utc_ns": 0}
    came = [FrameRef(frame_id=number, **pixels, **stamps) for number in range(3)]
    end = FrameRef(frame_id=5, slot=-1, **stamps, status=(Status.END_OF_SOURCE,))
    waiting, frontend = Inbox(came), Blind()
    records: list[Measurements] = []
    with Inference(configuration) as networks:
        node = PerceiveNode(configuration, networks, frontend, FakeBus(frame=waiting), FIRST)
        while (message := node.receive(0.0)) is not None:
            records += node.step(message.record)
            if message.record.frame_id == 2:
                for later in (*(FrameRef(frame_id=number, **pixels, **stamps) for number in (3, 4)), end):
                    waiting.come(later)
    assert [record.frame_id for record in records] == [0, 1, 2, 3, 4, 5]  # none is left out
    assert [record.frame_id for record in records if Status.COASTING in record.status] == [0, 1, 3]
    assert frontend.shown == [2, 4]  # the newest, and the last: the end overtakes nothing
    assert node.ended


def test_background_work_runs_only_without_degradation(tmp_path: Path, pixels: dict[str, int]) -> None:
    configuration = Configuration(
        vehicle="test",
        models=ModelsConfig(shipped=False),
        degradation=DegradationConfig(enabled=False),
        runtime=RuntimeConfig(runtime_dir=str(tmp_path)),
    )
    configuration = complete(configuration, Camera(64, 32, 50.0, 50.0, 32.0, 16.0, 1.5), 33.0)
    with Inference(configuration) as networks:
        node = PerceiveNode(configuration, networks, Blind(), FakeBus(), FIRST)
        done = networks.run_in_background(lambda: "lanes")
        assert len(list(node.step(FrameRef(frame_id=0, **pixels, t_source_ns=0, t_capture_ns=0, t_utc_ns=0)))) == 1
        assert done.result(timeout=60.0) == "lanes"
