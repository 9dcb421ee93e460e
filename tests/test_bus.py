"""The bus and the planner's client, over real zenoh sessions on unix sockets in a directory of their own.

Waiting is by events with generous limits; no test asserts how fast something is.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import psutil
import pytest
import zenoh

from birdslam.geometry.se2 import SE2
from birdslam.runtime.client import Planner, Reading
from birdslam.runtime.topology import key_of
from birdslam.runtime.transport.bus import Bus, BusClosed, BusError, MessagesLost, Publisher, Subscriber
from birdslam.runtime.transport.endpoints import MAX_UNPACKED
from birdslam.runtime.transport.presence import VehicleBusy, VehicleLock, ring_path, runtime_dir_of, socket_path
from birdslam.runtime.wire import MAX_MESSAGE_BYTES, Stage, Trace, encode
from birdslam.types import Estimate, FrameRef, MapUpdate, Measurements, Status
from tests.foreign_sender import foreign_session, matched

pytestmark = pytest.mark.processes

ROOT = Path(__file__).parent.parent
LIMIT_S = 60.0


def frame_ref(frame_id: int) -> FrameRef:
    return FrameRef(frame_id=frame_id, t_source_ns=1, t_capture_ns=2, t_utc_ns=3, slot=1, sequence=2)


def estimate(frame_id: int, valid: bool = True, t_capture_ns: int | None = None, status: tuple = ()) -> Estimate:
    return Estimate(
        epoch=0,
        frame_id=frame_id,
        t_source_ns=1,
        t_capture_ns=time.monotonic_ns() if t_capture_ns is None else t_capture_ns,
        t_utc_ns=3,
        T_world_ego=SE2(1.0, 2.0, 0.5),
        cov=(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0),
        valid=valid,
        status=status,
    )


def measurements(frame_id: int) -> Measurements:
    return Measurements(frame_id=frame_id, t_source_ns=1, t_capture_ns=2, t_utc_ns=3)


def received(subscriber: Subscriber, timeout_s: float = LIMIT_S) -> Any:
    message = subscriber.recv(timeout_s)
    assert message is not None, "nothing came"
    return message


def matched_publisher(bus: Bus, topic: str) -> Publisher:
    """A publisher whose subscribers are there."""
    out = bus.publisher(topic)
    assert out.wait_matched(LIMIT_S)
    return out


def send(out: Publisher, records: list[Any], *subscribers: Subscriber) -> None:
    """Waits until the last one has come."""
    for record in records:
        out.put(record)
    for each in subscribers:
        until(lambda each=each: each.newest and each.newest.record == records[-1], "the last record")


def until(condition: Any, what: str) -> None:
    end_s = time.monotonic() + 3.0 * LIMIT_S  # nothing waits so long but on a loaded machine
    while not condition():
        assert time.monotonic() < end_s, what
        time.sleep(0.005)


def test_records_arrive_with_their_traces(join: Any) -> None:
    join("supervisor", hub=True)
    capture, perceive = join("capture"), join("perceive")
    frames, out = perceive.subscriber("frame"), capture.publisher("frame")
    assert out.wait_matched(LIMIT_S)
    assert out.matched
    before_ns = time.monotonic_ns()
    out.put(frame_ref(1))
    message = received(frames)
    assert message.record == frame_ref(1)
    (stage,) = message.trace.stages
    assert stage.node == "capture"
    assert before_ns <= stage.sent_ns <= message.t_received_ns <= time.monotonic_ns()
    out.put(frame_ref(2), Trace((Stage("capture", 5, 6),)).after("perceive", 7, 8))
    first, last = received(frames).trace.stages
    assert first == Stage("capture", 5, 6, 0)
    assert (last.received_ns, last.done_ns) == (7, 8)
    assert last.sent_ns >= before_ns


def test_topics_of_one_sender_keep_their_order(join: Any) -> None:
    """The last map of a run is there before its last estimate, so that nothing waits for it in vain."""
    hub = join("supervisor", hub=True, lossless=True)
    maps, estimates = hub.subscriber("map"), hub.subscriber("estimate")
    optimize = join("optimize", lossless=True)
    send_map, send_estimate = optimize.publisher("map"), optimize.publisher("estimate")
    assert send_map.wait_matched(LIMIT_S)
    assert send_estimate.wait_matched(LIMIT_S)
    points = tuple((float(i), 0.5) for i in range(2_000))
    for frame_id in range(30):
        send_map.put(MapUpdate(epoch=0, frame_id=frame_id, landmarks_m=points))
        send_estimate.put(estimate(frame_id))
        assert received(estimates).record.frame_id == frame_id
        there_already = maps.recv(0.0)
        assert there_already.record.frame_id == frame_id


def test_a_hot_topic_delivers_the_newest_message(join: Any) -> None:
    hub = join("supervisor", hub=True)
    frames = hub.subscriber("frame")
    out = matched_publisher(join("capture", lossless=True), "frame")  # so that zenoh itself drops none of them
    send(out, [frame_ref(k) for k in range(10)], frames)
    assert received(frames).record.frame_id == 9
    assert frames.recv(0.0) is None
    assert frames.dropped == 9


def test_a_bounded_queue_keeps_the_last_and_counts_drops(join: Any) -> None:
    hub = join("supervisor", hub=True)
    queue, short = hub.subscriber("measurements"), hub.subscriber("measurements", depth=2)
    out = matched_publisher(join("perceive", lossless=True), "measurements")
    send(out, [measurements(k) for k in range(20)], queue, short)
    assert [received(queue).record.frame_id for _ in range(8)] == list(range(12, 20))
    assert [received(short).record.frame_id for _ in range(2)] == [18, 19]
    assert (queue.dropped, short.dropped) == (12, 18)


def test_queued_messages_are_kept_as_bytes(join: Any) -> None:
    hub = join("supervisor", hub=True)
    queue = hub.subscriber("measurements", depth=64)
    out = matched_publisher(join("perceive", lossless=True), "measurements")
    send(out, [measurements(k) for k in range(40)], queue)
    waiting = list(queue._queue)  # private: what waits shows in memory alone
    assert sum(not hasattr(each, "record") for each in waiting) == 40 - MAX_UNPACKED
    came = [received(queue) for _ in range(40)]
    assert [message.record for message in came] == [measurements(frame_id) for frame_id in range(40)]
    assert [message.trace.number for message in came] == list(range(1, 41))
    assert queue.dropped == 0


def test_malformed_messages_are_counted(join: Any, base: Path, caplog: pytest.LogCaptureFixture) -> None:
    hub = join("supervisor", hub=True)
    estimates = hub.subscriber("estimate", depth=16)
    out = matched_publisher(join("optimize", lossless=True), "estimate")
    key, good = key_of("car", "estimate"), encode(estimate(1))
    with foreign_session(base) as foreign:

        def put(key: str, data: bytes, attachment: bytes | None = None) -> None:
            block, urgent = zenoh.CongestionControl.BLOCK, zenoh.Priority.REAL_TIME
            foreign.put(key, data, attachment=attachment, congestion_control=block, priority=urgent)

        publisher = foreign.declare_publisher(key)
        until(lambda: matched(publisher), "somebody who subscribes")
        put(key, b"\xc1")
        put(key, b"\x91" * 1_000)
        put(key, good[:-3])
        put(key, bytes(MAX_MESSAGE_BYTES + 1))
        put(key, good, attachment=b"\x91" * 500)  # a good record with a bad trace
        put(key, good, attachment=bytes(900 + 1))
        put("birdslam/car/**", good)  # sent to everything at once
        put("birdslam/*/v1/estimate", good)
        foreign.delete(key, priority=zenoh.Priority.REAL_TIME)
        put(key, bytes(1 << 16))  # this one zenoh itself filters out
        put(key, good)  # without a trace, as a foreign sender may
        assert received(estimates).trace == Trace()
    out.put(estimate(2))
    assert received(estimates).record.frame_id == 2
    assert estimates.recv(0.0) is None
    assert estimates.malformed == 9
    assert estimates.dropped == 0
    assert sum("malformed" in record.message for record in caplog.records) == 1


def test_lost_messages_are_counted(join: Any, base: Path) -> None:
    hub = join("supervisor", hub=True)
    estimates = hub.subscriber("estimate", depth=16)
    out = matched_publisher(join("optimize", lossless=True), "estimate")
    numbers = [("optimize", n) for n in (4, 5, 9, 1, 2)]  # 6 to 8 are lost; then it restarts
    with foreign_session(base) as foreign:
        block, urgent = zenoh.CongestionControl.BLOCK, zenoh.Priority.REAL_TIME
        publisher = foreign.declare_publisher(key_of("car", "estimate"), congestion_control=block, priority=urgent)
        until(lambda: matched(publisher), "somebody who subscribes")
        for node, number in [*numbers, ("another", 7), ("optimize", 3)]:
            publisher.put(encode(estimate(1)), attachment=encode(Trace((Stage(node, 1, 2, 3),), number=number)))
        assert [received(estimates).trace.number for _ in range(7)] == [4, 5, 9, 1, 2, 7, 3]
    assert estimates.dropped == 3
    for frame_id in range(3):
        out.put(estimate(frame_id))
    assert [received(estimates).trace.number for _ in range(3)] == [1, 2, 3]
    assert estimates.dropped == 3


def test_a_duplicate_message_is_received_once(join: Any, base: Path) -> None:
    """Who comes late asks for the last one, and gets it a second time where it was just being sent."""
    estimates = join("supervisor", hub=True).subscriber("estimate", depth=16)
    with foreign_session(base) as foreign:
        block, urgent = zenoh.CongestionControl.BLOCK, zenoh.Priority.REAL_TIME
        publisher = foreign.declare_publisher(key_of("car", "estimate"), congestion_control=block, priority=urgent)
        until(lambda: matched(publisher), "somebody who subscribes")
        for number in (1, 1, 2, 2, 1):  # the last one is of a sender that was started again
            stages = (Stage("optimize", 1, 2, 3 + (number == 1)),)
            publisher.put(encode(estimate(number)), attachment=encode(Trace(stages, number=number)))
        assert [received(estimates).record.frame_id for _ in range(3)] == [1, 2, 1]
    assert estimates.dropped == 0


def test_only_the_topics_own_records_are_sent(join: Any) -> None:
    hub = join("supervisor", hub=True)
    with pytest.raises(TypeError, match="estimate takes Estimate, not FrameRef"):
        hub.publisher("estimate").put(frame_ref(1))
    with pytest.raises(KeyError, match="nonsense"):
        hub.publisher("nonsense")
    with pytest.raises(KeyError, match="nonsense"):
        hub.subscriber("nonsense")
    with pytest.raises(ValueError, match="depth"):
        hub.subscriber("map", depth=0)


def test_lossless_messages_all_arrive_at_a_slow_reader(join: Any) -> None:
    join("supervisor", hub=True, lossless=True)
    frames = join("perceive", lossless=True).subscriber("frame")
    out = matched_publisher(join("capture", lossless=True), "frame")
    sender = threading.Thread(target=lambda: [out.put(frame_ref(frame_id)) for frame_id in range(200)])
    sender.start()
    got = []
    for _ in range(200):
        got.append(received(frames).record.frame_id)
        time.sleep(0.002)
    sender.join(LIMIT_S)
    assert got == list(range(200))
    assert frames.dropped == 0


def test_a_record_that_must_arrive_waits_for_a_full_link(join: Any) -> None:
    frames = join("perceive", hub=True).subscriber("frame", depth=1)
    out = matched_publisher(join("capture"), "frame")
    count = 2_000  # twice what the socket and the queue before it take
    last = threading.Thread(target=out.put, args=(frame_ref(count),), kwargs={"must_arrive": True})
    with frames._arrived:  # private: the reader's thread can't go on
        for frame_id in range(count):
            out.put(frame_ref(frame_id))
        last.start()
        last.join(0.1)
    until(lambda: frames.newest and frames.newest.record.frame_id == count, "the last record")
    last.join(LIMIT_S)
    assert frames.dropped > 0


def test_overflow_of_a_lossless_queue_is_reported(join: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("birdslam.runtime.transport.bus.LOSSLESS_DEPTH", 4)
    hub = join("supervisor", hub=True, lossless=True)
    frames, tolerant = hub.subscriber("frame"), hub.subscriber("frame", may_drop=True)
    out = matched_publisher(join("capture", lossless=True), "frame")
    for frame_id in range(9):
        out.put(frame_ref(frame_id))
    for each in (frames, tolerant):
        until(lambda: each.newest and each.newest.record.frame_id == 8, "the last frame")  # noqa: B023
    with pytest.raises(MessagesLost, match="frame: 5 messages lost behind 4"):
        frames.recv(LIMIT_S)
    assert (received(tolerant).record.frame_id, tolerant.dropped) == (5, 5)


def test_matching_wait_ends_at_timeout_or_subscriber(join: Any) -> None:
    hub = join("supervisor", hub=True)
    out = join("capture").publisher("frame")
    assert not out.wait_matched(0.05)
    assert not out.matched
    out.put(frame_ref(1))  # without subscriber
    frames = hub.subscriber("frame")
    assert out.wait_matched(LIMIT_S)
    frames.close()
    until(lambda: not out.matched, "nobody is left")


def test_liveliness_follows_the_node(join: Any, base: Path) -> None:
    hub = join("supervisor", hub=True)
    seen: list[tuple[str, bool]] = []
    hub.on_alive(lambda node, alive: seen.append((node, alive)))
    capture, perceive = join("capture"), join("perceive")
    assert hub.wait_alive({"capture"}, 0.05) == {"capture"}
    capture.declare_alive()
    capture.declare_alive()
    assert hub.wait_alive({"capture"}, LIMIT_S) == set()
    assert hub.wait_alive({"capture", "perceive"}, 0.05) == {"perceive"}
    threading.Timer(0.05, perceive.declare_alive).start()
    assert hub.wait_alive(["capture", "perceive"], LIMIT_S) == set()
    late = join("planner-1")
    assert late.wait_alive({"capture", "perceive"}, LIMIT_S) == set()
    known: list[tuple[str, bool]] = []
    late.on_alive(lambda node, alive: known.append((node, alive)))
    assert known == [("capture", True), ("perceive", True)]
    capture.close()
    until(lambda: hub.alive == {"perceive"} == late.alive, "capture has left")
    until(lambda: ("capture", False) in seen, "it was called")
    assert seen == [("capture", True), ("perceive", True), ("capture", False)]
    until(lambda: ("capture", False) in known, "the late one was called too")


def test_vehicles_do_not_receive_each_others_messages(base: Path) -> None:
    with (
        Bus("one", "supervisor", hub=True, runtime_dir=base) as one,
        Bus("two", "supervisor", hub=True, runtime_dir=base) as two,
        Bus("two", "capture", runtime_dir=base) as node,
    ):
        wrong, right = one.subscriber("frame"), two.subscriber("frame")
        out = matched_publisher(node, "frame")
        out.put(frame_ref(1))
        assert received(right).record == frame_ref(1)
        assert wrong.recv(0.1) is None


def test_close_wakes_all_waiting_threads(base: Path) -> None:
    hub = Bus("car", "supervisor", hub=True, runtime_dir=base)
    node = Bus("car", "capture", runtime_dir=base)
    frames, out = hub.subscriber("frame"), node.publisher("frame")
    lonely = node.publisher("health/capture")
    assert out.wait_matched(LIMIT_S)
    closed: list[str] = []

    def expect_closed(what: str, wait: Any) -> None:
        with pytest.raises(BusClosed):
            wait()
        closed.append(what)

    waits = {
        "recv": hub.subscriber("measurements").recv,
        "wait_alive": lambda: hub.wait_alive({"perceive"}, LIMIT_S),
        "wait_matched": lambda: lonely.wait_matched(LIMIT_S),
    }
    threads = [threading.Thread(target=expect_closed, args=item) for item in waits.items()]
    flood = threading.Event()

    def send_on() -> None:
        flood.set()
        while True:
            out.put(frame_ref(1))

    # Messages are in the air while both ends close.
    flooding = threading.Thread(target=expect_closed, args=("put", send_on))
    for thread in threads:
        thread.start()
    flooding.start()
    assert flood.wait(LIMIT_S)
    received(frames)
    hub.close()
    node.close()
    hub.close()
    for thread in (*threads, flooding):
        thread.join(LIMIT_S)
        assert not thread.is_alive()
    assert set(closed) == {"recv", "wait_alive", "wait_matched", "put"}
    for action in (
        lambda: frames.recv(0.0),
        lambda: out.put(frame_ref(1)),
        lambda: node.publisher("frame"),
        lambda: hub.subscriber("frame"),
        node.declare_alive,
    ):
        with pytest.raises(BusClosed):
            action()
    assert list((base / "car").iterdir()) == []


# Processes that are killed. Each prints "at work".
SEND = """
import sys
from pathlib import Path
from birdslam.runtime.transport.bus import Bus
from tests.test_bus import estimate
with Bus("car", "optimize", runtime_dir=Path(sys.argv[1])) as bus:
    out = bus.publisher("estimate")
    bus.declare_alive()
    print("ready", flush=True)
    frame_id = int(sys.argv[2])
    for _ in sys.stdin:  # one estimate for each line
        out.put(estimate(frame_id))
        frame_id += 1
