"""Processes one drive; its folder of results is renamed into place when it is complete.

As a program (`python -m birdslam.runtime.batch.drive PARENT`) it reads a Job as JSON from standard input and writes
"done total" after each frame; on failure the last line of standard error is the reason, and the exit status 1.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import sys
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from birdslam.runtime.environment import ENVIRONMENT

os.environ.update(ENVIRONMENT)  # before numpy is imported

import msgspec
import numpy as np

from birdslam.bench.ego.trajectory_errors import OdometryReport, evaluate_recordings
from birdslam.loops.map_file import MapError
from birdslam.outputs.drive_files import ResultsError, write_json
from birdslam.perception import ModelError
from birdslam.runtime.batch import one_map
from birdslam.runtime.batch.drives import Task
from birdslam.runtime.batch.fetch import local_copy
from birdslam.runtime.batch.offline import Drive, pipeline
from birdslam.runtime.configuration import Configuration, ConfigurationError
from birdslam.runtime.maps.drive_map import DriveMap
from birdslam.runtime.nodes.sources import RecordedSource, SourceError, open_source
from birdslam.runtime.process.child import end_with_parent
from birdslam.sources.recording import DatasetError, Recording
from birdslam.types import NS_PER_S, Estimate, MapUpdate, Measurements

DRIVES, WORKING, FAILED = "drives", ".working", "failed"
RESULT = "result.json"
TOP_PERCENTILE = 95.0  # of the speeds: robust to a single wrong step
EXPECTED = (ConfigurationError, DatasetError, MapError, ModelError, ResultsError, SourceError, OSError)

OnFrame = Callable[[int, int], object]  # (frames done, total number of frames or 0)


class Job(msgspec.Struct, frozen=True):
    """A drive and the folder of its results."""

    task: Task
    output: str


class DriveResult(msgspec.Struct, frozen=True, kw_only=True):
    """The entries of the report for a drive; deterministic for the drive and its settings."""

    drive: str
    source: str
    settings: dict[str, Any]
    identity: str
    frames: int = 0
    duration_s: float = 0.0
    path_m: float = 0.0
    mean_speed_mps: float = 0.0
    top_speed_mps: float = 0.0  # the TOP_PERCENTILE of the frames' speeds
    vehicles: int = 0  # tracks
    invalid_frames: int = 0
    epochs: int = 0
    statuses: dict[str, int] = {}
    truth: OdometryReport | None = None  # None: no ground truth


class Failure(msgspec.Struct, frozen=True, kw_only=True):
    """A failed drive and the reason."""

    drive: str
    source: str
    settings: dict[str, Any]
    error: str  # one line
    details: str = ""  # the end of its output


def done(output: Path, task: Task) -> bool:
    """Whether a drive has its results. Raises ConfigurationError if the folder has results of something else."""
    file = output / DRIVES / task.name / RESULT
    if not file.exists():
        return False
    try:
        result = msgspec.json.decode(file.read_bytes(), type=DriveResult)
    except (OSError, msgspec.DecodeError) as error:
        raise ConfigurationError(f"{file}: is no result of a drive: {error}") from None
    if result.identity != task.identity:
        raise ConfigurationError(
            f"{file.parent}: has results of another drive, other settings or another version; name another --output or "
            "remove the folder"
        )
    return True


def failure_file(output: Path, name: str) -> Path:
    """Returns the path of a drive's failure report."""
    return output / FAILED / f"{name}.json"


def run_drive(job: Job, on_frame: OnFrame) -> None:
    """Processes a drive and moves its results into place. Raises one of EXPECTED."""
    task, output = job.task, Path(job.output)
    if done(output, task):  # by a worker that was considered lost
        return
    with local_copy(task.uri) as uri:
        _run(task, output, uri, on_frame)


