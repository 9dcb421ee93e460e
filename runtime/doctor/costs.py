"""What this computer's settings cost a frame, measured in some six seconds (`birdslam doctor --measure`).

Each row measures the same thing with a setting and without it: how late a thread wakes that waited for a frame, with
others that want its core and without, at normal priority and by SCHED_FIFO; what the processor's rest between two
frames (governor, idle states) costs the work after it; what a page costs that is touched for the first time.
"""

from __future__ import annotations

import contextlib
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator

import numpy as np

SLEEP_S = 0.002  # a thread waits so long, as for a record
WAKES = 300  # of each series
REST_S = 0.02  # between two pieces of work: as between two frames
PIECES = 25  # of work, of each series
FRESH_MIB = 32
_SPIN = "while True: pass"


def lateness_ms(fifo: bool = False) -> list[float]:
    """How late each wake-up was; `fifo`: at SCHED_FIFO. Raises PermissionError where that is not permitted."""
    before, parameter = os.sched_getscheduler(0), os.sched_getparam(0)
    if fifo:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    try:
        late = []
        for _ in range(WAKES):
            begun_s = time.monotonic()
            time.sleep(SLEEP_S)
            late.append((time.monotonic() - begun_s - SLEEP_S) * 1e3)
        return late
    finally:
        if fifo:
            os.sched_setscheduler(0, before, parameter)


@contextlib.contextmanager
def busy_cores(cores: int, nice: int = 0) -> Iterator[None]:
    """So many processes that want a core each, meanwhile."""
    command = [sys.executable, "-c", f"import os; os.nice({nice})\n{_SPIN}"]
    hogs = [subprocess.Popen(command, start_new_session=True) for _ in range(cores)]
    try:
        time.sleep(0.2)  # until they compute: each has an interpreter to start
        yield
    finally:
        for hog in hogs:
            hog.kill()
            hog.wait()


def work_ms(rest_s: float) -> float:
    """The median time of one piece of work, each after so long a rest."""
    a = np.random.default_rng(0).normal(size=(160, 160))
    took = []
    for _ in range(PIECES):
        time.sleep(rest_s)
        begun_s = time.perf_counter()
        a @ a @ a
        took.append((time.perf_counter() - begun_s) * 1e3)
    return statistics.median(took)


def fresh_page_us() -> float:
    """What the first touch of a page costs more than the second, of memory that the process did not have."""
    size = FRESH_MIB << 20
    pages = size // os.sysconf("SC_PAGE_SIZE")
    block = np.empty(size, dtype=np.uint8)
    took = []
    for _ in range(2):
        begun_s = time.perf_counter()
        block[:: size // pages] = 1
        took.append(time.perf_counter() - begun_s)
    return max(0.0, took[0] - took[1]) / pages * 1e6


def _percentiles(late_ms: list[float]) -> str:
    p50, p99 = np.percentile(late_ms, [50, 99])
    return f"wakes late by p50 {p50:.2f}, p99 {p99:.2f}, max {max(late_ms):.2f} ms"


def costs(cores: int) -> Iterator[tuple[str, str]]:
    """(what, what it costs), a row each."""
    yield "as it is", _percentiles(lateness_ms())
    with busy_cores(cores):
        yield "every core wanted", _percentiles(lateness_ms())
        try:
            yield "the same, SCHED_FIFO", _percentiles(lateness_ms(fifo=True))
        except PermissionError:
            yield "the same, SCHED_FIFO", "not permitted (LimitRTPRIO=, CAP_SYS_NICE): not measured"
    with busy_cores(cores, nice=19):
        yield "wanted at nice 19", _percentiles(lateness_ms())
    in_a_row, rested = work_ms(0.0), work_ms(REST_S)
    yield (
        "governor, idle",
        f"work of {in_a_row:.2f} ms takes {rested / in_a_row:.2f} times as long after a rest of 20 ms",
    )
    page_us = fresh_page_us()
    yield "fresh memory", f"{page_us:.2f} us a page: {page_us * 256:.0f} us a MiB that is not locked or kept"
