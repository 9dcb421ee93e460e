"""Processes many drives offline and writes one report; a stopped batch can be continued."""

from __future__ import annotations

import contextlib
import fcntl
import shutil
import sys
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from birdslam.outputs.drive_files import ResultsError, claim_directory, write_json
from birdslam.runtime.batch.drive import DRIVES, WORKING, Failure, done, failure_file
from birdslam.runtime.batch.drives import Task
from birdslam.runtime.batch.local import Event, fitting_jobs, run_local
from birdslam.runtime.batch.on_ray import run_ray
from birdslam.runtime.batch.one_map import Joined, join
from birdslam.runtime.batch.report import write_report
from birdslam.runtime.progress import Progress

THOUSANDTHS = 1000  # progress units per drive


@dataclass(frozen=True)
class BatchOutcome:
    """The number of drives and their outcome."""

    drives: int
    failed: int
    interrupted: int  # unfinished at Ctrl-C
    map: Joined | None = None  # of all drives, if requested


def run_batch(
    todo: Sequence[Task], output: Path, jobs: int | None, ray_address: str | None, map_file: Path | None = None
) -> BatchOutcome:
    """Runs the drives without results, and writes the report of all.

    `jobs`: drives in parallel, None: as many as fit; `ray_address`: of a Ray cluster, None: this computer; `map_file`:
    the joined map of all drives. Raises ResultsError, MapError.
    """
    with _exclusive(output):
        left = [task for task in todo if not done(output, task)]
        events = (
            run_local(left, output, jobs or fitting_jobs())
            if ray_address is None
            else run_ray(left, output, jobs, ray_address)
        )
        failed, interrupted = _run(left, output, events)
        write_report(todo, output)
        joined = None
        if map_file is not None and not interrupted:
            joined = join([output / DRIVES / task.name for task in todo if done(output, task)], map_file)
    return BatchOutcome(len(todo), failed, interrupted, joined)


@contextlib.contextmanager
def _exclusive(output: Path) -> Iterator[None]:
    """Locks the folder for one batch; removes the partial results of a killed one."""
    claim_directory(output)
    with (output / ".lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise ResultsError(f"output directory {output}: another batch is running in it") from None
        shutil.rmtree(output / WORKING, ignore_errors=True)
        yield


def _run(left: list[Task], output: Path, events: Generator[Event]) -> tuple[int, int]:
    """Runs the remaining drives; returns the number of failed ones and of those unfinished at Ctrl-C."""
    shares: dict[str, float] = {}
    failed = ended = 0
    with Progress("batch", len(left) * THOUSANDTHS, "drives", THOUSANDTHS) as progress:
        try:
            with contextlib.closing(events):
                for event in events:
                    shares[event.task.name] = event.share
                    if event.ended:
                        ended += 1
                        shares.pop(event.task.name)
                    if event.failure is not None:
                        failed += 1
                        _write_failure(output, event.failure)
                        progress.clear()
                        print(f"{event.failure.drive}: {event.failure.error}", file=sys.stderr)
                    progress.reach(round((ended + sum(shares.values())) * THOUSANDTHS))
        except KeyboardInterrupt:
            return failed, len(left) - ended
    return failed, 0


def _write_failure(output: Path, failure: Failure) -> None:
    file = failure_file(output, failure.drive)
    try:
        file.parent.mkdir(exist_ok=True)
        write_json(file, failure)
    except OSError as error:
        raise ResultsError(f"{file}: {error.strerror}") from None