"""
HUB = """
import sys
from pathlib import Path
from birdslam.runtime.transport.bus import Bus
from birdslam.runtime.transport.presence import VehicleLock
base = Path(sys.argv[1])
with VehicleLock("car", base), Bus("car", "supervisor", hub=True, runtime_dir=base):
    print("ready", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def spawn(base: Path) -> Iterator[Any]:
    """spawn(code, *arguments) starts a Python process and waits until it is ready; killed after the test."""
    with ExitStack() as stack:

        def spawn(code: str, *arguments: str) -> subprocess.Popen[str]:
            command = [sys.executable, "-c", code, str(base), *arguments]
            process = stack.enter_context(
                subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT, bufsize=1)
            )
            stack.callback(process.kill)
            assert process.stdout.readline() == "ready\n"
            return process

        yield spawn


def kick(process: subprocess.Popen[str]) -> None:
    process.stdin.write("\n")
    process.stdin.flush()


def heard_from(sender: subprocess.Popen[str], generation: int, recv: Any) -> bool:
    """Whether an estimate of this sender came in; one of its dead predecessor may have been waiting."""
    kick(sender)
    message = recv(0.1)
    return message is not None and message.record.frame_id >= 100 * generation


def kill(process: subprocess.Popen[str]) -> None:
    process.send_signal(signal.SIGKILL)
    assert process.wait(LIMIT_S) == -signal.SIGKILL


