"""Degraded modes, and the rate at which networks look."""

from __future__ import annotations

import itertools
import os
import threading
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
from birdslam.perception.schedule import Networks
from birdslam.perception.shipped import run_at_once
from birdslam.runtime.configuration import (
    Configuration,
    DegradationConfig,
    LooksConfig,
    ModelsConfig,
    RuntimeConfig,
    SourceConfig,
    complete,
)
from birdslam.runtime.nodes import inference
from birdslam.runtime.nodes.degradation import Degradation, Mode, modes
from birdslam.runtime.nodes.inference import Inference
from birdslam.runtime.nodes.look_rate import Cost, LookRate, load, measure, threads_of_a_network
from birdslam.runtime.nodes.nodes import PerceiveNode
from birdslam.runtime.process import realtime
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


PERIOD_MS = 30.0
SLOW = {"multitask": Cost(ms=22.0, threads=1, every=1)}
LOOKING = LooksConfig(window_frames=4, calm_frames=8, most_calm_frames=64)


def look_rate(cores: float = 2.0, costs: dict[str, Cost] = SLOW) -> LookRate:
    return LookRate(LOOKING, costs, cores, PERIOD_MS)


def settle(rate: LookRate, work_ms: float, look_ms: float, frames: int) -> list[int]:
    """A computer on which a frame costs `work_ms`, and a look `look_ms` more, spread over the frames between two."""
    return [rate.sparing for _ in range(frames) if rate.judge(work_ms + look_ms / rate.sparing, dropped=False) or True]


@pytest.mark.parametrize(("cores", "ms", "sparing"), [(2.0, 22.0, 2), (4.0, 22.0, 1), (2.0, 6.0, 1), (1.0, 22.0, 5)])
def test_initial_rate_follows_from_the_cores(cores: float, ms: float, sparing: int) -> None:
    costs = {"multitask": Cost(ms, threads=min(2, threads_of_a_network(cores)), every=1)}
    config = LooksConfig()
    rate = LookRate(config, costs, cores, PERIOD_MS)
    assert rate.sparing == sparing
    room = config.room_share * max(cores - 1.25, 0.25)
    assert rate.sparing == rate.most or load(costs, PERIOD_MS, rate.sparing) <= room


@pytest.mark.parametrize(("ms", "most"), [(22.0, 5), (4.0, 1), (400.0, 11)])
def test_cheap_networks_run_on_every_frame(ms: float, most: int) -> None:
    rate = look_rate(costs={"multitask": Cost(ms, threads=1, every=1)})
    assert rate.most == most
    assert most == 11 or load({"multitask": Cost(ms, 1, 1)}, PERIOD_MS, most) <= LOOKING.slight_load


def test_skipped_runs_save_the_cost_of_boxes() -> None:
    cost = Cost(ms=22.0, threads=1, every=1, boxes_ms=16.0)
    rate = look_rate(costs={"multitask": cost})
    assert (rate.sparing, rate.masks_every) == (2, 2)
    assert load({"multitask": cost}, PERIOD_MS, 2) == pytest.approx((22.0 + 16.0) / 2.0 / 60.0)
    assert load({"multitask": cost}, PERIOD_MS, 1) == pytest.approx(22.0 / 30.0)
    settle(rate, work_ms=2.0, look_ms=2.0, frames=100)
    assert (rate.sparing, rate.masks_every) == (1, 1)


@given(st.floats(0.5, 64.0), st.floats(0.1, 500.0), st.integers(1, 9), st.floats(10.0, 200.0))
def test_faster_computer_never_has_a_lower_rate(cores: float, ms: float, every: int, period_ms: float) -> None:
    costs = {"detector": Cost(ms, 1, every)}
    rate = LookRate(LOOKING, costs, cores, period_ms)
    assert 1 <= rate.sparing <= rate.most
    assert LookRate(LOOKING, costs, 2.0 * cores, period_ms).sparing <= rate.sparing
    assert LookRate(LOOKING, {"detector": Cost(ms / 2.0, 1, every)}, cores, period_ms).sparing <= rate.sparing


def test_rate_drops_under_load_and_recovers() -> None:
    rate = look_rate()
    settle(rate, work_ms=17.0, look_ms=30.0, frames=40)
    loaded = rate.sparing
    assert 17.0 + 30.0 / loaded <= LOOKING.busy_share * PERIOD_MS < 17.0 + 30.0 / (loaded - 1)
    settle(rate, work_ms=5.0, look_ms=5.0, frames=200)
    assert rate.sparing == 1


def test_a_dropped_frame_counts_once() -> None:
    rate = look_rate()
    before = rate.sparing
    assert [rate.judge(1.0, dropped=k == 0) for k in range(6)] == [False, False, False, True, False, False]
    assert rate.sparing == before + 1


def test_failed_increase_is_retried_with_growing_delay() -> None:
    rate = look_rate()
    seen = settle(rate, work_ms=10.0, look_ms=22.0, frames=600)  # calm with one look in two, too busy with more
    tried = [k for k, (a, b) in enumerate(itertools.pairwise(seen)) if b < a]
    waits = np.diff(tried)
    assert set(seen) == {1, 2}
    assert len(waits) >= 3
    assert (np.diff(waits) >= 0).all()
    assert waits[-1] > 2 * waits[0]


@given(st.lists(st.tuples(st.floats(0.0, 200.0), st.booleans()), max_size=300))
def test_rate_changes_by_one_step_within_bounds(frames: list[tuple[float, bool]]) -> None:
    rate = look_rate()
    for step_ms, dropped in frames:
        before = rate.sparing
        changed = rate.judge(step_ms, dropped)
        assert abs(rate.sparing - before) == int(changed)
        assert 1 <= rate.sparing <= rate.most


def test_every_network_is_measured_on_an_image_of_the_camera() -> None:
    shapes: dict[str, set[tuple[int, ...]]] = {"a": set(), "b": set()}
    camera = Camera(64, 32, 50.0, 50.0, 32.0, 16.0, 1.5)
    took_ms = measure({name: lambda image, n=name: shapes[n].add(image.shape) for name in shapes}, camera, 0.0)
    assert shapes == {"a": {(32, 64, 3)}, "b": {(32, 64, 3)}}
    assert set(took_ms) == set(shapes)
    assert min(took_ms.values()) >= 0.0


def test_skipped_networks_run_on_fewer_frames() -> None:
    head = Head("detector", every=2)
    networks = Networks([head], run_at_once)
    for frame_id in range(24):
        networks.slowdown = 1 if frame_id < 12 else 3
        networks.start(frame_id, np.full((2, 2), frame_id, np.uint8)).result()
    assert head.frames == [0, 2, 4, 6, 8, 10, 16, 22]


def test_only_one_thread_yields() -> None:
    nice: dict[str, int] = {}

    def behind() -> None:
        realtime.lower_priority()
        nice["behind"] = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())

    before = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
    thread = threading.Thread(target=behind)
    thread.start()
    thread.join()
    assert nice["behind"] == min(before + 5, 19)
    assert os.getpriority(os.PRIO_PROCESS, threading.get_native_id()) == before


def test_threads_of_one_interpreter_share_priority() -> None:
    """Were it to wait for a core while it holds the interpreter's lock, the frames would wait with it."""
    nice: dict[str, int] = {}

    def beside() -> None:
        realtime.as_frames()
        nice["beside"] = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())

    thread = threading.Thread(target=beside)
    thread.start()
    thread.join()
    assert nice["beside"] == os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
