"""Restarts: when, how often, and the state that a new process takes over; lines of the journal."""

from __future__ import annotations

import io
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import msgspec
import psutil
import pytest
from hypothesis import given
from hypothesis import strategies as st

from birdslam.runtime.configuration import Configuration, RuntimeConfig, SourceConfig
from birdslam.runtime.process.notify import Notifier
from birdslam.runtime.process.restarts import EpochFile, Restarts, Resume
from birdslam.runtime.process.vitals import Vitals
from birdslam.runtime.supervision.journal import Journal, Priority, journal_of
from birdslam.runtime.supervision.live import LiveLine
from birdslam.runtime.supervision.processes import waited_s
from birdslam.runtime.supervision.stations import MAX_MISSED_RECORDS, Intake, Silence
from tests.test_bus import until

CONFIG = RuntimeConfig(restarts_max=3, restart_window_s=10.0, restart_backoff_ms=100.0, restart_backoff_max_ms=150.0)


@pytest.fixture
def vitals() -> Vitals:
    return Vitals()


def test_restart_delay_grows_to_a_limit(vitals: Vitals) -> None:
    restarts = Restarts(CONFIG)
    due_s = [restarts.died(100.0 + number, "killed", vitals) for number in range(4)]
    assert due_s == [100.0, 101.1, pytest.approx(102.15), None]
    assert (restarts.count, restarts.cause) == (3, "killed")
    assert restarts.assignment().restarts == 3


def test_old_restarts_do_not_count(vitals: Vitals) -> None:
    restarts = Restarts(CONFIG)
    for number in range(20):
        assert restarts.died(11.0 * number, "killed", vitals) == 11.0 * number
    assert restarts.count == 20


def test_a_restarted_node_resumes_after_the_last_frame(vitals: Vitals) -> None:
    restarts = Restarts(CONFIG)
    restarts.died(0.0, "first", vitals)
    assert restarts.assignment().resume is None
    vitals.count(next_frame=42, t_source_ns=7, t_capture_ns=8)
    restarts.died(0.0, "second", vitals)
    restarts.died(0.0, "before its first frame", Vitals())
    assignment = restarts.assignment()
    assert assignment.resume == Resume(42, 7, 8)
    assert msgspec.json.decode(msgspec.json.encode(assignment), type=type(assignment)) == assignment


@pytest.mark.parametrize(
    ("rate", "restart", "restarts"),
    [(None, None, True), (33.0, None, True), ("max", None, False), (None, "never", False), ("max", "always", True)],
)
def test_lossless_run_is_not_restarted(rate: object, restart: object, restarts: bool) -> None:
    configuration = Configuration(
        source=SourceConfig(rate=rate),
        runtime=RuntimeConfig(restart=restart),
    )
    assert (configuration.restarts, configuration.spares) == (restarts, restarts)


def test_epoch_grows_with_every_restart(tmp_path: Path) -> None:
    path = tmp_path / "epoch"
    first = EpochFile(path)
    assert first.last == -1
    first.store(0)
    first.store(3)
    first.store(2)
    assert EpochFile(path).last == 3  # the one before was never closed
    assert path.stat().st_mode & 0o777 == 0o600


@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 1)), max_size=60))
def test_node_that_receives_is_not_restarted(steps: list[tuple[int, int]]) -> None:
    intake, sent, taken, since = Intake(), 0, 0, 0
    intake.missed(0, 0, 0.0, 0.0, 1.0)
    for second, (more, heard) in enumerate(steps, start=1):
        sent += more
        taken += heard
        since = sent if heard else since
        missed = intake.missed(sent, taken, 0.1, float(second), 1.5)
        assert missed in (0, sent - since)
        assert bool(missed) <= (sent - since >= MAX_MISSED_RECORDS)


def test_silence_is_not_a_missed_record() -> None:
    intake = Intake()
    assert not any(intake.missed(5, 5, 0.1, float(second), 1.0) for second in range(100))
    assert intake.missed(5 + MAX_MISSED_RECORDS, 5, 0.1, 100.0, 1.0) == MAX_MISSED_RECORDS
    assert intake.missed(2, 5, 0.1, 101.0, 1.0) == 0  # the sender restarted


