"""Entry point of the recorder and map processes, which run at lower priority beside the pipeline."""

from __future__ import annotations

import logging
import os
import signal
import sys
from collections.abc import Callable
from types import FrameType
from typing import TypeVar

import msgspec

from birdslam.runtime.configuration import Configuration
from birdslam.runtime.process.child import begin
from birdslam.runtime.process.vitals import Vitals

DISK_STATUS = 3  # exit status after a disk error

_Order = TypeVar("_Order", bound=msgspec.Struct)

log = logging.getLogger(__name__)


class Stop:
    """Records whether SIGTERM was received."""

    def __init__(self) -> None:
        self.asked = False
        signal.signal(signal.SIGTERM, self._handle)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.asked = True


def run_beside(work: Callable[[Configuration, _Order, Vitals, Stop], int], order: type[_Order], niceness: int) -> None:
    """Runs `work` and exits with its status; 0: complete, counted as ended; 1: bug.

    Arguments `NAME VITALS_FD PARENT_PID`; standard input: the configuration and the order, one line of JSON each.
    """
    stop = Stop()
    name, configuration, vitals = begin(sys.argv[1:])
    os.nice(niceness)
    asked = msgspec.json.decode(sys.stdin.buffer.readline(), type=order)
    try:
        status = work(configuration, asked, vitals, stop)
    except Exception:
        log.exception("%s failed", name)
        sys.exit(1)
    if status == 0:
        vitals.count(ended=1)
    sys.exit(status)
