"""Scheduling and memory of a node's process, as far as the system permits; set when its work begins.

It holds for the threads that exist (the networks', OpenCV's), and later ones inherit it (zenoh's): a spare that still
loads must not go before the nodes at work.
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
_OBJECT_BYTES, _ANCHORED = 400, 256  # of Python's small objects, and how many in a row have one that stays
_MIB = 1 << 20

# Nodes that compute for 2 ms of a frame and then wait: they may preempt the networks, and never the other way round. On
# two cores, beside perceive alone, a step of the optimizer took p99 2.3 to 4.6 ms at SCHED_FIFO, 4.5 to 11.8 at nice -5
_FIRST, _FIRST_NICE = ("capture", "optimize"), -5
# Of perceive the thread of the frames, and the bus's, which it begins; its networks get what is left, a core or more.
# It works for 10 ms of a frame: at SCHED_FIFO the kernel, which sees no load in that, wakes planners behind it. On two
# cores beside a load of 11 a planner had an estimate p99 29 to 80 ms after it was sent; with this nice value 26 to 47,
# with a short slice of this thread and of the planner's 7 and 14, the age at the planner p99 74 to 124 and 63, 86 ms
_FRAMES, _FRAMES_CORES, _FRAMES_NICE = "perceive", 2.0, -20
_MIN_PERIOD_MS = 10.0  # of frames, for SCHED_FIFO: at more than 100 Hz they would leave no core to the others
_LOWER_NICE = 5  # nicer: a third of the time that one gets that wants the same core and is not
_NICEST = 19

NODE_IMAGES = {"capture": 8, "perceive": 40}  # of the camera's size, in colour, that a node has at once at its worst
# ... and what does not go by the image: in perceive lane grids, and what networks, OpenCV and the solvers hold
NODE_OBJECTS_MIB, NODE_HEAP_MIB = 8.0, {"perceive": 24.0}
OTHER_HEAP_MIB = 4.0  # of a node that is not named there

_TUPLE_SIZES, _TUPLES_KEPT = range(1, 21), 2_000  # what CPython keeps of freed ones, of each size

_usual_nice: list[int] = []  # of the networks, where the frames' thread has one of its own
_anchors: list[bytes] = []  # for ever: memory that holds one of these is not given back


def apply(node: str, configuration: Configuration) -> Iterator[str]:
    """Sets what is configured; gives a line for each setting that the system refused."""
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
        with contextlib.suppress(PermissionError):  # who may not: these wait for a core like the others
            for thread in _threads():
                os.setpriority(os.PRIO_PROCESS, thread, _FIRST_NICE)
            _set_session_nice("self", _FIRST_NICE)
    if realtime.lock_memory == "on" or (realtime.lock_memory == "auto" and live):
        if not may_lock_memory():
            yield "realtime.lock_memory: locking memory is not permitted (LimitMEMLOCK=infinity): it may be paged out"
        elif ctypes.CDLL(None, use_errno=True).mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT):
            yield f"realtime.lock_memory: {os.strerror(ctypes.get_errno())}: memory may be paged out"


def _by_fifo(threads: Iterable[int], priority: int) -> bool:
    """Runs these threads, and those that they begin, at SCHED_FIFO; False where that is not permitted."""
    try:
        for thread in threads:
            os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(priority))
    except PermissionError:
        return False
    return True


def _frames_first() -> None:
    """The calling thread, and those that it begins, go before the networks."""
    thread = threading.get_native_id()
    usual = os.getpriority(os.PRIO_PROCESS, thread)
    with contextlib.suppress(PermissionError):  # who may not: it waits for a core like the others
        os.setpriority(os.PRIO_PROCESS, thread, _FRAMES_NICE)
        wake_soon([thread])
        _usual_nice.append(usual)


def below_frames() -> None:
    """The calling thread runs a network that frames wait for: as any other where the frames' thread goes first."""
    if _usual_nice:
        thread = threading.get_native_id()
        os.setpriority(os.PRIO_PROCESS, thread, _usual_nice[0])
        wake_soon([thread], 0)


