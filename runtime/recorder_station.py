"""The recorder's place in a run: one process, begun once, that nothing waits for while the vehicle drives."""

from __future__ import annotations

import select
import signal
import time
from pathlib import Path
from typing import Any

from runtime.configuration import Configuration, ConfigurationError, RecordingConfig
from runtime.processes import NodeLog, NodeProcess
from runtime.recorder import Order
from runtime.topology import RECORDER

SUFFIX = ".mcap"


def choose_file(config: RecordingConfig, vehicle: str) -> str:
    """The file to be written; in a directory, a new one that is named by vehicle and time.

    Raises ConfigurationError where there can't be one.
    """
    path = Path(config.file)
    if path.is_dir():
        path /= f"{vehicle}-{time.strftime('%Y%m%dT%H%M%SZ', time.gmtime())}{SUFFIX}"
    if path.suffix != SUFFIX:
        raise ConfigurationError(f"recording.file: {path}: expected FILE{SUFFIX} or a directory")
    if path.exists():
        raise ConfigurationError(f"recording.file: {path}: exists; recordings are never overwritten")
    if not path.parent.is_dir():
        raise ConfigurationError(f"recording.file: {path}: there is no directory {path.parent}")
    return str(path)


class RecorderStation:
    """The recorder of one run; a context manager. It is not begun anew: half a recording is told from a whole one."""

    def __init__(self, configuration: Configuration, models: dict[str, Any], logs: Path) -> None:
        self._path = Path(configuration.recording.file)
        self._log = NodeLog(logs / f"{RECORDER.name}.log")
        self._process = NodeProcess(RECORDER.name, configuration, self._log, module="runtime.recorder")
        self._process.begin(Order(models))
        self._told = False
        self._bytes = 0

    def news(self) -> list[str]:
        """What a person should hear of it, once."""
        lines = [f"{RECORDER.name}: {line}" for line in self._log.new_warnings()]
        if not self._told and self._process.exit_status is not None:
            self._told = True
            if not self._process.vitals["ended"] and not lines:
                lines.append(f"{self._process.failure()}; nothing is recorded any more, the run goes on")
        return lines

    def status(self) -> str:
        """For the live line."""
        if self._process.exit_status is not None and not self._process.vitals["ended"]:
            return "NOT RECORDED"
        lost = self._process.vitals["dropped"] + self._process.vitals["torn"]
        return f"recorded {self._size() / 1e6:.1f} MB" + (f" ({lost} lost)" if lost else "")

    def _size(self) -> int:
        try:
            self._bytes = self._path.stat().st_size
        except OSError:  # not made yet, or taken away: the last that is known
            return self._bytes
        return self._bytes

    def finish(self, timeout_s: float) -> None:
        """Lets it write what it has heard, and end its file."""
        self._process.send(signal.SIGTERM)
        select.select([self._process.pidfd], [], [], timeout_s)

    def figures(self) -> dict[str, Any]:
        """For summary.json; after `finish`."""
        vitals = self._process.vitals
        return {
            "file": str(self._path),
            "complete": bool(vitals["ended"]),
            "messages": vitals["frames"],
            "dropped": vitals["dropped"],
            "images_torn": vitals["torn"],
            "bytes": self._size(),
        }

    def close(self) -> None:
        """Kills what still runs."""
        self._process.close()
