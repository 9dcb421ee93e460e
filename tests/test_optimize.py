"""The optimize node alone: frames without an answer from perceive, and state after a restart."""

from __future__ import annotations

import time
from collections import deque
from functools import cache
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from birdslam.geometry.se2 import SE2
from birdslam.graph.pose_graph import PoseGraph
from birdslam.perf.latency.drive import DriveConfig, drive
from birdslam.runtime.configuration import BudgetsConfig, Configuration, DegradationConfig, RuntimeConfig, SourceConfig
from birdslam.runtime.nodes.checkpoints import MAX_BYTES, CheckpointFile, newest_checkpoint
from birdslam.runtime.nodes.coasting import Overdue, PendingFrames, deadline_ns, unmeasured
from birdslam.runtime.nodes.optimize import OptimizeNode
from birdslam.runtime.process.restarts import FIRST, Assignment, Resume
from birdslam.runtime.transport.bus import Message
from birdslam.runtime.wire import Trace
from birdslam.types import INVALIDATING, Attitude, Estimate, FrameRef, Measurements, Status
from tests.fake_bus import FakeBus

MS = 1_000_000
HEAD_BYTES = 64  # of a checkpoint in its file, before its data; first its number, which is written last
DRIVE = drive(DriveConfig(frames=60, vehicles=3, traffic="convoy"), 1).measurements
CALM = Configuration().slam


class Bus(FakeBus):
    """`past` is what perceive still has."""

    def __init__(self, past: tuple[Measurements, ...] = (), alive: bool = True) -> None:
        super().__init__()
        self._past, self._alive = past, alive

    def wait_alive(self, nodes: set[str], timeout_s: float) -> set[str]:
        return set() if self._alive else set(nodes)

    def retained(self, topic: str, timeout_s: float) -> list[Message]:
        return [Message(record, Trace(), 0) for record in self._past]


def configuration(place: Path | None, checkpoint_ms: float = 1e-3, **changes: Any) -> Configuration:
    runtime = RuntimeConfig(runtime_dir=str(place or ""), checkpoint_ms=checkpoint_ms)
    return Configuration(vehicle="test", runtime=runtime, **changes)


def ref(frame_id: int, t_capture_ns: int = 0, status: tuple[Status, ...] = ()) -> FrameRef:
    return FrameRef(
        frame_id=frame_id,
        t_source_ns=DRIVE[0].t_source_ns + frame_id * 30 * MS,
        t_capture_ns=t_capture_ns,
        t_utc_ns=0,
        status=status,
    )


def announce(bus: Bus, frame_id: int, t_capture_ns: int) -> None:
    bus.inboxes["frame"].come(ref(frame_id, t_capture_ns), t_capture_ns)


def estimates(node: OptimizeNode, record: Any) -> list[Estimate]:
    return [made for made in node.step(record) if isinstance(made, Estimate)]


@cache
def _alone() -> list[Estimate]:
    graph = PoseGraph(CALM.graph, CALM.weights)
    return [graph.optimise(record) for record in DRIVE]


def alone(frames: int) -> list[Estimate]:
    """The graph's estimates of the first frames if all measurements arrive in time."""
    return _alone()[:frames]


def test_a_frame_is_overdue_when_its_estimate_could_not_come_in_time() -> None:
    budgets = BudgetsConfig(end_to_end_ms=150.0, optimize_ms=12.0, optimize_to_planner_ms=8.0)
    assert deadline_ns(Configuration(budgets=budgets)) == 130 * MS
    announced = PendingFrames(130 * MS)
    assert announced.wait_s(0) == pytest.approx(0.13)
    for frame_id in range(3):
        announced.add(Message(ref(frame_id, 1000 * MS + frame_id * 30 * MS), Trace(), 0))
    assert announced.wait_s(1100 * MS) == pytest.approx(0.03)
    assert announced.overdue(1129 * MS) is None
    late = announced.overdue(1165 * MS)  # of two that are, the newer one
    assert late.record.ref.frame_id == 1
    assert announced.overdue(1165 * MS) is None
    announced.answered(7)
    assert announced.overdue(10_000 * MS) is None


