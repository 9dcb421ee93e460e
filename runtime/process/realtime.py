"""Scheduling and memory of a node's process, as far as the system permits; applied when its work starts.

The settings apply to all existing threads (networks, OpenCV); threads that start later inherit them (zenoh). A spare
that is still loading keeps its lower priority, so that it does not delay the active nodes.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import resource
import threading
import time
from collections.abc import Iterable, Iterator

from birdslam.runtime.configuration import Configuration
from birdslam.runtime.process.cores import usable_cores
from birdslam.runtime.slices import wake_soon

_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
_CAP_IPC_LOCK, _CAP_SYS_NICE = 14, 23
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8  # of mallopt(3)
_OBJECT_BYTES, _ANCHORED = 400, 256  # size of a small Python object; one in so many is kept
_MIB = 1 << 20

# These nodes compute for about 2 ms per frame, so they may preempt the networks
_FIRST, _FIRST_NICE = ("capture", "optimize"), -5
# The frame thread of perceive and the bus threads that it starts; the networks get the remaining time, at least a core.
# A nice value instead of SCHED_FIFO: this thread works for about 10 ms per frame, and the kernel does not count FIFO
# threads as load, so it would wake planners on the same core
_FRAMES, _FRAMES_CORES, _FRAMES_NICE = "perceive", 2.0, -20
_MIN_PERIOD_MS = 10.0  # of frames, for SCHED_FIFO: at more than 100 Hz they would leave no core to the others
_LOWER_NICE = 5  # a third of the CPU time of a thread with the default nice value
_NICEST = 19

NODE_IMAGES = {"capture": 8, "perceive": 40}  # maximum number of colour images of the camera's size that a node holds
# Memory independent of the image size: in perceive, lane grids and buffers of the networks, OpenCV and the solvers
NODE_OBJECTS_MIB, NODE_HEAP_MIB = 8.0, {"perceive": 24.0}
OTHER_HEAP_MIB = 4.0  # of all other nodes

_TUPLE_SIZES, _TUPLES_KEPT = range(1, 21), 2_000  # sizes and count per size of CPython's free lists

_usual_nice: list[int] = []  # nice value of the networks, if the frame thread has its own
_anchors: list[bytes] = []  # never freed: an arena with one of these is not returned to the system


def apply(node: str, configuration: Configuration) -> Iterator[str]:
    """Applies the configured settings; yields a message for each setting that the system refused."""
    realtime, live = configuration.realtime, configuration.live
    scheduling = realtime.of(node)
    if scheduling.cpus:
        try:
            for thread in _threads():
                os.sched_setaffinity(thread, scheduling.cpus)
        except OSError as error:
            cpus = ", ".join(map(str, scheduling.cpus))
            yield f"realtime.{node}.cpus: can't run on cores {cpus} ({error.strerror}): runs on any"
    every = realtime.fifo == "on" or (realtime.fifo == "auto" and live)
    first = node in _FIRST and not configuration.lossless
    seldom = (configuration.perceive.period_ms or 0.0) >= _MIN_PERIOD_MS
    by_fifo = (every or (first and seldom and realtime.fifo == "auto")) and _by_fifo(_threads(), scheduling.priority)
    frames = node == _FRAMES and not every and not configuration.lossless and usable_cores() >= _FRAMES_CORES
    if frames and seldom and realtime.fifo == "auto":
        _frames_first()
    if every and not by_fifo:
        yield "realtime.fifo: SCHED_FIFO is not permitted (LimitRTPRIO=, CAP_SYS_NICE): runs at normal priority"
    if first and not by_fifo:
        with contextlib.suppress(PermissionError):  # without permission the default priority remains
            for thread in _threads():
                os.setpriority(os.PRIO_PROCESS, thread, _FIRST_NICE)
            _set_session_nice("self", _FIRST_NICE)
    if realtime.lock_memory == "on" or (realtime.lock_memory == "auto" and live):
        if not may_lock_memory():
            yield "realtime.lock_memory: locking memory is not permitted (LimitMEMLOCK=infinity): it may be paged out"
        elif ctypes.CDLL(None, use_errno=True).mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT):
            yield f"realtime.lock_memory: {os.strerror(ctypes.get_errno())}: memory may be paged out"


def _by_fifo(threads: Iterable[int], priority: int) -> bool:
    """Runs these threads, and those that they start, at SCHED_FIFO; returns False if that is not permitted."""
    try:
        for thread in threads:
            os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(priority))
    except PermissionError:
        return False
    return True


def _frames_first() -> None:
    """Gives the calling thread, and those that it starts, priority over the networks."""
    thread = threading.get_native_id()
    usual = os.getpriority(os.PRIO_PROCESS, thread)
    with contextlib.suppress(PermissionError):  # without permission the default priority remains
        os.setpriority(os.PRIO_PROCESS, thread, _FRAMES_NICE)
        wake_soon([thread])
        _usual_nice.append(usual)


def below_frames() -> None:
    """Gives the calling thread, which runs a network, the default nice value if the frame thread has a higher one."""
    if _usual_nice:
        thread = threading.get_native_id()
        os.setpriority(os.PRIO_PROCESS, thread, _usual_nice[0])
        wake_soon([thread], 0)


def as_frames() -> None:
    """Keeps the calling thread at the priority of the frame thread, with which it shares the interpreter lock.

    If it waited for a core while holding the lock, the frame thread would wait too. It inherits its priority from the
    frame thread, which starts it. At SCHED_FIFO it runs one level lower.
    """
    if os.sched_getscheduler(0) == os.SCHED_FIFO:
        lower_priority()


def lower_priority() -> None:
    """Lowers the calling thread's priority below the others of its process and the other nodes."""
    below_frames()
    if os.sched_getscheduler(0) == os.SCHED_FIFO:
        priority = os.sched_getparam(0).sched_priority
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(max(priority - 1, 1)))
    else:
        thread = threading.get_native_id()
        nice = min(os.getpriority(os.PRIO_PROCESS, thread) + _LOWER_NICE, _NICEST)
        os.setpriority(os.PRIO_PROCESS, thread, nice)


