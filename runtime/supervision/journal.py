"""Writes to systemd's journal by its native protocol: entries with a priority and fields.

journalctl -u birdslam BIRDSLAM_NODE=perceive PRIORITY=4 -o json
"""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping
from enum import IntEnum
from typing import TextIO

SOCKET = "/run/systemd/journal/socket"


class Priority(IntEnum):
    """The priorities of syslog(3)."""

    ERROR = 3
    WARNING = 4
    NOTICE = 5
    INFO = 6


class Journal:
    """A connection to the journal. Undeliverable entries are lost, so that logging never stops a drive."""

    def __init__(self, address: str = SOCKET) -> None:
        self._address = address

    def send(self, message: str, priority: Priority, **fields: str) -> None:
        """Sends one entry; names of `fields` are in capitals."""
        entry = {"MESSAGE": message, "PRIORITY": str(int(priority)), "SYSLOG_IDENTIFIER": "birdslam", **fields}
        data = b"".join(_field(name, value.encode(errors="replace")) for name, value in entry.items())
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as out:
            out.setblocking(False)
            try:
                out.sendto(data, self._address)
            except OSError:  # no journal, a full journal, or an entry that is too large
                return


def _field(name: str, value: bytes) -> bytes:
    if b"\n" in value:
        return name.encode() + b"\n" + len(value).to_bytes(8, "little") + value + b"\n"
    return name.encode() + b"=" + value + b"\n"


def journal_of(stream: TextIO, environment: Mapping[str, str] = os.environ) -> Journal | None:
    """Returns the journal if `stream` is connected to it (systemd.exec(5), JOURNAL_STREAM); else None."""
    device, _, inode = environment.get("JOURNAL_STREAM", "").partition(":")
    try:
        state = os.fstat(stream.fileno())
    except (OSError, ValueError):  # a stream without a file
        return None
    return Journal() if (device, inode) == (str(state.st_dev), str(state.st_ino)) else None
