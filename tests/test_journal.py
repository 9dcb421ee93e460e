"""Entries for systemd's journal, read back from a socket."""

from __future__ import annotations

import io
import os
import socket
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from birdslam.runtime.supervision.journal import Journal, Priority, journal_of
from birdslam.runtime.supervision.live import LiveLine


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
