"""The status of a run: a refreshed line on a terminal, entries in systemd's journal, plain lines elsewhere."""

from __future__ import annotations

import shutil
import time
from typing import TextIO

from birdslam.runtime.supervision.journal import Priority, journal_of
from birdslam.runtime.topology import NODES

JOURNAL_PERIOD_S = 60.0  # of the status in the journal; `systemctl status` shows the newest


class LiveLine:
    """A status line with messages above it. If `stream` is no terminal, the status is one line per second.

    In the journal the status is one entry per minute, and a warning of a node has the field BIRDSLAM_NODE. A line that
    can't be written (a full disk) is counted in `lost`; a closed pipe raises BrokenPipeError.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self.terminal = stream.isatty()
        self._journal = journal_of(stream)
        self.period_s = 0.2 if self.terminal else JOURNAL_PERIOD_S if self._journal else 1.0
        self.lost = 0
        self._visible = False
        self._due_s = 0.0

    def update(self, status: str) -> None:
        """Shows the status if it is due."""
        now_s = time.monotonic()
        if now_s < self._due_s:
            return
        self._due_s = now_s + self.period_s
        if self._journal:
            self._journal.send(status, Priority.INFO, BIRDSLAM_EVENT="status")
        elif self.terminal:
            width = shutil.get_terminal_size().columns - 1
            self._write(f"\r\x1b[K{status[:width]}")
            self._visible = True
        else:
            self._write(f"{status}\n")

    def say(self, text: str) -> None:
        """Prints a message above the status line."""
        self.clear()
        if self._journal:
            about = text.partition(" ")[0].rstrip(":")
            if about in NODES:
                self._journal.send(text, Priority.WARNING, BIRDSLAM_EVENT="warning", BIRDSLAM_NODE=about)
            else:
                self._journal.send(text, Priority.NOTICE, BIRDSLAM_EVENT="run")
            return
        self._write(f"{text}\n")

    def clear(self) -> None:
        """Removes the status line."""
        if self._visible:
            self._write("\r\x1b[K")
            self._visible = False

    def _write(self, text: str) -> None:
        try:
            self._stream.write(text)
            self._stream.flush()
        except BrokenPipeError:
            raise
        except OSError:
            self.lost += 1
