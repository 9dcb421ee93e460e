"""systemd's journal by its native protocol: lines with a priority and fields, to be searched by.

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
    """syslog(3)'s."""

    ERROR = 3
    WARNING = 4
    NOTICE = 5
    INFO = 6


class Journal:
    """A way into the journal. What can't be delivered is lost: a log never stops a drive."""

    def __init__(self, address: str = SOCKET) -> None:
        self._address = address

    def send(self, message: str, priority: Priority, **fields: str) -> None:
        """One entry; the names of `fields` in capitals."""
        entry = {"MESSAGE": message, "PRIORITY": str(int(priority)), "SYSLOG_IDENTIFIER": "birdslam", **fields}
        data = b"".join(_field(name, value.encode(errors="replace")) for name, value in entry.items())
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as out:
            out.setblocking(False)
            try:
                out.sendto(data, self._address)
            except OSError:  # no journal now, a full one, or an entry that is too large for it
                return


def _field(name: str, value: bytes) -> bytes:
    if b"\n" in value:
        return name.encode() + b"\n" + len(value).to_bytes(8, "little") + value + b"\n"
    return name.encode() + b"=" + value + b"\n"


def journal_behind(stream: TextIO, environment: Mapping[str, str] = os.environ) -> Journal | None:
    """The journal, where it is what `stream` is written to (systemd.exec(5), JOURNAL_STREAM); else None."""
    device, _, inode = environment.get("JOURNAL_STREAM", "").partition(":")
    try:
        state = os.fstat(stream.fileno())
    except (OSError, ValueError):  # a stream without a file
        return None
    return Journal() if (device, inode) == (str(state.st_dev), str(state.st_ino)) else None
