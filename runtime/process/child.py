"""Initialization of every process that the supervisor starts."""

from __future__ import annotations

import ctypes
import logging
import os
import signal
import sys
from collections.abc import Sequence

import cv2
import msgspec

from birdslam.runtime.configuration import Configuration
from birdslam.runtime.process.vitals import Vitals

_PR_SET_PDEATHSIG = 1


def begin(arguments: Sequence[str]) -> tuple[str, Configuration, Vitals]:
    """Returns name, configuration (a line of JSON on standard input) and vitals, given NODE VITALS_FD PARENT_PID.

    Logs to standard error, which the supervisor redirects to a file; ends the process with the supervisor.
    """
    name, vitals_fd, parent_pid = arguments
    logging.basicConfig(stream=sys.stderr, level=logging.INFO, format="%(asctime)s %(levelname)s %(message)s")
    end_with_parent(int(parent_pid))
    configuration = msgspec.json.decode(sys.stdin.buffer.readline(), type=Configuration)
    sys.setswitchinterval(configuration.runtime.switch_interval_s)
    cv2.setNumThreads(1)  # perceive sets its own
    return name, configuration, Vitals(int(vitals_fd))


def end_with_parent(parent_pid: int) -> None:
    """Requests SIGTERM for this process when the supervisor dies (PR_SET_PDEATHSIG)."""
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != parent_pid:
        raise SystemExit(0)


def give_back_memory() -> None:
    """Returns memory that was freed during startup to the system; glibc would keep it."""
    ctypes.CDLL(None).malloc_trim(0)