def test_a_killed_sender_is_noticed_and_its_successor_is_received(join: Any, spawn: Any, base: Path) -> None:
    hub = join("supervisor", hub=True)
    estimates = hub.subscriber("estimate")
    planner = join("planner-1")
    planners_own = planner.subscriber("estimate")
    for generation in range(3):
        sender = spawn(SEND, str(100 * generation))
        assert hub.wait_alive({"optimize"}, LIMIT_S) == set()
        assert planner.wait_alive({"optimize"}, LIMIT_S) == set()
        for subscriber in (planners_own, estimates):
            until(lambda s=sender, r=subscriber, g=generation: heard_from(s, g, r.recv), "the successor is heard")
        kill(sender)
        until(lambda: not hub.alive and not planner.alive, "it is seen to be dead")


def test_a_restarted_hub_reconnects_to_all_nodes(join: Any, spawn: Any, base: Path) -> None:
    first = spawn(HUB)
    capture, perceive = join("capture"), join("perceive")
    frames, out = perceive.subscriber("frame"), capture.publisher("frame")
    assert out.wait_matched(LIMIT_S)
    kill(first)
    out.put(frame_ref(1))  # the nodes need no hub among themselves
    assert received(frames).record == frame_ref(1)
    capture.declare_alive()
    assert socket_path(base / "car", "hub").exists()  # left behind by the kill
    spawn(HUB)
    late = join("planner-1")
    assert late.wait_alive({"capture"}, LIMIT_S) == set()
    late_frames = late.subscriber("frame")
    until(lambda: out.put(frame_ref(2)) or late_frames.recv(0.1), "the latecomer hears capture")