def test_stalled_loop_misses_nothing_before_the_limit() -> None:
    intake = Intake()
    intake.missed(0, 7, 0.0, 0.0, 1.5)  # it took its last record, and went on beating for a moment
    told = [intake.missed(10 * k, 7, 0.1 * k - 0.2, 0.1 * k, 1.5) for k in range(3, 17)]
    assert not any(told)  # at 1.5 s without a beat it is stalled
    assert intake.missed(170, 7, 0.05, 1.7, 1.5) == 170  # it only was slow, and has beaten since


def test_loop_waiting_for_a_core_is_not_silent() -> None:
    silence = Silence()
    assert silence.own_s(1, 0.0, {7: 5.0}) == 0.0  # it waited before, and has beaten since
    assert silence.own_s(1, 40.0, {7: 44.0}) == 1.0  # all others went first
    assert silence.own_s(1, 80.0, {7: 44.0}) == 41.0  # then it stood still by itself
    assert silence.own_s(2, 3.0, {7: 44.0}) == 3.0


def test_loop_blocked_by_a_thread_waiting_for_a_core_is_not_silent() -> None:
    """zenoh's threads take the interpreter's lock for each message, and at load 13 wait with it."""
    silence = Silence()
    silence.own_s(1, 0.0, {7: 5.0, 8: 2.0})
    assert silence.own_s(1, 1.0, {7: 5.1, 8: 2.9}) == pytest.approx(0.1)
    assert silence.own_s(1, 2.0, {7: 6.1, 8: 2.9}) == pytest.approx(0.1)  # then it waited itself
    assert silence.own_s(1, 3.0, {7: 6.1, 8: 2.9, 9: 50.0}) == pytest.approx(1.1)  # a new thread has waited for nothing


def test_late_check_does_not_count_as_silence() -> None:
    """At load 13 who looks waits for a core as well."""
    silence = Silence()
    silence.own_s(1, 0.0, {7: 5.0})
    assert silence.own_s(2, 1.5, {7: 6.4}) == pytest.approx(0.1)


@pytest.mark.processes
def test_waiting_time_for_a_core_is_read_from_linux() -> None:
    spin = "import os; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\nwhile True: pass"

    def waited(process: subprocess.Popen[bytes]) -> float:
        return waited_s(process.pid).get(process.pid, 0.0)

    spinning, stopped = (subprocess.Popen([sys.executable, "-c", spin]) for _ in range(2))
    try:
        until(lambda: min(waited(spinning), waited(stopped)) > 0.05, "two on one core wait in turn")
        stopped.send_signal(signal.SIGSTOP)
        until(lambda: psutil.Process(stopped.pid).status() == psutil.STATUS_STOPPED, "it is stopped")
        before_s, ran_s = waited(stopped), psutil.Process(spinning.pid).cpu_times().user
        until(lambda: psutil.Process(spinning.pid).cpu_times().user > ran_s + 0.05, "the other goes on")
        assert waited(stopped) == before_s
    finally:
        for process in (spinning, stopped):
            process.kill()
            process.wait()


@pytest.fixture
def systemd(tmp_path: Path) -> socket.socket:
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    listener.bind(str(tmp_path / "notify"))
    listener.settimeout(60.0)
    yield listener
    listener.close()


def test_systemd_is_notified(systemd: socket.socket, monkeypatch: pytest.MonkeyPatch) -> None:
    clock_s = [100.0]
    monkeypatch.setattr("birdslam.runtime.process.notify.time", SimpleNamespace(monotonic=lambda: clock_s[0]))
    notifier = Notifier({"NOTIFY_SOCKET": systemd.getsockname(), "WATCHDOG_USEC": "300000"})
    assert notifier.period_s == pytest.approx(0.1)
    notifier.once("READY=1")
    notifier.once("READY=1")
    notifier.alive("frame 7")
    notifier.alive("not due yet")
    clock_s[0] += 0.11
    notifier.alive("frame 9")
    notifier.once("STOPPING=1")
    said = [systemd.recv(4096).decode() for _ in range(4)]
    assert said == ["READY=1", "WATCHDOG=1\nSTATUS=frame 7", "WATCHDOG=1\nSTATUS=frame 9", "STOPPING=1"]


