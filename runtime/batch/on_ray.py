"""Drives on a Ray cluster (the extra `ray`): a task a drive, its results written by the worker, as on one computer.

The output folder lies on storage that every node shares, as do the drives, or these are fetched by their URL. A drive
whose node is lost is taken up by another, RETRIES times; one that two workers thought theirs appears once. The driver
holds what is in flight and no more, whatever the number of drives.
"""

from __future__ import annotations

import os
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Any

from birdslam.runtime.batch.drive import Failure, Job
from birdslam.runtime.batch.drives import Task
from birdslam.runtime.batch.local import Event, run_job
from birdslam.runtime.configuration import ConfigurationError

RETRIES = 3
IN_FLIGHT_PER_CPU = 2  # tasks that Ray knows of: one at work, and one that waits beside it


def run_ray(tasks: Sequence[Task], output: Path, jobs: int | None, address: str) -> Generator[Event]:
    """Runs them on the cluster at `address` ("auto": the one that this computer belongs to), `jobs` at once at most.

    Raises ConfigurationError where there is no Ray, or no cluster. Where the iteration is given up, its tasks end.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # it would tell its makers of every start
    try:
        import ray
    except ImportError:
        raise ConfigurationError("--engine ray needs Ray: pip install 'birdslam[ray]'") from None
    try:
        ray.init(address=address, log_to_driver=False, logging_level="error")
    except (ConnectionError, RuntimeError, ValueError) as error:
        raise ConfigurationError(f"--address {address}: no Ray cluster: {error}") from None
    try:
        remote: Any = ray.remote(num_cpus=1, max_retries=RETRIES, retry_exceptions=False)(run_job)
        most = jobs or max(1, IN_FLIGHT_PER_CPU * int(ray.cluster_resources().get("CPU", 1)))
        running: dict[Any, Task] = {}
        waiting = iter(tasks)
        while True:
            while len(running) < most and (task := next(waiting, None)) is not None:
                running[remote.remote(Job(task, str(output.absolute())))] = task
            if not running:
                return
            (ready,), _ = ray.wait(list(running), num_returns=1)
            task = running.pop(ready)
            try:
                failure = ray.get(ready)
            except ray.exceptions.RayError as error:
                failure = Failure(
                    drive=task.name, source=task.uri, settings=task.settings,
                    error=f"its node was lost {RETRIES + 1} times, or Ray failed: {type(error).__name__}",
                    details=str(error),
                )  # fmt: skip
            yield Event(task, 1.0, True, failure)
    finally:
        ray.shutdown()