def test_a_planner_survives_restarts(base: Path, spawn: Any) -> None:
    with Planner("car", base) as planner:
        nothing = planner.latest()
        assert nothing == Reading(None, alive=False, on_time=False, valid=False, age_ms=float("inf"))
        assert not nothing.usable
        assert planner.wait(0.05) is None
        hub = spawn(HUB)
        for generation in range(2):
            sender = spawn(SEND, str(100 * generation))
            until(lambda s=sender, g=generation: heard_from(s, g, planner.wait_message), "the successor is heard")
            until(lambda: planner.latest(1e6).alive, "the optimizer is alive")
            reading = planner.latest(max_age_ms=1e6)
            assert reading.usable
            assert reading.estimate.frame_id >= 100 * generation
            assert reading.age_ms >= 0.0
            kill(sender)
            until(lambda: not planner.latest(1e6).alive, "the optimizer is dead")
            dead = planner.latest(1e6)
            assert dead.estimate is not None
            assert dead.valid
            assert dead.on_time
            assert not dead.usable
        kill(hub)


def test_alive_on_time_and_valid_are_independent(join: Any, base: Path) -> None:
    join("supervisor", hub=True)
    optimize = join("optimize")
    out = optimize.publisher("estimate")
    with Planner("car", base) as planner:
        assert out.wait_matched(LIMIT_S)

        def reading_of(sent: Estimate, max_age_ms: float = 1e6) -> tuple[bool, bool, bool]:
            out.put(sent)
            assert planner.wait(LIMIT_S) == sent
            reading = planner.latest(max_age_ms)
            assert reading.estimate == sent
            return reading.alive, reading.on_time, reading.valid

        assert reading_of(estimate(1)) == (False, True, True)
        optimize.declare_alive()
        until(lambda: planner.latest().alive, "the optimizer is alive")
        assert reading_of(estimate(2)) == (True, True, True)
        assert reading_of(estimate(3, valid=False)) == (True, True, False)
        assert reading_of(estimate(4, status=(Status.SCALE_INVALID,))) == (True, True, False)
        assert reading_of(estimate(5, status=(Status.STANDSTILL,))) == (True, True, True)
        second_ago_ns = time.monotonic_ns() - 1_000_000_000
        assert reading_of(estimate(6, t_capture_ns=second_ago_ns), max_age_ms=999.0) == (True, False, True)
        # A capture in the future is no time of this machine.
        hour_ahead_ns = time.monotonic_ns() + 3_600_000_000_000
        assert reading_of(estimate(7, t_capture_ns=hour_ahead_ns)) == (True, False, True)


