"""An append-only file, written by a thread so that the caller does not wait for the disk."""

from __future__ import annotations

import os
import threading
from collections import deque
from pathlib import Path

MAX_WAITING_BYTES = 1 << 26  # queued while the disk stalls; then `write` waits


class AppendOnlyFile:
    """Appends pieces to a file, each completely or not at all, and syncs them to the disk (fdatasync).

    Written pieces survive a kill -9 of this process, synced ones a power cut. A disk failure sets `error`: the file
    ends with its last complete piece, and later pieces are discarded. Raises OSError if the file can't be created,
    FileExistsError if it exists.
    """

    def __init__(self, path: Path, sync: bool = True) -> None:
        self.error: OSError | None = None
        self.written_bytes = 0
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        self._sync = sync
        self._pieces: deque[bytes] = deque()
        self._waiting_bytes = 0
        self._closed = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="disk", daemon=True)
        self._thread.start()

    def write(self, piece: bytes) -> None:
        """Queues one piece for the disk."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting_bytes < MAX_WAITING_BYTES or self.error is not None)
            if self.error is None:
                self._pieces.append(piece)
                self._waiting_bytes += len(piece)
                self._changed.notify_all()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: bool(self._pieces) or self._closed)
                if not self._pieces:
                    return
                piece = self._pieces.popleft()
            try:
                self._append(piece)
            except OSError as error:
                self._fail(error)
            with self._changed:
                self._waiting_bytes -= len(piece)
                self._changed.notify_all()

    def _append(self, piece: bytes) -> None:
        if self.error is not None:
            return
        rest = memoryview(piece)
        while rest:
            rest = rest[os.write(self._fd, rest) :]
        if self._sync:
            os.fdatasync(self._fd)
        self.written_bytes += len(piece)

    def _fail(self, error: OSError) -> None:
        """Truncates the file to its last complete piece."""
        self.error = error
        os.ftruncate(self._fd, self.written_bytes)

    def close(self) -> None:
        """Waits until all pieces are written, then closes the file."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join()
        os.close(self._fd)
