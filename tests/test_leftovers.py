"""Processes that tests start end with a pytest that is killed."""

from __future__ import annotations

import os
import select
import subprocess
import sys

import pytest

LIMIT_S = 60.0
SUITE = """
import signal, subprocess
from tests.leftovers import end_with_this_process
watcher = end_with_this_process()
# Like a vehicle: a new session, whose process starts others
command = ["sh", "-c", "sleep 600 & echo $!; sleep 600"]
vehicle = subprocess.Popen(command, stdout=subprocess.PIPE, start_new_session=True, text=True)
print(vehicle.pid, vehicle.stdout.readline().strip(), watcher, flush=True)
signal.pause()
"""


@pytest.mark.processes
def test_processes_of_a_killed_suite_are_killed() -> None:
    with subprocess.Popen([sys.executable, "-c", SUITE], stdout=subprocess.PIPE, text=True) as suite:
        assert suite.stdout is not None
        pidfds = [os.pidfd_open(int(pid)) for pid in suite.stdout.readline().split()]
        try:
            assert len(pidfds) == 3
            assert not select.select(pidfds, [], [], 0.0)[0]
            suite.kill()
            for pidfd in pidfds:  # the last is the watcher, whose work is done
                assert select.select([pidfd], [], [], LIMIT_S)[0]
        finally:
            for pidfd in pidfds:
                os.close(pidfd)
