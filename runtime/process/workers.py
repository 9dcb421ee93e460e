"""A pool of worker processes for commands that run tasks in parallel."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager

from birdslam.runtime.process.child import end_with_parent


@contextmanager
def workers(processes: int) -> Iterator[ProcessPoolExecutor]:
    """A pool of `processes` spawned processes; a fork would inherit locks of this process's threads.

    They end with this process, also if it is killed. If the block raises, waiting tasks are cancelled and running ones
    are not waited for.
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