def test_a_planner_iterates_until_it_is_closed(join: Any, base: Path) -> None:
    join("supervisor", hub=True)
    out = join("optimize").publisher("estimate")
    planner = Planner("car", base)
    got: list[int] = []
    heard = threading.Semaphore(0)

    def drive() -> None:
        for reading in planner.estimates(60_000.0):
            got.append(reading.estimate.frame_id)
            heard.release()

    thread = threading.Thread(target=drive)
    thread.start()
    assert out.wait_matched(LIMIT_S)
    for frame_id in range(5):
        out.put(estimate(frame_id))
        assert heard.acquire(timeout=LIMIT_S)
    planner.close()
    planner.close()
    thread.join(LIMIT_S)
    assert not thread.is_alive()
    assert got == list(range(5))
    with pytest.raises(BusClosed):
        planner.wait(0.0)


def test_a_second_instance_is_rejected_while_the_first_runs(base: Path, spawn: Any) -> None:
    first = spawn(HUB)
    with pytest.raises(VehicleBusy, match=f"'car' already runs: process {first.pid}, lock file .*/car/lock"):
        VehicleLock("car", base)
    with VehicleLock("other", base):
        pass
    ring = ring_path("car", base)
    ring.write_bytes(b"left by a capture that was killed")
    kill(first)
    directory = base / "car"
    alive = Bus("car", "perceive", runtime_dir=base)  # a process that outlived its supervisor
    assert socket_path(directory, "hub").exists()
    with VehicleLock("car", base) as lock:
        assert sorted(path.name for path in directory.iterdir()) == ["lock", "perceive.sock", "perceive.sock.lock"]
        assert not ring.exists()
        assert lock.path.read_text() == f"{os.getpid()}\n"
        with pytest.raises(VehicleBusy, match=f"process {os.getpid()}"):
            VehicleLock("car", base)
    lock.close()
    alive.close()
    with VehicleLock("car", base):
        pass