def test_without_systemd_nothing_is_sent() -> None:
    notifier = Notifier({})
    assert notifier.period_s is None
    notifier.once("READY=1")
    notifier.alive("x")


def test_watchdog_of_another_process_is_ignored(systemd: socket.socket) -> None:
    environment = {"NOTIFY_SOCKET": systemd.getsockname(), "WATCHDOG_USEC": "300000", "WATCHDOG_PID": str(os.getppid())}
    notifier = Notifier(environment)
    assert notifier.period_s is None
    notifier.alive("x")
    assert systemd.recv(4096) == b"STATUS=x"


def test_a_lost_systemd_socket_does_not_stop_the_run(tmp_path: Path) -> None:
    Notifier({"NOTIFY_SOCKET": str(tmp_path / "nobody")}).once("READY=1")


@pytest.fixture
def reader(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[socket.socket, str]]:
    """A socket that receives entries, and its address."""
    address = str(tmp_path_factory.mktemp("j") / "socket")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as end:
        end.bind(address)
        end.settimeout(60.0)
        yield end, address


def entry(reader: socket.socket) -> dict[str, str]:
    """The fields of the next entry, by the rules of systemd's native protocol."""
    data, fields = reader.recv(1 << 16), {}
    while data:
        line, _, rest = data.partition(b"\n")
        name, equals, value = line.partition(b"=")
        if not equals:
            size = int.from_bytes(rest[:8], "little")
            value, rest = rest[8 : 8 + size], rest[9 + size :]
        fields[name.decode()] = value.decode()
        data = rest
    return fields


def test_an_entry_has_its_fields_and_lines(reader: tuple[socket.socket, str]) -> None:
    end, address = reader
    Journal(address).send("two\nlines = 2", Priority.WARNING, BIRDSLAM_NODE="perceive")
    expected = {"PRIORITY": "4", "SYSLOG_IDENTIFIER": "birdslam", "BIRDSLAM_NODE": "perceive"}
    assert entry(end) == {"MESSAGE": "two\nlines = 2", **expected}


def test_missing_journal_does_not_stop_the_run(tmp_path: Path) -> None:
    Journal(str(tmp_path / "none")).send("lost", Priority.INFO)


def test_journal_is_used_if_the_stream_is_connected_to_it(tmp_path: Path) -> None:
    with (tmp_path / "out").open("w") as stream:
        state = os.fstat(stream.fileno())
        assert journal_of(stream, {"JOURNAL_STREAM": f"{state.st_dev}:{state.st_ino}"}) is not None
        assert journal_of(stream, {"JOURNAL_STREAM": f"{state.st_dev}:{state.st_ino + 1}"}) is None
        assert journal_of(stream, {"JOURNAL_STREAM": "nonsense"}) is None
        assert journal_of(stream, {}) is None
    assert journal_of(io.StringIO(), {"JOURNAL_STREAM": "1:1"}) is None
    assert journal_of(sys.stdout, {}) is None


def test_output_of_a_node_is_its_warning(
    reader: tuple[socket.socket, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    end, address = reader
    monkeypatch.setattr("birdslam.runtime.supervision.live.journal_of", lambda stream: Journal(address))
    with (tmp_path / "out").open("w+") as stream:
        line = LiveLine(stream)
        for text in ("capture: the camera is late", "optimize was killed by SIGKILL", "all is written"):
            line.say(text)
        line.update("frame 1")
        line.update("frame 2")  # not due yet
        line.say("end")
        entries = [entry(end) for _ in range(5)]
        stream.seek(0)
        assert stream.read() == ""
    assert [(e["PRIORITY"], e.get("BIRDSLAM_NODE")) for e in entries] == [
        ("4", "capture"),
        ("4", "optimize"),
        ("5", None),
        ("6", None),
        ("5", None),
    ]
    assert [e["BIRDSLAM_EVENT"] for e in entries] == ["warning", "warning", "run", "status", "run"]
    assert entries[3]["MESSAGE"] == "frame 1"
