"""What a person sees of a run: one refreshed line on a terminal, plain lines elsewhere."""

from __future__ import annotations

import shutil
import time
from typing import TextIO


class LiveLine:
    """A status line that lines of text may interrupt. Where `stream` is no terminal, the status is a line a second."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self.terminal = stream.isatty()
        self.period_s = 0.2 if self.terminal else 1.0
        self._shown = False
        self._due_s = 0.0

    def update(self, status: str) -> None:
        """Shows the status, if it is time for it."""
        now_s = time.monotonic()
        if now_s < self._due_s:
            return
        self._due_s = now_s + self.period_s
        if not self.terminal:
            print(status, file=self._stream, flush=True)
            return
        width = shutil.get_terminal_size().columns - 1
        self._stream.write(f"\r\x1b[K{status[:width]}")
        self._stream.flush()
        self._shown = True

    def say(self, text: str) -> None:
        """A line that stays."""
        self.clear()
        print(text, file=self._stream, flush=True)

    def clear(self) -> None:
        """Takes the status away."""
        if self._shown:
            self._stream.write("\r\x1b[K")
            self._stream.flush()
            self._shown = False
