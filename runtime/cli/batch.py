"""`birdslam batch`: many drives, one report. Exit status 1 where a drive failed, 130 after Ctrl-C."""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import shutil
import sys
from collections.abc import Generator, Iterator
from pathlib import Path

import msgspec

from birdslam.outputs.drive_files import ResultsError, claim_directory
from birdslam.runtime.batch.drive import WORKING, Failure, done, failure_file
from birdslam.runtime.batch.drives import Task, find_drives, sweep, tasks
from birdslam.runtime.batch.local import Event, fitting_jobs, run_local
from birdslam.runtime.batch.on_ray import run_ray
from birdslam.runtime.batch.report import write_report
from birdslam.runtime.configuration import ConfigurationError
from birdslam.runtime.environment import INTERRUPTED_STATUS
from birdslam.runtime.options import overrides_of
from birdslam.runtime.progress import Progress

THOUSANDTHS = 1000  # of a drive, that progress counts


def batch(options: argparse.Namespace) -> int:
    """The command; gives the exit status."""
    output = Path(options.output)
    overrides, models = overrides_of(options)
    overrides.pop("output", None)
    jobs = options.jobs
    if jobs is not None and jobs < 1:
        raise ConfigurationError(f"--jobs {jobs}: one or more")
    todo = tasks(find_drives(options.drives), sweep(options.sweep), options.config, overrides, models)
    with _alone(output):
        left = [task for task in todo if not done(output, task)]
        if len(left) < len(todo):
            print(f"{len(todo) - len(left)} of {len(todo)} drives are done already")
        on_ray = options.engine == "ray"
        events = (
            run_ray(left, output, jobs, options.address) if on_ray else run_local(left, output, jobs or fitting_jobs())
        )
        failed, interrupted = _run(left, output, events)
        write_report(todo, output)
    print(f"{len(todo) - failed - interrupted} of {len(todo)} drives: {output / 'report.html'}")
    return INTERRUPTED_STATUS if interrupted else int(failed > 0)


@contextlib.contextmanager
def _alone(output: Path) -> Iterator[None]:
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
    """Runs what is left; gives how many failed, and how many were not ended when Ctrl-C came."""
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
                        _keep(output, event.failure)
                        progress.clear()
                        print(f"{event.failure.drive}: {event.failure.error}", file=sys.stderr)
                    progress.reach(round((ended + sum(shares.values())) * THOUSANDTHS))
        except KeyboardInterrupt:
            return failed, len(left) - ended
    return failed, 0


def _keep(output: Path, failure: Failure) -> None:
    file = failure_file(output, failure.drive)
    try:
        file.parent.mkdir(exist_ok=True)
        file.write_bytes(msgspec.json.format(msgspec.json.encode(failure), indent=2) + b"\n")
    except OSError as error:
        raise ResultsError(f"{file}: {error.strerror}") from None