def test_a_frame_that_was_answered_before_it_was_announced_is_never_overdue() -> None:
    announced = PendingFrames(MS)
    announced.answered(7)
    for frame_id in (6, 7):
        announced.add(Message(ref(frame_id, 0), Trace(), 0))
    assert announced.overdue(10**12) is None
    announced.add(Message(ref(8, 0), Trace(), 0))
    late = announced.overdue(10**12)
    assert late.record.ref.frame_id == 8


def test_end_of_source_is_not_awaited() -> None:
    announced = PendingFrames(MS)
    announced.add(Message(ref(0, 0, (Status.END_OF_SOURCE,)), Trace(), 0))
    assert announced.overdue(10**12) is None


def test_silent_perceive_leads_to_coasting_then_invalid(tmp_path: Path) -> None:
    bus = Bus()
    node = OptimizeNode(configuration(tmp_path, degradation=DegradationConfig(coast_max_ms=100.0)), bus)
    measured = [made for record in DRIVE[:20] for made in estimates(node, record)]
    assert measured == alone(20)
    coasted = []
    for frame_id in range(20, 26):
        announce(bus, frame_id, time.monotonic_ns() - 1000 * MS)
        late = node.receive(0.0)
        assert isinstance(late.record, Overdue)
        coasted += estimates(node, late.record)
    assert [made.frame_id for made in coasted] == list(range(20, 26))
    assert all({Status.COASTING, Status.PERCEPTION_LATE} <= set(made.status) for made in coasted)
    spread = [made.cov[0] + made.cov[4] for made in (measured[-1], *coasted)]
    assert spread == sorted(set(spread))  # it grows with each
    since_ns = [made.t_source_ns - measured[-1].t_source_ns for made in coasted]
    assert [Status.COASTED_TOO_LONG in made.status for made in coasted] == [since > 100 * MS for since in since_ns]
    assert [made.valid for made in coasted] == [since <= 100 * MS for since in since_ns]
    assert node.mode == "coasting"
    assert node.counters()["coasted"] == 6
    assert estimates(node, DRIVE[26])[0].frame_id == 26
    assert node.mode == "full"


def test_coasting_keeps_invalid_estimates_invalid() -> None:
    last = msgspec.structs.replace(alone(2)[-1], status=(Status.STANDSTILL, Status.SCALE_INVALID))
    told = unmeasured(ref(2), last, 10**12)
    assert told.status == (Status.COASTING, Status.PERCEPTION_LATE, Status.SCALE_INVALID)
    assert Status.NOT_INITIALISED in unmeasured(ref(2), None, 10**12).status
    uphill = msgspec.structs.replace(last, attitude=Attitude(z_m=5.0, pitch_rad=-0.03))
    assert unmeasured(ref(2), uphill, 10**12).attitude == uphill.attitude  # no jump in 6-DoF trajectories
    assert Status.FRAME_UNREADABLE in unmeasured(ref(2, 0, (Status.FRAME_UNREADABLE,)), last, 10**12).status


def test_at_rate_max_every_frame_is_waited_for() -> None:
    bus = Bus()
    OptimizeNode(Configuration(source=SourceConfig(rate="max")), bus)
    assert set(bus.inboxes) == {"measurements"}


def test_late_measurements_correct_the_published_estimate(tmp_path: Path) -> None:
    node = OptimizeNode(configuration(tmp_path), Bus())
    for record in DRIVE[:10]:
        estimates(node, record)
    goal = alone(14)
    (guessed,) = estimates(node, Overdue(ref(12)))
    (better,) = estimates(node, DRIVE[10])  # two frames late: relative to the newest published frame
    assert (guessed.frame_id, better.frame_id) == (12, 12)
    assert Status.PERCEPTION_LATE in better.status
    step, passed_ns = DRIVE[10].cc, DRIVE[10].t_source_ns - DRIVE[9].t_source_ns
    way = SE2.exp(step.T_from_to.log() * (better.t_source_ns - goal[10].t_source_ns) / passed_ns)
    assert better.T_world_ego == (goal[10].T_world_ego @ way) != guessed.T_world_ego
    assert node.counters()["outrun"] == 1
    assert estimates(node, DRIVE[11])[0].frame_id == 12
    assert estimates(node, DRIVE[12]) == [goal[12]]  # the same frame again, and now measured
    assert estimates(node, DRIVE[13]) == [goal[13]]


