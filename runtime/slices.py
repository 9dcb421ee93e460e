"""Time slices of threads: a shorter slice shortens the wake-up latency.

Linux 6.12 and later (EEVDF, sched_setattr(2)) allow this without privileges; elsewhere it has no effect.
"""

from __future__ import annotations

import ctypes
import os
import platform
import struct
from collections.abc import Iterable

SHORT_NS = 100_000  # the kernel's minimum
_SETATTR = {"x86_64": 314, "aarch64": 274}  # sched_setattr's number
# size, policy, flags, nice, priority, runtime (here the slice), deadline, period
_ATTRIBUTES = struct.Struct("=IIQiIQQQ")


def wake_soon(threads: Iterable[int], slice_ns: int = SHORT_NS) -> None:
    """Sets the time slice of threads of this process (0: the kernel's default); keeps their nice values.

    Threads of a real-time policy have no slice and are skipped. Errors of the kernel are ignored.
    """
    number = _SETATTR.get(platform.machine())
    system_call = getattr(ctypes.CDLL(None), "syscall", None)
    if number is None or system_call is None:
        return
    for thread in threads:
        try:
            if os.sched_getscheduler(thread) != os.SCHED_OTHER:
                continue
            nice = os.getpriority(os.PRIO_PROCESS, thread)
        except OSError:  # the thread has ended, or access is denied
            continue
        system_call(number, thread, _ATTRIBUTES.pack(_ATTRIBUTES.size, os.SCHED_OTHER, 0, nice, 0, slice_ns, 0, 0), 0)


def own_threads() -> set[int]:
    """Returns the threads of this process."""
    return {int(name) for name in os.listdir("/proc/self/task")}