def _run(task: Task, output: Path, uri: str, on_frame: OnFrame) -> None:
    configuration = msgspec.convert(task.configuration, Configuration)
    configuration = msgspec.structs.replace(
        configuration, source=msgspec.structs.replace(configuration.source, uri=uri)
    )
    source = open_source(configuration)
    if not isinstance(source, RecordedSource):
        raise ConfigurationError(f"{task.uri}: is no recording")
    recording = source.recording
    recording.name = task.name
    working = output / WORKING / f"{os.uname().nodename}-{os.getpid()}"
    place = output / DRIVES / task.name
    try:
        with pipeline(configuration) as drive:
            frames = min(len(recording), configuration.source.frames or len(recording))
            drive_map = one_map.listener(configuration, working / task.name)
            motion, known = _Motion(frames, on_frame, drive_map), _known(recording, frames)
            (report,) = evaluate_recordings([recording], motion.watched(drive), working, compared=known)
        if drive_map is not None:
            again = open_source(configuration)
            assert isinstance(again, RecordedSource)
            drive_map.finish(recording.camera, one_map.frames(again.recording, frames), working / task.name)
        result = _result(task, working / task.name, motion, report)
        write_json(working / task.name / RESULT, result)
        place.parent.mkdir(parents=True, exist_ok=True)
        try:
            (working / task.name).rename(place)
        except OSError:
            if not done(output, task):
                raise
        failure_file(output, task.name).unlink(missing_ok=True)
    finally:
        shutil.rmtree(working, ignore_errors=True)


def _known(recording: Recording, frames: int) -> slice:
    """Returns the frames from the first to the last with ground truth; slice(None) if all have it."""
    truth = recording.truth_poses()
    every = slice(None) if frames == len(recording) else slice(0, frames)
    if truth is None or np.isfinite(truth[:frames]).all():
        return every
    known = np.flatnonzero(np.isfinite(truth[:frames]).all(axis=(1, 2)))
    return slice(int(known[0]), int(known[-1]) + 1) if known.size else every


class _Motion:
    """Duration and speeds of a drive, from its estimates."""

    def __init__(self, total: int, on_frame: OnFrame, drive_map: DriveMap | None) -> None:
        self._total, self._on_frame, self._map = total, on_frame, drive_map
        self.frames = 0
        self.first_ns = self.last_ns = 0
        self.speeds_mps: list[float] = []
        self._before: Estimate | None = None

    def watched(self, drive: Drive) -> Drive:
        """Wraps the drive to count its estimates."""

        def watched(recording: Recording) -> Iterator[Measurements | Estimate | MapUpdate]:
            for record in drive(recording):
                yield record
                if isinstance(record, Estimate):
                    self._add(record)
                    self._on_frame(self.frames, self._total)

        return watched

    def _add(self, estimate: Estimate) -> None:
        before, self._before = self._before, estimate
        self.first_ns = self.first_ns if self.frames else estimate.t_source_ns
        self.last_ns = estimate.t_source_ns
        self.frames += 1
        if self._map is not None:
            self._map.add(estimate)
        if before is not None and before.epoch == estimate.epoch and estimate.t_source_ns > before.t_source_ns:
            step = before.T_world_ego.between(estimate.T_world_ego)
            dt_s = (estimate.t_source_ns - before.t_source_ns) / NS_PER_S
            self.speeds_mps.append(float(np.hypot(step.x_m, step.y_m)) / dt_s)


def _result(task: Task, folder: Path, motion: _Motion, report: OdometryReport) -> DriveResult:
    summary = msgspec.json.decode((folder / "summary.json").read_bytes())
    duration_s = (motion.last_ns - motion.first_ns) / NS_PER_S
    top_mps = float(np.percentile(motion.speeds_mps, TOP_PERCENTILE)) if motion.speeds_mps else 0.0
    return DriveResult(
        drive=task.name,
        source=task.uri,
        settings=task.settings,
        identity=task.identity,
        frames=summary["frames"],
        duration_s=round(duration_s, 3),
        path_m=summary["path_m"],
        mean_speed_mps=round(summary["path_m"] / duration_s, 3) if duration_s > 0.0 else 0.0,
        top_speed_mps=round(top_mps, 3),
        vehicles=summary["tracks"],
        invalid_frames=summary["invalid_frames"],
        epochs=summary["epochs"],
        statuses=summary["statuses"],
        truth=None if report.ate_m is None else report,
    )


def main() -> int:
    """Runs the program; returns the exit status."""
    end_with_parent(int(sys.argv[1]))
    job = msgspec.json.decode(sys.stdin.buffer.read(), type=Job)

    def on_frame(frames: int, total: int) -> None:
        with contextlib.suppress(BrokenPipeError):  # the parent has ended, and this process is about to
            print(frames, total, flush=True)

    try:
        run_drive(job, on_frame)
    except EXPECTED as error:
        print(" ".join(str(error).split()), file=sys.stderr)
        return 1
    except Exception:
        traceback.print_exc()
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
