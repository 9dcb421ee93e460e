"""The files of a recorded run and their statistics.

A restarted recorder writes a new file beside the first: `drive.mcap`, `drive-2.mcap`, ... A disk failure ends the
recording, but not the drive.
"""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from birdslam.runtime.configuration import Configuration, ConfigurationError, RecordingConfig
from birdslam.runtime.environment import USER_ERROR_STATUS
from birdslam.runtime.nodes.recorder import RecorderAssignment
from birdslam.runtime.process.beside import DISK_STATUS
from birdslam.runtime.process.restarts import Assignment
from birdslam.runtime.supervision.stations import Duty, Station
from birdslam.runtime.topology import RECORDER

SUFFIX = ".mcap"


def choose_file(config: RecordingConfig, vehicle: str) -> str:
    """Returns the file to write; in a directory a new one, named by vehicle and time.

    Raises ConfigurationError if the file can't be created.
    """
    path = Path(config.file)
    if path.is_dir():
        path /= f"{vehicle}-{datetime.now(UTC):%Y%m%dT%H%M%S%fZ}{SUFFIX}"  # a service may be started twice in a second
    if path.suffix != SUFFIX:
        raise ConfigurationError(f"recording.file: {path}: expected FILE{SUFFIX} or a directory")
    if path.exists():
        raise ConfigurationError(f"recording.file: {path}: exists; recordings are never overwritten")
    if not path.parent.is_dir():
        raise ConfigurationError(f"recording.file: {path}: no such directory: {path.parent}")
    return str(path)


class RecordingFiles:
    """The files of one run, one per recorder process."""

    def __init__(self, first: Path, models: dict[str, Any]) -> None:
        self._first, self._models = first, models
        self.paths: list[Path] = []
        self._bytes: dict[Path, int] = {}

    def station(self, configuration: Configuration, logs: Path) -> Station:
        """Starts the recorder. The run continues without it."""
        duty = Duty(
            module="birdslam.runtime.nodes.recorder",
            first_message=self._assignment,
            final_statuses=(USER_ERROR_STATUS, DISK_STATUS),
            without="the recording has ended",
        )
        return Station(RECORDER.name, configuration, logs, duty)

    def _assignment(self, assignment: Assignment) -> RecorderAssignment:
        self.paths.append(self._next_path() if self.paths else self._first)
        return RecorderAssignment(self._models, str(self.paths[-1]), assignment)

    def _next_path(self) -> Path:
        number = len(self.paths) + 1
        while (path := self._first.with_name(f"{self._first.stem}-{number}{SUFFIX}")).exists():
            number += 1
        return path

    def status(self, recorder: Station) -> str:
        """Returns the text for the status line."""
        if not recorder.working and not recorder.process.vitals["ended"]:
            return "NOT RECORDED"
        lost = recorder.total("dropped") + recorder.total("torn")
        return f"recorded {self._size() / 1e6:.1f} MB" + (f" ({lost} lost)" if lost else "")

    def _size(self) -> int:
        """Returns the size of all files; of a missing file its last known size."""
        for path in self.paths:
            try:
                self._bytes[path] = path.stat().st_size
            except OSError:
                continue
        return sum(self._bytes.values())

    def figures(self, recorder: Station) -> dict[str, Any]:
        """Returns the entries of summary.json after the recorder has ended."""
        return {
            "file": str(self.paths[0]),
            "files": [str(path) for path in self.paths],
            "complete": bool(recorder.process.vitals["ended"]) and not recorder.restarts.count,
            "cut_off": not recorder.process.vitals["ended"],  # the newest file has no end
            "restarts": recorder.restarts.count,
            "messages": recorder.total("frames"),
            "dropped": recorder.total("dropped"),
            "images_torn": recorder.total("torn"),
            "bytes": self._size(),
        }
