"""Progress of long work: one refreshed line on a terminal, else one line per minute."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Self, TextIO, TypeVar

REFRESH_S = 0.2
PLAIN_LINE_S = 60.0

_Item = TypeVar("_Item")


def time_to_go(seconds: float) -> str:
    """Formats a duration: "0:07", "12:30", "1:02:30"."""
    minutes, rest = divmod(max(0, round(seconds)), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


class Progress:
    """A context manager: `advance` by pieces of work, or `reach` a count. `total`: None if unknown.

    `unit` and `scale`: ("frames", 1) or ("MB", 1e6). The remaining time follows from the mean speed since the first
    piece, without the time for loading.
    """

    def __init__(
        self,
        what: str,
        total: int | None,
        unit: str = "frames",
        scale: float = 1.0,
        stream: TextIO | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._what, self.total, self._unit, self._scale = what, total, unit, scale
        self._stream = sys.stderr if stream is None else stream
        self._clock = clock
        self._terminal = self._stream.isatty()
        self._period_s = REFRESH_S if self._terminal else PLAIN_LINE_S
        self.done = 0
        self._first: tuple[float, int] | None = None  # time of the first piece, count at that time
        self._due_s = clock() + (0.0 if self._terminal else PLAIN_LINE_S)
        self._visible = False

    def advance(self, pieces: int = 1) -> None:
        """Adds finished pieces."""
        self.reach(self.done + pieces)

    def reach(self, done: int) -> None:
        """Sets the number of finished pieces."""
        self.done = done
        now_s = self._clock()
        if self._first is None or done < self._first[1]:  # a second pass restarts
            self._first = now_s, done
        if now_s < self._due_s:
            return
        self._due_s = now_s + self._period_s
        self._write(self.line(now_s))

    def line(self, now_s: float) -> str:
        """Returns the progress line."""
        shape = "d" if self._scale == 1.0 else ".1f"
        done, total = (None if n is None else format(n if shape == "d" else n / self._scale, shape)
                       for n in (self.done, self.total))  # fmt: skip
        text = f"{self._what}: {done}{'' if total is None else f' of {total}'} {self._unit}"
        if self.total is None or self._first is None:
            return text
        since_s, since = self._first
        if self.done > since and now_s > since_s:
            text += f", {time_to_go((now_s - since_s) * (self.total - self.done) / (self.done - since))} to go"
        return text

    def _write(self, text: str) -> None:
        if self._terminal:
            self._stream.write(f"\r\x1b[K{text[: shutil.get_terminal_size().columns - 1]}")
            self._visible = True
        else:
            self._stream.write(f"{text}\n")
        self._stream.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *failure: object) -> None:
        self.clear()

    def clear(self) -> None:
        """Removes the line."""
        if self._visible:
            self._stream.write("\r\x1b[K")
            self._stream.flush()
            self._visible = False


def with_progress(items: Iterable[_Item], what: str, total: int | None) -> Iterator[_Item]:
    """Yields the items, with progress in frames."""
    with Progress(what, total, "frames") as progress:
        for item in items:
            yield item
            progress.advance()


def file_progress(what: str, path: Path) -> Progress:
    """Returns the progress for reading a file, in MB."""
    return Progress(what, path.stat().st_size if path.is_file() else None, "MB", 1e6)
