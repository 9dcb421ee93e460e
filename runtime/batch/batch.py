"""Many drives, each through the whole pipeline offline, and one report of all; goes on where it was stopped."""

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

THOUSANDTHS = 1000  # of a drive, that progress counts


@dataclass(frozen=True)
class BatchOutcome:
    """How many drives there were, and what became of them."""

    drives: int
    failed: int
    interrupted: int  # not ended when Ctrl-C came
    map: Joined | None = None  # of all drives, where one was asked for


def run_batch(
    todo: Sequence[Task], output: Path, jobs: int | None, ray_address: str | None, map_file: Path | None = None
) -> BatchOutcome:
    """Runs those drives that are not done, and writes the report of all.

    `jobs`: drives at once, None: as many as fit; `ray_address`: of a Ray cluster, None: on this computer alone;
    `map_file`: the drives' maps become one there, when all have ended. Raises ResultsError, MapError.
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
    """The only batch of this folder; what one that was killed left half done is removed."""
    claim_directory(output)
    with (output / ".lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise ResultsError(f"output directory {output}: another batch is at work in it") from None
        shutil.rmtree(output / WORKING, ignore_errors=True)
        yield


def _run(left: list[Task], output: Path, events: Generator[Event]) -> tuple[int, int]:
    """Runs the drives that are left; gives how many failed, and how many Ctrl-C left unfinished."""
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
