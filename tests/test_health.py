"""Budgets, health of a node, scheduling, and the check of the machine."""

from __future__ import annotations

import os
import platform
import re
import resource
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from birdslam.geometry.se2 import SE2
from birdslam.runtime.cli.main import main
from birdslam.runtime.configuration import (
    BudgetsConfig,
    Configuration,
    ConfigurationError,
    ModelsConfig,
    NodeScheduling,
    PerceiveConfig,
    RealtimeConfig,
    RuntimeConfig,
    SourceConfig,
    complete,
    load,
)
from birdslam.runtime.doctor import checks as doctor
from birdslam.runtime.doctor import costs as doctor_costs
from birdslam.runtime.environment import ENVIRONMENT
from birdslam.runtime.latency import Recent
from birdslam.runtime.nodes.meter import PERIOD_NS, Meter
from birdslam.runtime.process import realtime
from birdslam.runtime.process.cores import quota
from birdslam.runtime.process.restarts import Assignment
from birdslam.runtime.slices import SHORT_NS, own_threads, wake_soon
from birdslam.runtime.supervision.live import LiveLine
from birdslam.runtime.supervision.logbook import Logbook
from birdslam.runtime.transport.bus import Bus
from birdslam.runtime.wire import Health, Spread, Stage, Trace, decode, encode
from birdslam.types import Estimate, MapUpdate, Status
from tests.recordings import SMALL as CAMERA

MS = 1_000_000


def test_budgets_over_the_total_are_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_text("[budgets]\nperceive_ms = 120\n")
    with pytest.raises(ConfigurationError, match=r"budgets: capture_ms .* perceive_ms .* = 170 is over end_to_end_ms"):
        load(path)
    with pytest.raises(ConfigurationError, match=r"command line: budgets: .* is over end_to_end_ms = 20"):
        load(None, {"budgets.end_to_end_ms": 20})


def test_no_frame_waits_longer_for_networks_than_perceive_may_take() -> None:
    with pytest.raises(ConfigurationError, match=r"command line: perceive.deadline_ms: 130 is over budgets.*= 120"):
        load(None, {"perceive.deadline_ms": 130})
    slow = complete(load(None), CAMERA, rate_hz=1.0)
    assert slow.perceive.deadline_ms == slow.budgets.perceived_ms
    assert complete(load(None), CAMERA, rate_hz=10.0).perceive.deadline_ms == pytest.approx(75.0)


@given(st.lists(st.floats(1.0, 60.0), min_size=6, max_size=6), st.floats(1.0, 300.0))
def test_budgets_load_if_they_add_up(parts: list[float], whole: float) -> None:
    names = [name for name in BudgetsConfig.__struct_fields__ if name not in ("percentile", "end_to_end_ms")]
    tree = {f"budgets.{name}": value for name, value in zip(names, parts, strict=True)}
    tree |= {"budgets.end_to_end_ms": whole, "perceive.deadline_ms": 1.0}
    if sum(parts) <= whole:
        assert load(None, tree).budgets.end_to_end_ms == whole
    else:
        with pytest.raises(ConfigurationError, match="end_to_end_ms"):
            load(None, tree)


def test_recent_values_expire() -> None:
    recent = Recent(span_s=1.0)
    for number in range(100):
        recent.add(100.0, number * 10 * MS)
    assert recent.spread(1000 * MS).p50_ms == pytest.approx(100.0, rel=0.02)
    for number in range(100, 400):
        recent.add(1.0, number * 10 * MS)
    assert recent.spread(4000 * MS) == Spread(*[pytest.approx(1.0, rel=0.02)] * 4)
    assert recent.spread(9000 * MS) == Spread()


