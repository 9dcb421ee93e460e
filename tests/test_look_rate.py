"""The adaptive rate of the networks: it drops before frames are lost, rises with spare time, and is stable."""

from __future__ import annotations

import itertools
import os
import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from birdslam.geometry.camera import Camera
from birdslam.perception.schedule import Networks
from birdslam.perception.shipped import run_at_once
from birdslam.runtime.configuration import LooksConfig
from birdslam.runtime.nodes.look_rate import Cost, LookRate, load, measure, threads_of_a_network
from birdslam.runtime.process import realtime
from tests.heads import Head

PERIOD_MS = 30.0
SLOW = {"multitask": Cost(ms=22.0, threads=1, every=1)}
CONFIG = LooksConfig(window_frames=4, calm_frames=8, most_calm_frames=64)


def look_rate(cores: float = 2.0, costs: dict[str, Cost] = SLOW) -> LookRate:
    return LookRate(CONFIG, costs, cores, PERIOD_MS)


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
    assert most == 11 or load({"multitask": Cost(ms, 1, 1)}, PERIOD_MS, most) <= CONFIG.slight_load


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
    rate = LookRate(CONFIG, costs, cores, period_ms)
    assert 1 <= rate.sparing <= rate.most
    assert LookRate(CONFIG, costs, 2.0 * cores, period_ms).sparing <= rate.sparing
    assert LookRate(CONFIG, {"detector": Cost(ms / 2.0, 1, every)}, cores, period_ms).sparing <= rate.sparing


def test_rate_drops_under_load_and_recovers() -> None:
    rate = look_rate()
    settle(rate, work_ms=17.0, look_ms=30.0, frames=40)
    loaded = rate.sparing
    assert 17.0 + 30.0 / loaded <= CONFIG.busy_share * PERIOD_MS < 17.0 + 30.0 / (loaded - 1)
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