def test_running_node_is_named(join: Any, base: Path) -> None:
    join("capture")
    with pytest.raises(BusError, match=r"capture can't join the bus of vehicle 'car' .*capture\.sock"):
        Bus("car", "capture", runtime_dir=base)


def test_invalid_names_and_directories_are_named(base: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="vehicle 'a/b'"):
        Bus("a/b", "capture", runtime_dir=base)
    with pytest.raises(ValueError, match="node 'x\\*'"):
        Bus("car", "x*", runtime_dir=base)
    deep = base / ("d" * 60) / ("e" * 60)
    with pytest.raises(ValueError, match=r"107 B of a unix socket"):
        Bus("car", "capture", runtime_dir=deep)
    (base / "open").mkdir(mode=0o755)
    (base / "open").chmod(0o755)
    (base / "link").symlink_to(base / "open")
    for vehicle in ("open", "link"):
        with pytest.raises(PermissionError, match=f"{vehicle} must be a directory of user"):
            runtime_dir_of(vehicle, base)
    (base / "file").write_text("")
    with pytest.raises(FileExistsError, match="file"):
        runtime_dir_of("file", base)


def test_the_default_directory_is_private(base: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(base))
    directory = runtime_dir_of("car")
    assert directory == base / "birdslam" / "car"
    assert directory.stat().st_mode & 0o777 == 0o700
    assert directory.parent.stat().st_mode & 0o777 == 0o700
    assert ring_path("car") != ring_path("car", base / "elsewhere")
    assert ring_path("car") == ring_path("car")