def test_a_node_s_health() -> None:
    configuration = Configuration(budgets=BudgetsConfig(optimize_ms=5.0, perceive_to_optimize_ms=3.5))
    meter = Meter("optimize", configuration, Assignment(restarts=2, cause="was killed by SIGKILL"))
    begun_ns = time.monotonic_ns()
    for number in range(20):
        taken_ns = begun_ns + number * 50 * MS
        done_ns = taken_ns + (7 if number % 4 == 0 else 2) * MS
        waited_ns = 4 * MS if number in (1, 2) else 0  # in the queue: this node's time, not the hop's
        trace = Trace((Stage("capture", 0, 0, 0), Stage("perceive", 0, 0, taken_ns - waited_ns - 3 * MS)))
        meter.received(taken_ns)
        meter.frame(taken_ns - 40 * MS, trace.after("optimize", taken_ns, done_ns, taken_ns - waited_ns))
    assert not meter.due(begun_ns)
    now_ns = begun_ns + PERIOD_NS + 50 * MS
    assert meter.due(now_ns)
    health = meter.health(now_ns, "full", {"dropped": 1, "malformed": 2, "torn": 3})
    assert (health.frames, health.overruns, health.late, health.restarts) == (20, 7, 0, 2)
    assert health.rate_hz == pytest.approx(20.0, rel=0.1)
    assert health.wait.p50_ms == pytest.approx(3.0, rel=0.02)
    assert (health.step.p50_ms, health.step.max_ms) == (pytest.approx(2.0, rel=0.02), pytest.approx(7.0))
    assert health.age.p99_ms == pytest.approx(47.0, rel=0.02)
    assert health.rss_bytes > 1 << 20
    assert health.status == ()
    assert not meter.due(now_ns)
    assert decode(encode(health), Health) == health
    stale = meter.health(now_ns + 2 * PERIOD_NS, "full", {})
    assert stale.status == (Status.INPUT_STALE,)
    assert stale.rate_hz == 0.0


def test_remaining_budget_is_kept_in_the_trace() -> None:
    trace = Trace((Stage("optimize", 1, 2),), left_ns=-5).sent(9, 3)
    assert trace == Trace((Stage("optimize", 1, 2, 9),), left_ns=-5, number=3)
    assert decode(encode(Trace((Stage("n", 1, 2, 3),))), Trace).left_ns is None


def scheduled(**settings: object) -> Configuration:
    return Configuration(source=SourceConfig(uri="kitti:x"), realtime=RealtimeConfig(**settings))


def test_recording_needs_no_permissions() -> None:
    assert list(realtime.apply("perceive", scheduled())) == []
    assert Configuration(source=SourceConfig(uri="v4l2:/dev/video0")).live


def test_missing_permission_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*arguments: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    monkeypatch.setattr(os, "sched_setaffinity", refuse)
    monkeypatch.setattr(realtime, "may_lock_memory", lambda: False)
    configuration = scheduled(fifo="on", lock_memory="on", optimize=NodeScheduling(cpus=(0,)))
    said = list(realtime.apply("optimize", configuration))
    assert [line.partition(":")[0] for line in said] == [
        "realtime.optimize.cpus",
        "realtime.fifo",
        "realtime.lock_memory",
    ]


def test_node_runs_on_its_configured_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[int, tuple[int, ...]]] = []
    monkeypatch.setattr(os, "sched_setaffinity", lambda thread, cpus: asked.append((thread, cpus)))
    monkeypatch.setattr(os, "sched_setscheduler", lambda *of: None)
    assert list(realtime.apply("capture", scheduled(capture=NodeScheduling(cpus=(1, 2))))) == []
    assert (os.getpid(), (1, 2)) in asked


def at_rate(hz: float) -> Configuration:
    return msgspec.structs.replace(scheduled(), perceive=PerceiveConfig(period_ms=1e3 / hz))


def test_light_nodes_have_priority_over_networks(monkeypatch: pytest.MonkeyPatch) -> None:
    by_fifo: list[int] = []
    nice: list[int] = []
    monkeypatch.setattr(os, "sched_setscheduler", lambda thread, policy, param: by_fifo.append(param.sched_priority))
    monkeypatch.setattr(os, "setpriority", lambda which, thread, value: nice.append(value))
    assert list(realtime.apply("optimize", at_rate(33.0))) == []
    assert ({*by_fifo}, nice) == ({scheduled().realtime.optimize.priority}, [])
    monkeypatch.setattr(os, "sched_setscheduler", refused)  # of whoever may not
    assert list(realtime.apply("optimize", at_rate(33.0))) == []
    assert nice
    assert max(nice) < 0
    monkeypatch.setattr(os, "setpriority", refused)  # nor that
    assert list(realtime.apply("optimize", at_rate(33.0))) == []


