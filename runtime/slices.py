"""A thread's slice: how long the kernel lets it run at once, and so how soon after it wakes.

Linux takes it of anybody from version 6.12 on (EEVDF, sched_setattr(2)); elsewhere nothing changes.
"""

from __future__ import annotations

import ctypes
import os
import platform
import struct
from collections.abc import Iterable

SHORT_NS = 100_000  # the kernel's least
_SETATTR = {"x86_64": 314, "aarch64": 274}  # sched_setattr's number
# size, policy, flags, nice, priority, runtime (here the slice), deadline, period
_ATTRIBUTES = struct.Struct("=IIQiIQQQ")


def wake_soon(threads: Iterable[int], slice_ns: int = SHORT_NS) -> None:
    """These threads of this process wake with a short slice; 0: the kernel's own. They keep their nice values.

    Those of a real-time policy have none and stay as they are, as all do where the kernel refuses.
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
        except OSError:  # it has ended, or may not be asked for
            continue
        system_call(number, thread, _ATTRIBUTES.pack(_ATTRIBUTES.size, os.SCHED_OTHER, 0, nice, 0, slice_ns, 0, 0), 0)


def own_threads() -> set[int]:
    """Of this process."""
    return {int(name) for name in os.listdir("/proc/self/task")}