def lower_to_idle(pid: int) -> None:
    """Runs the process `pid`, just started in its own session, on idle cores, so that a loading spare delays no frame.

    SCHED_IDLE is skipped if the process lacks the permission to leave it (RLIMIT_NICE, CAP_SYS_NICE). Users may raise
    a session's nice value to 0 again, but it has an effect only outside of control groups (a desktop, not a service).
    """
    _set_session_nice(pid, _NICEST)
    limit = resource.getrlimit(resource.RLIMIT_NICE)[0]
    enough = 20 - os.getpriority(os.PRIO_PROCESS, 0)
    if limit >= enough or limit == resource.RLIM_INFINITY or has_capability(_CAP_SYS_NICE):
        with contextlib.suppress(PermissionError, ProcessLookupError):
            os.sched_setscheduler(pid, os.SCHED_IDLE, os.sched_param(0))


def raise_from_idle(pid: int) -> None:
    """Reverts `lower_to_idle`: gives all threads of `pid`, including new ones, the scheduling of this process."""
    _set_session_nice(pid, 0)
    policy, param = os.sched_getscheduler(0), os.sched_getparam(0)
    done: set[int] = set()
    while new := {*_threads(pid)} - done:
        for thread in new:
            with contextlib.suppress(ProcessLookupError):  # it has ended
                if os.sched_getscheduler(thread) == os.SCHED_IDLE:
                    os.sched_setscheduler(thread, policy, param)
        done |= new


def _set_session_nice(pid: int | str, nice: int) -> None:
    """Sets the nice value of a process's session, if the kernel schedules by session (autogroup(7)).

    In that case a thread's nice value and SCHED_IDLE apply only within its session.
    """
    for last in (False, True):
        try:
            with open(f"/proc/{pid}/autogroup", "w") as group:
                group.write(str(nice))
            return
        except BlockingIOError:  # the kernel limits users to ten writes per second
            if not last:
                time.sleep(0.1)
        except OSError:  # no autogroups, not permitted, or the process has ended
            return


def reserve_for(node: str, configuration: Configuration) -> None:
    """Reserves the working memory of a node; call it after the node has loaded everything."""
    camera = configuration.camera
    image_mib = 0.0 if camera is None else 3 * camera.width_px * camera.height_px / _MIB
    reserve(NODE_OBJECTS_MIB, NODE_HEAP_MIB.get(node, OTHER_HEAP_MIB) + NODE_IMAGES.get(node, 0) * image_mib)


def use_one_heap() -> None:
    """Makes all threads allocate from one glibc heap, which keeps freed memory.

    Call it before the process starts threads, since an existing heap of a thread continues to grow. The nodes get the
    same settings from their environment (`cli.ENVIRONMENT`), which is set too late for the process that sets it.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_ARENA_MAX, 1)
        mallopt(_M_MMAP_THRESHOLD, 32 * _MIB)
        mallopt(_M_TRIM_THRESHOLD, 2**31 - 1)


def reserve(objects_mib: float, heap_mib: float) -> None:
    """Reserves memory for small objects and for larger blocks, in MiB, and touches its pages.

    Bounded growth during a drive then causes no page faults. The reserve serves all threads if `use_one_heap` is called
    before the first one starts; without glibc it covers small objects only.
    """
    use_one_heap()
    small = [bytes(_OBJECT_BYTES) for _ in range(round(objects_mib * _MIB / _OBJECT_BYTES))]
    _anchors.extend(small[::_ANCHORED])
    del small
    blocks = [bytearray(b"\1") * (_MIB // 4) for _ in range(round(4 * heap_mib))]
    del blocks


def freeze_objects() -> None:
    """Excludes existing objects from garbage collection and fills CPython's free lists of tuples.

    Otherwise these lists, about 4 MiB, fill slowly during a drive.
    """
    gc.collect()
    gc.freeze()
    tuples = [tuple([None] * size) for size in _TUPLE_SIZES for _ in range(_TUPLES_KEPT)]
    del tuples


def _threads(pid: int | str = "self") -> list[int]:
    with contextlib.suppress(FileNotFoundError):  # the process has ended
        return [int(name) for name in os.listdir(f"/proc/{pid}/task")]
    return []


def may_lock_memory() -> bool:
    """Whether memory can be locked without a limit; with a limit, later allocations of a locked process would fail."""
    return resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY or has_capability(_CAP_IPC_LOCK)


def has_capability(capability: int) -> bool:
    """Whether this process has the capability(7) of this number in its effective set."""
    with open("/proc/self/status") as status:
        for line in status:
            if line.startswith("CapEff:"):
                return bool(int(line.split()[1], 16) >> capability & 1)
    return False