def test_frames_of_perceive_have_priority_over_networks(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[int, int]] = []
    slices: list[tuple[list[int], int]] = []
    own, usual = threading.get_native_id(), os.getpriority(os.PRIO_PROCESS, 0)
    monkeypatch.setattr(realtime, "_usual_nice", [])  # private: of the whole process
    monkeypatch.setattr(os, "sched_setscheduler", lambda *of: pytest.fail("planners would wake behind SCHED_FIFO"))
    monkeypatch.setattr(os, "setpriority", lambda which, thread, nice: asked.append((thread, nice)))
    monkeypatch.setattr(realtime, "wake_soon", lambda threads, ns=SHORT_NS: slices.append((threads, ns)))
    monkeypatch.setattr(realtime, "usable_cores", lambda: 1.0)
    assert list(realtime.apply("perceive", at_rate(33.0))) == []
    realtime.below_frames()
    assert (asked, slices) == ([], [])  # they would leave the networks no core
    monkeypatch.setattr(realtime, "usable_cores", lambda: 2.0)
    assert list(realtime.apply("perceive", at_rate(33.0))) == []
    realtime.below_frames()
    assert asked == [(own, -20), (own, usual)]  # this thread alone, then one of a network
    assert slices == [([own], SHORT_NS), ([own], 0)]
    monkeypatch.setattr(realtime, "_usual_nice", [])  # private: of the whole process
    monkeypatch.setattr(os, "setpriority", refused)
    assert list(realtime.apply("perceive", at_rate(33.0))) == []
    realtime.below_frames()  # asks for nothing where nothing was given


def test_a_thread_gets_a_short_slice_and_keeps_its_nice_value() -> None:
    begun, over = threading.Event(), threading.Event()
    thread = threading.Thread(target=lambda: (begun.set(), over.wait()))
    thread.start()
    begun.wait()
    assert thread.native_id is not None

    def slice_ns() -> int | None:
        text = Path(f"/proc/self/task/{thread.native_id}/sched").read_text()
        found = re.search(r"^se\.slice\s*:\s*(\d+)", text, re.MULTILINE)
        return int(found[1]) if found else None

    try:
        usual, nice = slice_ns(), os.getpriority(os.PRIO_PROCESS, thread.native_id)
        if usual is None:
            pytest.skip("this kernel shows no slices")
        assert thread.native_id in own_threads()
        wake_soon([thread.native_id, 1 << 22])  # the second has ended
        assert slice_ns() == SHORT_NS
        assert os.getpriority(os.PRIO_PROCESS, thread.native_id) == nice
        wake_soon([thread.native_id], 0)
        assert slice_ns() == usual
    finally:
        over.set()
        thread.join()


@pytest.mark.parametrize("configuration", [scheduled(), at_rate(1000.0)])
def test_flood_of_frames_does_not_block_a_core(configuration: Configuration, monkeypatch: pytest.MonkeyPatch) -> None:
    nice: list[int] = []
    monkeypatch.setattr(os, "sched_setscheduler", lambda *of: pytest.fail("SCHED_FIFO at a rate without a bound"))
    monkeypatch.setattr(os, "setpriority", lambda which, thread, value: nice.append(value))
    assert list(realtime.apply("capture", configuration)) == []
    assert nice


