"""Processes that tests start end with a pytest that is killed."""

from __future__ import annotations

import os
import select
import subprocess
import sys

import pytest

LIMIT_S = 60.0
WORKER = """
import signal, subprocess
from tests.leftovers import end_with_this_process
watcher = end_with_this_process()
# Like a vehicle: a new session, whose process starts others
command = ["sh", "-c", "sleep 600 & echo $!; sleep 600"]
vehicle = subprocess.Popen(command, stdout=subprocess.PIPE, start_new_session=True, text=True)
print(vehicle.pid, vehicle.stdout.readline().strip(), watcher, flush=True)
signal.pause()
"""
# Like pytest-xdist: the process that is killed started the one that starts the vehicle
CONTROLLER = f"""
import signal, subprocess, sys
from tests.leftovers import end_with_this_process
watcher = end_with_this_process()
worker = subprocess.Popen([sys.executable, "-c", {WORKER!r}], stdout=subprocess.PIPE, text=True)
print(worker.pid, worker.stdout.readline().strip(), watcher, flush=True)
signal.pause()
"""


@pytest.mark.processes
@pytest.mark.parametrize(("suite_code", "processes"), [(WORKER, 3), (CONTROLLER, 5)], ids=["worker", "controller"])
def test_processes_of_a_killed_suite_are_killed(suite_code: str, processes: int) -> None:
    with subprocess.Popen([sys.executable, "-c", suite_code], stdout=subprocess.PIPE, text=True) as suite:
        pidfds = [os.pidfd_open(int(pid)) for pid in suite.stdout.readline().split()]
        try:
            assert len(pidfds) == processes
            assert not select.select(pidfds, [], [], 0.0)[0]
            suite.kill()
            for pidfd in pidfds:  # the last is the watcher, whose work is done
                assert select.select([pidfd], [], [], LIMIT_S)[0]
        finally:
            for pidfd in pidfds:
                os.close(pidfd)
