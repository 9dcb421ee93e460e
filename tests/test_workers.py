"""The pool of worker processes: workers end with their parent in any case."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from birdslam.runtime.process.workers import workers

LIMIT_S = 60.0
BUSY = """
import os
import signal
from birdslam.runtime.process.workers import workers

def work(number):
    os.write(1, f"task {number} begun\\n".encode())  # at once: two print to one pipe
    signal.pause()

if __name__ == "__main__":
    with workers(2) as pool:
        list(pool.map(work, range(4)))
"""


@pytest.mark.processes
@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGKILL])
def test_workers_end_with_a_process_that_is_killed(how: signal.Signals, tmp_path: Path) -> None:
    script = tmp_path / "busy.py"
    script.write_text(BUSY)
    process = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        begun = {process.stdout.readline() for _ in range(2)}
        assert begun == {"task 0 begun\n", "task 1 begun\n"}
        process.send_signal(how)
        out, _ = process.communicate(timeout=LIMIT_S)  # returns when all workers have closed their standard output
        assert process.returncode == -how
        assert out == ""  # waiting tasks were not started
    finally:
        process.kill()


@pytest.mark.processes
def test_workers_give_results_in_order() -> None:
    with workers(2) as pool:
        assert list(pool.map(abs, [-3, 1, -2])) == [3, 1, 2]