def test_at_rate_max_no_real_time_priority_is_set(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[object] = []
    monkeypatch.setattr(os, "sched_setscheduler", lambda *of: asked.append(of))
    monkeypatch.setattr(os, "setpriority", lambda *of: asked.append(of))
    lossless = msgspec.structs.replace(at_rate(33.0), source=SourceConfig(uri="kitti:x", rate="max"))
    assert list(realtime.apply("optimize", lossless)) == []
    assert asked == []


def test_spare_loads_at_low_priority_and_restores_it() -> None:
    policy = os.sched_getscheduler(0)
    with subprocess.Popen(["sleep", "600"], start_new_session=True) as process:
        group = Path(f"/proc/{process.pid}/autogroup")
        try:
            realtime.lower_to_idle(process.pid)
            if group.exists():
                assert group.read_text().split()[-1] == "19"
            assert os.sched_getscheduler(process.pid) in (os.SCHED_IDLE, policy)  # who may not come back is not sent
            realtime.raise_from_idle(process.pid)
            assert os.sched_getscheduler(process.pid) == policy
            if group.exists():
                assert group.read_text().split()[-1] == "0"
        finally:
            process.kill()
    realtime.raise_from_idle(process.pid)  # it has ended: nothing to do


def test_priority_is_not_lowered_without_permission_to_restore(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda which: (0, 0))
    monkeypatch.setattr(realtime, "has_capability", lambda capability: False)
    monkeypatch.setattr(os, "sched_setscheduler", lambda *of: pytest.fail("it was"))
    with subprocess.Popen(["sleep", "600"], start_new_session=True) as process:
        realtime.lower_to_idle(process.pid)
        process.kill()


def test_the_doctor_has_a_row_for_everything(tmp_path: Path) -> None:
    configuration = Configuration(
        vehicle="doc", runtime=RuntimeConfig(runtime_dir=str(tmp_path / "rt")), output=str(tmp_path / "out")
    )
    findings = list(doctor.examine(configuration))
    rows = {finding.what: finding for finding in findings}
    expected = {
        *("cores", "governor", "threads", "SCHED_FIFO", "memory lock", "memory", "runtime directory", "shared memory"),
        *("output", "clock", "UTC"),
    }
    assert expected | {"multitask", "camera"} <= set(rows)
    assert all(f.verdict in ("ok", "warning", "error") for f in findings)
    assert all(f.advice for f in findings if f.verdict != "ok")
    assert not (tmp_path / "out").exists()
    lines = doctor.table(findings).splitlines()
    assert len(lines) == len(findings)


@pytest.mark.processes
def test_the_doctor_measures_what_settings_cost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor_costs, "WAKES", 10)
    monkeypatch.setattr(doctor_costs, "PIECES", 3)
    rows = dict(doctor_costs.costs(1))
    assert all(rows.values())
    assert "ms" in rows["all cores busy"]
    monkeypatch.setattr(os, "sched_setscheduler", refused)
    assert "not permitted" in dict(doctor_costs.costs(1))["the same, SCHED_FIFO"]
    with doctor_costs.busy_cores(1):
        assert len(doctor_costs.lateness_ms()) == 10


