"""Measures the latency cost of this computer's settings in about six seconds (`birdslam doctor --measure`).

Rows: wake-up latency of a thread on idle and busy cores, at normal priority and with SCHED_FIFO; the slowdown of work
after an idle period (governor, idle states); the cost of the first access to a page.
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

SLEEP_S = 0.002  # as a wait for a record
WAKES = 300  # per series
REST_S = 0.02  # as between two frames
PIECES = 25  # of work per series
FRESH_MIB = 32
_SPIN = "while True: pass"


def lateness_ms(fifo: bool = False) -> list[float]:
    """Returns the latency of each wake-up in ms. Raises PermissionError if SCHED_FIFO (`fifo`) is not permitted."""
    before, parameter = os.sched_getscheduler(0), os.sched_getparam(0)
    if fifo:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    try:
        late = []
        for _ in range(WAKES):
            start_s = time.monotonic()
            time.sleep(SLEEP_S)
            late.append((time.monotonic() - start_s - SLEEP_S) * 1e3)
        return late
    finally:
        if fifo:
            os.sched_setscheduler(0, before, parameter)


@contextlib.contextmanager
def busy_cores(cores: int, nice: int = 0) -> Iterator[None]:
    """Runs processes that keep `cores` cores busy."""
    command = [sys.executable, "-c", f"import os; os.nice({nice})\n{_SPIN}"]
    hogs = [subprocess.Popen(command, start_new_session=True) for _ in range(cores)]
    try:
        time.sleep(0.2)  # for the start of their interpreters
        yield
    finally:
        for hog in hogs:
            hog.kill()
            hog.wait()


def work_ms(rest_s: float) -> float:
    """Returns the median time of a piece of work after a rest of `rest_s`, in ms."""
    a = np.random.default_rng(0).normal(size=(160, 160))
    took = []
    for _ in range(PIECES):
        time.sleep(rest_s)
        start_s = time.perf_counter()
        a @ a @ a
        took.append((time.perf_counter() - start_s) * 1e3)
    return statistics.median(took)


def fresh_page_us() -> float:
    """Returns the extra time of the first access to a page over the second, in us."""
    size = FRESH_MIB << 20
    pages = size // os.sysconf("SC_PAGE_SIZE")
    block = np.empty(size, dtype=np.uint8)
    took = []
    for _ in range(2):
        start_s = time.perf_counter()
        block[:: size // pages] = 1
        took.append(time.perf_counter() - start_s)
    return max(0.0, took[0] - took[1]) / pages * 1e6


def _percentiles(late_ms: list[float]) -> str:
    p50, p99 = np.percentile(late_ms, [50, 99])
    return f"wake-up latency p50 {p50:.2f}, p99 {p99:.2f}, max {max(late_ms):.2f} ms"


def costs(cores: int) -> Iterator[tuple[str, str]]:
    """Yields (setting, cost) rows."""
    yield "idle", _percentiles(lateness_ms())
    with busy_cores(cores):
        yield "all cores busy", _percentiles(lateness_ms())
        try:
            yield "the same, SCHED_FIFO", _percentiles(lateness_ms(fifo=True))
        except PermissionError:
            yield "the same, SCHED_FIFO", "not permitted (LimitRTPRIO=, CAP_SYS_NICE): not measured"
    with busy_cores(cores, nice=19):
        yield "busy at nice 19", _percentiles(lateness_ms())
    in_a_row, rested = work_ms(0.0), work_ms(REST_S)
    yield (
        "governor, idle",
        f"work of {in_a_row:.2f} ms takes {rested / in_a_row:.2f} times as long after 20 ms of idling",
    )
    page_us = fresh_page_us()
    yield "fresh memory", f"{page_us:.2f} us per page: {page_us * 256:.0f} us per MiB that is not locked or reserved"