@given(st.lists(st.integers(0, 9), min_size=40, max_size=40), st.integers(0, 2**32))
@settings(max_examples=10)
def test_published_frame_numbers_never_fall(lateness: list[int], seed: int) -> None:
    """Measurements come in their order, each so many frames late; a frame is coasted over when it has waited two."""
    node = OptimizeNode(Configuration(source=SourceConfig(rate="max")), Bus())
    goal = alone(40)
    told: list[Estimate] = []
    waiting: deque[int] = deque()
    due = 0
    for frame_id in range(60):
        if frame_id < 40:
            waiting.append(frame_id)
            due = max(due, frame_id + lateness[frame_id])
        if waiting and frame_id - waiting[0] >= 2 and frame_id - 2 > (told[-1].frame_id if told else -1):
            told += estimates(node, Overdue(ref(min(frame_id - 2, 39))))
        while waiting and waiting[0] + lateness[waiting[0]] <= frame_id:
            told += estimates(node, DRIVE[waiting.popleft()])
    frames = [made.frame_id for made in told]
    assert frames == sorted(frames)
    measured = [made for made in told if Status.PERCEPTION_LATE not in made.status]
    assert all(made == goal[made.frame_id] for made in measured)
    assert all(made.valid == INVALIDATING.isdisjoint(made.status) for made in told)
    (then,) = estimates(node, DRIVE[40])  # and none that was late has left a trace in the graph
    assert then == alone(41)[40]


def after(frame_id: int) -> Assignment:
    """The input of the next process if that frame was the last one sent."""
    return Assignment(1, "was killed by SIGKILL", Resume(frame_id + 1, 0, 0))


def killed_at(place: Path, frames: int) -> list[Estimate]:
    node = OptimizeNode(configuration(place), Bus())
    return [made for record in DRIVE[:frames] for made in estimates(node, record)]


def test_a_killed_optimizer_resumes_from_its_checkpoint(tmp_path: Path) -> None:
    before = killed_at(tmp_path, 20)
    bus = Bus(past=DRIVE[5:23])
    node = OptimizeNode(configuration(tmp_path), bus, after(19))
    for record in DRIVE[21:30]:  # some twice
        bus.inboxes["measurements"].come(record)
    told: list[Estimate] = []
    while (message := node.receive(0.0)) is not None:
        told += estimates(node, message.record)
    assert Status.GRAPH_RESTORED in told[0].status
    told[0] = msgspec.structs.replace(told[0], status=tuple(s for s in told[0].status if s != Status.GRAPH_RESTORED))
    assert before + told == alone(30)


def test_measurements_since_an_older_checkpoint_are_added_and_not_published_twice(tmp_path: Path) -> None:
    killed_at(tmp_path, 15)
    node = OptimizeNode(configuration(tmp_path), Bus(past=DRIVE[:23]), after(19))
    told = []
    while (message := node.receive(0.0)) is not None:
        told += estimates(node, message.record)
    assert [made.frame_id for made in told] == [20, 21, 22]
    assert [made.T_world_ego for made in told] == [made.T_world_ego for made in alone(23)[20:]]


@pytest.mark.parametrize("gap", ["perceive is gone", "too long", "nothing kept"])
def test_gap_in_measurements_starts_a_new_epoch(tmp_path: Path, gap: str) -> None:
    killed_at(tmp_path, 20)
    bus = Bus(alive=gap != "perceive is gone", past=DRIVE[25:30] if gap == "too long" else ())
    node = OptimizeNode(configuration(tmp_path), bus, after(19))
    message = node.receive(0.0)
    (first,) = estimates(node, DRIVE[30] if message is None else message.record)
    assert Status.GRAPH_RESET in first.status
    assert first.epoch == 1