def test_the_doctor_s_exit_status(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    place = f"runtime.runtime_dir={tmp_path / 'rt'}"
    assert main(["doctor", "--set", place, "--model", f"detector={tmp_path / 'none.onnx'}"]) == 1
    out = capsys.readouterr().out
    assert "error   detector" in out
    assert "none.onnx" in out
    assert main(["doctor", "--set", place, "--source", "demo"]) == 0  # warnings are no failure


def findings_of(what: str, configuration: Configuration) -> doctor.Finding:
    (finding,) = (finding for finding in doctor.examine(configuration) if finding.what == what)
    return finding


def refused(*arguments: object) -> None:
    raise PermissionError


def test_doctor_reports_problems(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rt = RuntimeConfig(runtime_dir=str(tmp_path / "rt"))
    healthy = Configuration(
        vehicle="doc",
        runtime=rt,
        output=str(tmp_path),
        source=SourceConfig(uri="demo"),
        models=ModelsConfig(shipped=False),
    )

    def with_realtime(**settings: object) -> Configuration:
        return msgspec.structs.replace(healthy, realtime=RealtimeConfig(**settings))

    cores = findings_of("cores", with_realtime(perceive=NodeScheduling(cpus=(min(os.sched_getaffinity(0)), 9999))))
    assert (cores.verdict, "perceive: 9999" in cores.found) == ("warning", True)
    many = msgspec.structs.replace(healthy, perceive=PerceiveConfig(opencv_threads=64))
    assert findings_of("threads", many).verdict == "warning"
    assert findings_of("threads", healthy).found.endswith("OpenCV 1, BLAS 1")

    with monkeypatch.context() as patch:
        patch.setattr(os, "sched_setscheduler", refused)
        fifo = findings_of("SCHED_FIFO", with_realtime(capture=NodeScheduling(priority=42)))
        assert (fifo.verdict, "LimitRTPRIO=42" in fifo.advice) == ("warning", True)
        assert findings_of("SCHED_FIFO", with_realtime(fifo="off")).verdict == "ok"
    with monkeypatch.context() as patch:
        patch.setattr(realtime, "may_lock_memory", lambda: False)
        assert findings_of("memory lock", healthy).verdict == "warning"
        assert findings_of("memory lock", with_realtime(lock_memory="off")).verdict == "ok"
    with monkeypatch.context() as patch:
        usage = shutil.disk_usage(tmp_path)._replace(free=1 << 20)
        patch.setattr(shutil, "disk_usage", lambda path: usage)
        assert findings_of("shared memory", healthy).verdict == "error"
        assert findings_of("output", healthy).verdict == "warning"
    with monkeypatch.context() as patch:
        patch.setattr(time, "time", lambda: 0.0)
        assert findings_of("UTC", healthy).verdict == "warning"

    (tmp_path / "open").mkdir(mode=0o755)
    (tmp_path / "open" / "doc").mkdir(mode=0o755)
    open_to_all = msgspec.structs.replace(healthy, runtime=RuntimeConfig(runtime_dir=str(tmp_path / "open")))
    assert findings_of("runtime directory", open_to_all).verdict == "error"
    gone = msgspec.structs.replace(healthy, source=SourceConfig(uri="v4l2:/dev/video99"), camera=CAMERA)
    camera = findings_of("camera", gone)
    assert (camera.verdict, "/dev/video99" in camera.found) == ("error", True)


def test_the_doctor_counts_the_cores_of_its_control_group(tmp_path: Path) -> None:
    assert quota(tmp_path) == float("inf")
    (tmp_path / "cpu.max").write_text("150000 100000\n")
    assert quota(tmp_path) == 1.5
    (tmp_path / "cpu.max").write_text("max 100000\n")
    assert quota(tmp_path) == float("inf")


def test_full_disk_costs_only_log_lines() -> None:
    with open("/dev/full", "w") as full:
        live = LiveLine(full)
        live.say("a line")
        live.update("a status")
        assert live.lost == 2
        os.dup2(os.open(os.devnull, os.O_WRONLY), full.fileno())  # what is buffered goes there when it is closed


class Full:
    """Results on a full disk."""

    def add(self, estimate: Estimate) -> None:
        raise OSError(28, "No space left on device")

    def add_map(self, map_update: MapUpdate) -> None:
        raise AssertionError("not after the disk has failed")


class Stalled:
    """Results on a disk that writes nothing before `released`."""

    def __init__(self) -> None:
        self.released = threading.Event()
        self.frames: list[int] = []

    def add(self, estimate: Estimate) -> None:
        assert self.released.wait(60.0)
        self.frames.append(estimate.frame_id)

    def add_map(self, map_update: MapUpdate) -> None:
        """Keeps nothing."""


def send_drive(logbook: Logbook, bus: Bus, frames: int) -> None:
    """Sends the map, the estimates of `frames` frames and END_OF_SOURCE."""
    stamps = {"t_source_ns": 0, "t_capture_ns": 0, "t_utc_ns": 0}
    out, gained = bus.publisher("estimate"), bus.publisher("map")
    assert out.wait_matched(60.0)
    assert gained.wait_matched(60.0)
    gained.put(MapUpdate(epoch=0, frame_id=frames), Trace((Stage("optimize", 1, 2),)))
    for number in range(frames + 1):
        status = (Status.END_OF_SOURCE,) if number == frames else ()
        estimate = Estimate(
            epoch=0, frame_id=number, T_world_ego=SE2(), cov=(0.0,) * 9, valid=not status, status=status, **stamps
        )
        out.put(estimate, Trace((Stage("optimize", 1, 2),)))


def test_a_logbook_survives_a_disk_failure(tmp_path: Path) -> None:
    with Bus("disk", "supervisor", hub=True, runtime_dir=tmp_path) as hub:
        logbook = Logbook(hub, Full(), tolerant=True)
        with Bus("disk", "optimize", runtime_dir=tmp_path) as bus:
            send_drive(logbook, bus, frames=2)
            logbook.wait_over(60.0, 60.0)
        assert logbook.ended
        assert (logbook.recorded, logbook.error) == (2, None)
        assert isinstance(logbook.unwritten, OSError)
        logbook.close()


def test_a_logbook_writes_what_has_arrived_before_a_slow_disk_ends_the_run(tmp_path: Path) -> None:
    with Bus("slow", "supervisor", hub=True, runtime_dir=tmp_path) as hub:
        results = Stalled()
        logbook = Logbook(hub, results)
        with Bus("slow", "optimize", runtime_dir=tmp_path) as bus:
            send_drive(logbook, bus, frames=4)
            until_s = time.monotonic() + 60.0
            while logbook.unread < 4:
                assert time.monotonic() < until_s
            logbook.wait_over(idle_s=0.01, stalled_s=0.01)
            assert not logbook.ended  # it gives up on a disk that does not write
            timer = threading.Timer(1.5, results.released.set)
            timer.start()
            logbook.wait_over(idle_s=1.0, stalled_s=60.0)
            timer.join()
        assert logbook.ended
        assert results.frames == [0, 1, 2, 3]
        logbook.close()


_IMAGES = """
import resource
import numpy as np
for turn in range(100):
    if turn == 20:
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    images = [np.ones(1_400_000 + 10_000 * (turn % 7), dtype=np.uint8) for _ in range(3)]
print((resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before) / 80)
"""


@pytest.mark.processes
def test_a_frame_s_images_cost_no_page_of_the_kernel() -> None:
    """The allocator's settings of the nodes: what a frame's images leave is for those of the next."""
    if platform.libc_ver()[0] != "glibc":
        pytest.skip("these are glibc's settings")
    plain = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")}
    faults = [
        float(subprocess.run([sys.executable, "-c", _IMAGES], env=env, capture_output=True, check=True).stdout)
        for env in (plain, {**plain, **ENVIRONMENT})
    ]
    assert faults[0] > 100
    assert faults[1] < 5


_RESERVED = """
import resource, sys, threading
from birdslam.runtime.process import realtime
if sys.argv[1] == "reserved":
    realtime.reserve(12.0, 4.0)
def drive():
    global faults, kept
    before = resource.getrusage(resource.RUSAGE_THREAD).ru_minflt
    kept = {number: (0.5 * number, 1.5 * number) for number in range(40_000)}
    faults = resource.getrusage(resource.RUSAGE_THREAD).ru_minflt - before
thread = threading.Thread(target=drive)
thread.start()
thread.join()
print(faults)
"""


@pytest.mark.processes
def test_disk_space_can_be_reserved() -> None:
    """Some 8 MiB of objects and a table of 2, made by a thread after the start."""
    plain, reserved = (
        int(subprocess.run([sys.executable, "-c", _RESERVED, how], capture_output=True, check=True).stdout)
        for how in ("plain", "reserved")
    )
    assert plain > 1000
    assert reserved < plain / 4


_PERCEIVES = """
from pathlib import Path
import cv2
from birdslam.runtime.configuration import complete, load
from birdslam.runtime.nodes.inference import Inference
from birdslam.runtime.nodes.nodes import front_end
from birdslam.runtime.nodes.sources import offline_frames, open_source
from birdslam.runtime.process import realtime
from birdslam.runtime.process.child import give_back_memory
def heap_kib():
    parts = Path("/proc/self/smaps").read_text().split("[heap]")[1:]
    return sum(int(part.split("Rss:")[1].split()[0]) for part in parts)
configuration = load(None, {"source.uri": "demo", "source.rate": "max", "source.frames": 120})
source = open_source(configuration)
configuration = complete(configuration, source.camera, source.rate_hz)
cv2.setNumThreads(configuration.perceive.opencv_threads)
with Inference(configuration) as inference:
    frontend = front_end(configuration, inference)
    give_back_memory()
    realtime.reserve_for("perceive", configuration)
    before = heap_kib()
    for frame in offline_frames(source):
        frontend.measure(frame, inference.start(frame))
        inference.finish_frame()
    print(heap_kib() - before)
"""


@pytest.mark.processes
def test_allocations_of_perceive_fit_its_reserve() -> None:
    """Four seconds of the shipped drive; by what did not fit perceive grew for a quarter of an hour, burst by burst."""
    if platform.libc_ver()[0] != "glibc":
        pytest.skip("these are glibc's settings")
    environment = {**os.environ, **ENVIRONMENT}
    grown_kib = subprocess.run([sys.executable, "-c", _PERCEIVES], env=environment, capture_output=True, check=True)
    assert int(grown_kib.stdout) < 1024


_SETTLED = """
import gc
import sys
from birdslam.runtime.process import realtime
gc.collect()  # which empties the store
if sys.argv[1] == "settled":
    realtime.freeze_objects()
before = sys.getallocatedblocks()
for size in range(1, 21):
    tuples = [tuple(range(size)) for _ in range(1_500)]
    del tuples
print(sys.getallocatedblocks() - before)
"""


@pytest.mark.processes
def test_free_lists_are_filled_at_start() -> None:
    """Its store fills in the first half hour else, and looks like a leak."""
    if platform.python_implementation() != "CPython":
        pytest.skip("another Python keeps other things")
    plain, settled = (
        int(subprocess.run([sys.executable, "-c", _SETTLED, how], capture_output=True, check=True).stdout)
        for how in ("plain", "settled")
    )
    assert plain > 15_000
    assert abs(settled) < 1_500
