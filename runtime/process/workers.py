"""Worker processes for work that is cut into tasks: one pool for all commands that have one."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager

from birdslam.runtime.process.child import end_with_parent


@contextmanager
def workers(processes: int) -> Iterator[ProcessPoolExecutor]:
    """A pool of `processes` processes, spawned and not forked, so that no lock of this process's threads is inherited.

    They end with this process, also where it is killed and can't shut them down. Where the block raises, tasks that
    have not begun are dropped, and it isn't waited for the others.
    """
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(
        processes, mp_context=context, initializer=end_with_parent, initargs=(os.getpid(),)
    ) as pool:
        try:
            yield pool
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
