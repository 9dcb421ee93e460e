"""What tests start ends with them, even where pytest is killed: a vehicle that is left behind runs in real time, and
takes the cores of all that follows.

`python -S leftovers.py PID MARK` waits until process PID is gone, and then kills every process whose environment has
MARK in BIRDSLAM_TESTS. A process that was itself started by tests (a worker of pytest-xdist) appends its mark: its own
watcher has the mark of the outer process, and is killed with it.
"""

from __future__ import annotations

import contextlib
import os
import re
import select
import signal
import sys
from pathlib import Path

VARIABLE = "BIRDSLAM_TESTS"


def end_with_this_process() -> int:
    """What this process and its children start from now on ends with it. Gives the process that sees to it."""
    mark = f"{os.getpid()}-{os.urandom(8).hex()}"
    command = [sys.executable, "-S", __file__, str(os.getpid()), mark]
    nowhere = [(os.POSIX_SPAWN_OPEN, fd, os.devnull, os.O_RDWR, 0) for fd in range(3)]
    watcher = os.posix_spawn(sys.executable, command, os.environ, file_actions=nowhere, setsid=True)
    outer = os.environ.get(VARIABLE)
    os.environ[VARIABLE] = f"{outer},{mark}" if outer else mark  # after the watcher, which outlives what it kills
    return watcher


def _marked(mark: str) -> list[int]:
    pattern = re.compile(rf"(?:^|\0){VARIABLE}=(?:[^\0]*,)?{mark}[,\0]".encode())
    found = []
    for place in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # it has just ended, or is another user's
            if pattern.search((place / "environ").read_bytes()):
                found.append(int(place.name))
    return found


def main(pid: int, mark: str) -> None:
    with contextlib.suppress(ProcessLookupError):  # it is gone already
        select.select([os.pidfd_open(pid)], [], [])
    while pids := _marked(mark):  # again: one may just have started another
        for each in pids:
            with contextlib.suppress(ProcessLookupError):
                os.kill(each, signal.SIGKILL)


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2])