def test_checkpoint_of_an_older_epoch_is_not_restored(tmp_path: Path) -> None:
    once = configuration(tmp_path, checkpoint_ms=1e9)  # of the first frame, and no more
    node = OptimizeNode(once, Bus())
    for record in DRIVE[:10]:
        estimates(node, record)
    for made in (msgspec.structs.replace(DRIVE[20], cc=None), *DRIVE[21:23]):
        assert estimates(node, made)[0].epoch == 1
    again = OptimizeNode(configuration(tmp_path), Bus(past=DRIVE[1:23]), after(22))
    (first,) = estimates(again, DRIVE[23])
    assert (first.epoch, Status.GRAPH_RESET in first.status) == (2, True)


def test_first_process_and_other_configuration_start_fresh(tmp_path: Path) -> None:
    killed_at(tmp_path, 20)
    other = msgspec.structs.replace(CALM, graph=msgspec.structs.replace(CALM.graph, ego_nodes=7))
    node = OptimizeNode(configuration(tmp_path, slam=other), Bus(past=DRIVE[15:23]), after(19))
    assert node.receive(0.0) is None
    assert estimates(node, DRIVE[20])[0].epoch == 1
    killed_at(tmp_path, 20)
    node = OptimizeNode(configuration(tmp_path), Bus(past=DRIVE[15:23]), FIRST)
    assert node.receive(0.0) is None
    assert estimates(node, DRIVE[20])[0].epoch > 1


def test_checkpoint_that_crashes_is_used_once(tmp_path: Path) -> None:
    killed_at(tmp_path, 20)
    for restored in (True, False):  # the first of them dies before it has kept another
        node = OptimizeNode(configuration(tmp_path), Bus(past=DRIVE[15:23]), after(19))
        assert (node.receive(0.0) is not None) == restored  # what has come since the checkpoint


def overwrite(path: Path, start: int, data: bytes) -> None:
    with path.open("r+b") as file:
        file.seek(start)
        file.write(data)


def test_kill_leaves_one_valid_checkpoint(tmp_path: Path) -> None:
    path = tmp_path / "c"
    file = CheckpointFile(path)
    assert file.take() == []
    for number in range(5):
        assert file.store(number, 7, bytes([number]) * 100)
    assert [(kept.frame_id, kept.epoch, kept.data) for kept in CheckpointFile(tmp_path / "c").take()] == [
        (4, 7, b"\4" * 100),
        (3, 7, b"\3" * 100),
    ]
    assert CheckpointFile(tmp_path / "c").take() == []
    file.store(5, 7, b"a")
    file.store(6, 7, b"b")
    content = path.read_bytes()
    overwrite(path, content.index(b"b") - HEAD_BYTES, bytes(8))  # killed in the middle of it
    assert [kept.data for kept in CheckpointFile(path).take()] == [b"a"]
    assert not file.store(7, 7, bytes(MAX_BYTES + 1))
    assert (tmp_path / "c").stat().st_mode & 0o777 == 0o600


def test_another_process_may_read_the_newest_checkpoint(tmp_path: Path) -> None:
    path = tmp_path / "c"
    assert newest_checkpoint(path) is None
    file = CheckpointFile(path)
    assert newest_checkpoint(path) is None
    for frame_id in range(5):
        file.store(frame_id, 1, bytes([frame_id]) * (frame_id + 1))
        found = newest_checkpoint(path)
        assert (found.frame_id, found.epoch, found.data) == (frame_id, 1, bytes([frame_id]) * (frame_id + 1))
    assert [kept.frame_id for kept in CheckpointFile(path).take()] == [4, 3]
    assert newest_checkpoint(path) is None
    path.write_bytes(b"no such file")
    assert newest_checkpoint(path) is None


def test_damaged_checkpoint_is_skipped(tmp_path: Path) -> None:
    killed_at(tmp_path, 20)
    path = tmp_path / "test" / "checkpoint"
    kept = newest_checkpoint(path)
    overwrite(path, path.read_bytes().index(kept.data) + 200, bytes([77]) * 30)
    node = OptimizeNode(configuration(tmp_path), Bus(past=DRIVE[10:23]), after(19))
    message = node.receive(0.0)
    assert message.record.frame_id == 19  # it goes on from the one before it
