"""What every process that the supervisor starts does first."""

from __future__ import annotations

import ctypes
import os
import signal

LOG_FORMAT = "%(asctime)s %(levelname)s %(message)s"
_PR_SET_PDEATHSIG = 1


def end_with_parent(parent_pid: int) -> None:
    """Where the supervisor is killed, this process gets SIGTERM (PR_SET_PDEATHSIG)."""
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != parent_pid:
        raise SystemExit(0)


def give_back_memory() -> None:
    """What was freed while a process was built goes back to the system; glibc would keep it for later."""
    ctypes.CDLL(None).malloc_trim(0)
