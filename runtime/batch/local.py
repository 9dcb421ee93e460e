"""Processes drives on this computer in parallel, each in its own process, so that a crash ends one drive only."""

from __future__ import annotations

import os
import queue
import re
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import psutil

from birdslam.runtime.batch.drive import Failure, Job
from birdslam.runtime.batch.drives import Task
from birdslam.runtime.process.cores import usable_cores

PROCESS_BYTES = 1_200_000_000  # memory of one drive's process, with a margin for larger networks
_PROGRESS = re.compile(rb"(\d+) (\d+)")
DETAILS_BYTES = 4000  # kept from the end of a process's output


@dataclass(frozen=True)
class Event:
    """The progress or the end of a drive; `failure` is None if it has its results."""

    task: Task
    share: float  # of its frames that are done
    ended: bool = False
    failure: Failure | None = None


def fitting_jobs() -> int:
    """Returns the number of drives in parallel that cores and memory allow."""
    return max(1, min(int(usable_cores()), int(psutil.virtual_memory().available // PROCESS_BYTES)))


def run_local(tasks: Sequence[Task], output: Path, jobs: int) -> Generator[Event]:
    """Runs the tasks, `jobs` in parallel. Closing the iterator ends their processes."""
    waiting: queue.SimpleQueue[Task] = queue.SimpleQueue()
    for task in tasks:
        waiting.put(task)
    pool = _Pool(waiting, output)
    threads = [threading.Thread(target=pool.work, daemon=True) for _ in range(min(jobs, len(tasks)))]
    for thread in threads:
        thread.start()
    left = len(tasks)
    try:
        while left:
            event = pool.events.get()
            if isinstance(event, BaseException):
                raise event
            left -= event.ended
            yield event
    finally:
        pool.stop()
        for thread in threads:
            thread.join()


class _Pool:
    def __init__(self, waiting: queue.SimpleQueue[Task], output: Path) -> None:
        self.events: queue.SimpleQueue[Event | BaseException] = queue.SimpleQueue()
        self._waiting, self._output = waiting, output
        self._lock = threading.Lock()
        self._running: set[subprocess.Popen[bytes]] = set()
        self._stopped = False

    def work(self) -> None:
        """Runs drives one after the other on a thread. A process ends with the thread that started it."""
        try:
            while True:
                try:
                    task = self._waiting.get_nowait()
                except queue.Empty:
                    return
                failure = self._run(task)
                if self._stopped:
                    return
                self.events.put(Event(task, 1.0, True, failure))
        except BaseException as error:  # raised by `run_local`
            self.events.put(error)

    def stop(self) -> None:
        """Ends the processes."""
        with self._lock:
            self._stopped = True
            for process in self._running:
                process.terminate()

    def _run(self, task: Task) -> Failure | None:
        def started(process: subprocess.Popen[bytes]) -> None:
            with self._lock:
                self._running.add(process)
                if self._stopped:
                    process.terminate()

        if self._stopped:
            return None
        job = Job(task, str(self._output))
        return run_job(job, started, lambda share: self.events.put(Event(task, share)))


def run_job(
    job: Job,
    started: Callable[[subprocess.Popen[bytes]], object] = lambda process: None,
    on_share: Callable[[float], object] = lambda share: None,
) -> Failure | None:
    """Runs a drive in its own process and waits for its end; returns None if it has its results."""
    task = job.task
    command = [sys.executable, "-m", "birdslam.runtime.batch.drive", str(os.getpid())]
    with tempfile.TemporaryFile() as output:
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=output)
        started(process)
        status = _attend(process, job, on_share)
        if status == 0:
            return None
        output.seek(max(0, output.seek(0, os.SEEK_END) - DETAILS_BYTES))
        details = output.read().decode(errors="replace").strip()
    error = f"was killed by signal {-status}" if status < 0 else details.splitlines()[-1] if details else "failed"
    return Failure(drive=task.name, source=task.uri, settings=task.settings, error=error, details=details)


def _attend(process: subprocess.Popen[bytes], job: Job, on_share: Callable[[float], object]) -> int:
    assert process.stdin is not None
    assert process.stdout is not None
    with process.stdin, process.stdout:
        try:
            process.stdin.write(msgspec.json.encode(job))
            process.stdin.close()
        except BrokenPipeError:  # it ended at once
            return process.wait()
        for line in process.stdout:
            if match := _PROGRESS.fullmatch(line.strip()):
                frames, total = map(int, match.groups())
                on_share(min(frames / total, 1.0) if total else 0.0)
    return process.wait()
