"""Writes the report of a drive as one HTML file, from a directory of results or from a recording."""

from __future__ import annotations

import importlib.util
import tempfile
from contextlib import nullcontext
from pathlib import Path

from birdslam.outputs.drive_files import Recorder, ResultsError
from birdslam.outputs.report.drive_table import read_drive
from birdslam.outputs.report.page import report_page
from birdslam.runtime.recording.recorded_drive import recorded_drive
from birdslam.runtime.recording.recording import Recording, RecordingError
from birdslam.types import Estimate, MapUpdate


def can_report() -> bool:
    """Whether the extra `report` is installed."""
    return importlib.util.find_spec("plotly") is not None


def write_report(source: Path, path: Path, video: Path | None = None) -> int:
    """Writes the report of a directory of `birdslam run` or of a recording (.mcap); returns its size in bytes.

    `video` defaults to the one in the directory's summary.json. Raises ResultsError, RecordingError.
    """
    recorded = source.suffix == ".mcap"
    with tempfile.TemporaryDirectory() if recorded else nullcontext(str(source)) as directory:
        if recorded:
            directory = str(Path(directory) / source.stem)  # the title of the report
            _write_results(source, Path(directory))
        drive = read_drive(Path(directory))
        stated = drive.summary.get("video")
        if video is None and isinstance(stated, str):
            video = Path(stated)
        page = report_page(drive, video)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(page, encoding="utf-8")
    except OSError as error:
        raise ResultsError(f"report {path}: {error.strerror}") from None
    return path.stat().st_size


def _write_results(file: Path, directory: Path) -> None:
    recording = Recording(file)
    if recording.camera is None:
        raise RecordingError(f"{file}: its configuration has no camera")
    with Recorder(directory, recording.camera) as recorder:
        for record in recorded_drive([recording]):
            if isinstance(record, Estimate):
                recorder.add(record)
            elif isinstance(record, MapUpdate):
                recorder.add_map(record)
        recorder.finish({"source": str(file)})
