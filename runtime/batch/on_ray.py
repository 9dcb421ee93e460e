"""Processes drives on a Ray cluster (the extra `ray`), one task per drive; the worker writes the results.

The output folder must be on shared storage, and so must the drives unless they are URLs. A drive of a lost node is
retried RETRIES times. Memory is bounded by the tasks in flight.
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
IN_FLIGHT_PER_CPU = 2  # submitted tasks: one running and one waiting


def run_ray(tasks: Sequence[Task], output: Path, jobs: int | None, address: str) -> Generator[Event]:
    """Runs the tasks on the cluster at `address` ("auto": this computer's), at most `jobs` in parallel.

    Raises ConfigurationError without Ray or a cluster. Closing the iterator ends its tasks.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # no telemetry
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