@pytest.mark.parametrize("end", ["", "raise KeyboardInterrupt"], ids=["ends", "interrupted"])
def test_process_with_open_bus_exits_quietly(join: Any, base: Path, end: str) -> None:
    """zenoh's threads never call into an interpreter that has ended, which panics, or is a segmentation fault."""
    join("supervisor", hub=True)
    optimize = join("optimize")
    out, over = optimize.publisher("estimate"), threading.Event()
    optimize.declare_alive()

    def flood() -> None:
        while not over.wait(0.0005):
            out.put(estimate(1))

    thread = threading.Thread(target=flood)
    thread.start()
    try:
        code = f"from birdslam.runtime.client import *; planner = Planner('car', Path({str(base)!r})); {end}"
        for _ in range(2):
            done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=60)
            interrupted = "Interrupt" in end
            assert done.returncode == (-signal.SIGINT if interrupted else 0), done.stderr
            assert done.stderr.splitlines()[-1:] == (["KeyboardInterrupt"] if interrupted else [])
            assert "panicked" not in done.stderr
    finally:
        over.set()
        thread.join()


def test_nothing_listens_beyond_the_machine(join: Any, base: Path) -> None:
    join("supervisor", hub=True)
    node, guest = join("capture"), join("planner-1")
    node.declare_alive()
    assert guest.wait_alive({"capture"}, LIMIT_S) == set()
    with foreign_session(base) as foreign:
        until(lambda: len(foreign.info.links()) == 2, "links to the hub, and to the node that the hub told of")
        assert all("src: unixsock-stream/" in str(link) for link in foreign.info.links())
        assert psutil.Process().net_connections(kind="inet") == []
