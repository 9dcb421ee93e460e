"""The recorder's place in a run: a process that nothing waits for while the vehicle drives, watched like a node.

One that died or stalled is begun anew by the rule of the nodes (restarts.py), in a file of its own beside the first:
`drive.mcap`, `drive-2.mcap`, ... A disk that fails ends the recording, and the drive goes on.
"""

from __future__ import annotations

import select
import signal
import time
from collections import Counter
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from birdslam.runtime.configuration import Configuration, ConfigurationError, RecordingConfig
from birdslam.runtime.environment import USER_ERROR_STATUS
from birdslam.runtime.nodes.recorder import DISK_STATUS, Order
from birdslam.runtime.process.restarts import Restarts
from birdslam.runtime.supervision.processes import NodeLog, NodeProcess
from birdslam.runtime.topology import RECORDER
from birdslam.runtime.transport.presence import remove_socket, runtime_dir_of

SUFFIX = ".mcap"
_SUMMED = ("frames", "dropped", "torn")


def choose_file(config: RecordingConfig, vehicle: str) -> str:
    """The file to be written; in a directory, a new one that is named by vehicle and time.

    Raises ConfigurationError where there can't be one.
    """
    path = Path(config.file)
    if path.is_dir():
        path /= f"{vehicle}-{datetime.now(UTC):%Y%m%dT%H%M%S%fZ}{SUFFIX}"  # a service may be started twice in a second
    if path.suffix != SUFFIX:
        raise ConfigurationError(f"recording.file: {path}: expected FILE{SUFFIX} or a directory")
    if path.exists():
        raise ConfigurationError(f"recording.file: {path}: exists; recordings are never overwritten")
    if not path.parent.is_dir():
        raise ConfigurationError(f"recording.file: {path}: there is no directory {path.parent}")
    return str(path)


class RecorderStation:
    """The recorder of one run, through all of its processes; it begins at once."""

    def __init__(self, configuration: Configuration, models: dict[str, Any], logs: Path) -> None:
        self._config, self._models = configuration, models
        self._log = NodeLog(logs / f"{RECORDER.name}.log")
        self._restarts = Restarts(configuration.runtime)
        self._paths = [Path(configuration.recording.file)]
        self._bytes: dict[Path, int] = {}
        self._before: Counter[str] = Counter()
        self._news: list[str] = []
        self._over = False  # no further process
        self._due_s: float | None = None  # of the next one
        self._stall = ""
        self._kill_s: float | None = None  # when a stalled process that did not heed SIGTERM is killed
        self._was_ready = False
        self._process = self._started()

    def _started(self) -> NodeProcess:
        process = NodeProcess(RECORDER.name, self._config, self._log, module="birdslam.runtime.nodes.recorder")
        process.begin(Order(self._models, str(self._paths[-1]), self._restarts.assignment()))
        return process

    # --- watchdog ---

    def watch(self, may_begin_again: bool) -> None:
        """Looks after it: ends a stalled one, begins a dead one anew where that may still be."""
        now_s, process = time.monotonic(), self._process
        if self._due_s is not None:
            if may_begin_again and now_s >= self._due_s:
                self._begin_again()
        elif self._over:
            return
        elif process.exit_status is not None:
            self._ended(may_begin_again, now_s)
        elif self._kill_s is not None:
            if now_s > self._kill_s:
                process.send(signal.SIGKILL)
        elif stall := self._stalled(now_s):
            self._stall, self._kill_s = stall, now_s + self._config.runtime.term_grace_ms / 1e3
            process.send(signal.SIGTERM)

    def _stalled(self, now_s: float) -> str:
        runtime, process = self._config.runtime, self._process
        self._was_ready = self._was_ready or process.ready
        if process.silent_s() * 1e3 > runtime.watchdog_ms:
            return f"is stalled: its loop has shown no life for {runtime.watchdog_ms:g} ms"
        if not self._was_ready and process.begun_s is not None and now_s - process.begun_s > runtime.ready_timeout_s:
            return f"was not ready within {runtime.ready_timeout_s:g} s"
        return ""

    def _ended(self, may_begin_again: bool, now_s: float) -> None:
        process = self._process
        self._over = True
        if process.vitals["ended"] and not self._stall:
            return
        if process.exit_status in (USER_ERROR_STATUS, DISK_STATUS):  # the log says why
            return
        cause = self._stall or process.how()
        if may_begin_again:
            self._due_s = self._restarts.died(now_s, cause, process.vitals)
        if self._due_s is None:
            self._news.append(
                f"{RECORDER.name} {cause}; nothing is recorded any more, the run goes on ({self._log.path})"
            )
        else:
            self._news.append(f"{RECORDER.name} {cause}; it is begun anew ({self._log.path})")

    def _begin_again(self) -> None:
        self._due_s = self._kill_s = None
        self._stall, self._was_ready, self._over = "", False, False
        for counter in _SUMMED:
            self._before[counter] += self._process.vitals[counter]
        self._process.close()
        remove_socket(runtime_dir_of(self._config.vehicle, self._config.runtime_dir), RECORDER.name)
        self._paths.append(self._next_path())
        self._process = self._started()

    def _next_path(self) -> Path:
        first, number = self._paths[0], len(self._paths) + 1
        while (path := first.with_name(f"{first.stem}-{number}{SUFFIX}")).exists():
            number += 1
        return path

    # --- what is said of it ---

    def news(self) -> list[str]:
        """What a person should hear of it, once."""
        told, self._news = self._news, []
        return [*(f"{RECORDER.name}: {line}" for line in self._log.new_warnings()), *told]

    def status(self) -> str:
        """For the live line."""
        if self._over and not self._process.vitals["ended"]:
            return "NOT RECORDED"
        lost = self._total("dropped") + self._total("torn")
        return f"recorded {self._size() / 1e6:.1f} MB" + (f" ({lost} lost)" if lost else "")

    def _total(self, counter: str) -> int:
        return self._before[counter] + self._process.vitals[counter]

    def _size(self) -> int:
        """Of all files; of one that was not made yet, or taken away, the last that is known."""
        for path in self._paths:
            try:
                self._bytes[path] = path.stat().st_size
            except OSError:
                continue
        return sum(self._bytes.values())

    def figures(self) -> dict[str, Any]:
        """For summary.json; after `finish`."""
        return {
            "file": str(self._paths[0]),
            "files": [str(path) for path in self._paths],
            "complete": bool(self._process.vitals["ended"]) and not self._restarts.count,
            "restarts": self._restarts.count,
            "messages": self._total("frames"),
            "dropped": self._total("dropped"),
            "images_torn": self._total("torn"),
            "bytes": self._size(),
        }

    # --- the end ---

    def finish(self, timeout_s: float) -> None:
        """Lets it write what it has heard, and end its file."""
        self._process.send(signal.SIGTERM)
        select.select([self._process.pidfd], [], [], timeout_s)
        self.watch(may_begin_again=False)

    def close(self) -> None:
        """Kills what still runs."""
        self._process.close()