def as_frames() -> None:
    """The calling thread shares the interpreter's lock with the frames, and computes between them.

    Were it to wait for a core while it holds the lock, so would the frames: it goes before the networks as they do. It
    has that from the frames' thread, which began it. At SCHED_FIFO it is one below, since there none of them waits.
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
    """The process `pid`, just started as a session of its own, loads where nobody else wants a core: loading a spare
    must not cost frames.

    What it could not come back from (RLIMIT_NICE, CAP_SYS_NICE) is left out. A session's nice value anybody may raise
    to 0 again; but it counts only outside of control groups (a desktop, not a service).
    """
    _set_session_nice(pid, _NICEST)
    limit = resource.getrlimit(resource.RLIMIT_NICE)[0]
    enough = 20 - os.getpriority(os.PRIO_PROCESS, 0)
    if limit >= enough or limit == resource.RLIM_INFINITY or has_capability(_CAP_SYS_NICE):
        with contextlib.suppress(PermissionError, ProcessLookupError):
            os.sched_setscheduler(pid, os.SCHED_IDLE, os.sched_param(0))


def raise_from_idle(pid: int) -> None:
    """Ends `lower_to_idle`: all its threads, and those that they begin meanwhile, get this process's scheduling."""
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
    """Gives a process's session a nice value, where the kernel weighs sessions against each other (autogroup(7)).

    There a thread's own nice value and SCHED_IDLE count inside of its session alone.
    """
    for last in (False, True):
        try:
            with open(f"/proc/{pid}/autogroup", "w") as group:
                group.write(str(nice))
            return
        except BlockingIOError:  # the kernel lets users do this ten times a second
            if not last:
                time.sleep(0.1)
        except OSError:  # no such kernel, not permitted, or it has ended: it computes like the others
            return


def reserve_for(node: str, configuration: Configuration) -> None:
    """`reserve` for what a node makes at work, when all that it loads is there."""
    camera = configuration.camera
    image_mib = 0.0 if camera is None else 3 * camera.width_px * camera.height_px / _MIB
    reserve(NODE_OBJECTS_MIB, NODE_HEAP_MIB.get(node, OTHER_HEAP_MIB) + NODE_IMAGES.get(node, 0) * image_mib)


def use_one_heap() -> None:
    """All threads allocate from one heap (glibc's), which keeps freed memory.

    Call it before the process has threads: a heap that one of them has begun goes on growing. The nodes have it from
    their environment (`cli.ENVIRONMENT`), which the process that sets it has read too early.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_ARENA_MAX, 1)
        mallopt(_M_MMAP_THRESHOLD, 32 * _MIB)
        mallopt(_M_TRIM_THRESHOLD, 2**31 - 1)


def reserve(objects_mib: float, heap_mib: float) -> None:
    """Takes memory for so much of small objects and of larger blocks now, for this process to fill later.

    What grows up to a bound then grows into memory that is there, and its pages do not fault in the middle of a drive.
    It serves every thread where `use_one_heap` was called before the first of them; without glibc it reserves objects
    alone.
    """
    use_one_heap()
    small = [bytes(_OBJECT_BYTES) for _ in range(round(objects_mib * _MIB / _OBJECT_BYTES))]
    _anchors.extend(small[::_ANCHORED])
    del small
    blocks = [bytearray(b"\1") * (_MIB // 4) for _ in range(round(4 * heap_mib))]
    del blocks


def freeze_objects() -> None:
    """Takes what was built out of garbage collection, and fills Python's store of freed tuples.

    CPython keeps freed tuples for later. A drive that fills this store alone, some 4 MiB, grows for half an hour.
    """
    gc.collect()
    gc.freeze()
    tuples = [tuple([None] * size) for size in _TUPLE_SIZES for _ in range(_TUPLES_KEPT)]
    del tuples


def _threads(pid: int | str = "self") -> list[int]:
    with contextlib.suppress(FileNotFoundError):  # another one, which has ended
        return [int(name) for name in os.listdir(f"/proc/{pid}/task")]
    return []


def may_lock_memory() -> bool:
    """Without a limit: under one, a locked process would fail where it first needs more."""
    return resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY or has_capability(_CAP_IPC_LOCK)


def has_capability(capability: int) -> bool:
    """Whether this process has one of the kernel's capabilities now, by its number."""
    with open("/proc/self/status") as status:
        for line in status:
            if line.startswith("CapEff:"):
                return bool(int(line.split()[1], 16) >> capability & 1)
    return False
