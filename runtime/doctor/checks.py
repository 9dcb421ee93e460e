"""Checks whether this machine meets the needs of a vehicle, with advice for failures (`birdslam doctor`).

Verdicts: `ok`; `warning`: it runs but may exceed its budgets; `error`: it can't start. The checks use the rights of
the caller: for the service's user run `sudo -u birdslam birdslam doctor CONFIG`.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import resource
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import msgspec

from birdslam.perception import ModelError, load_network
from birdslam.runtime.configuration import Configuration, ConfigurationError
from birdslam.runtime.nodes.look_rate import threads_of_a_network
from birdslam.runtime.nodes.sources import SourceError, open_source
from birdslam.runtime.process import realtime
from birdslam.runtime.process.cores import usable_cores
from birdslam.runtime.topology import NODES
from birdslam.runtime.transport.presence import ring_path, runtime_dir_of
from birdslam.sources.recording import DatasetError

Verdict = Literal["ok", "warning", "error"]
MIN_CORES = 4
MIN_MEMORY_GIB = 1.5
_TIMEX_BYTES, _TIME_ERROR = 256, 5
RING_MARGIN = 2.0  # /dev/shm holds a second ring while a restarted capture replaces its own


@dataclass(frozen=True)
class Finding:
    """The result of one check, with advice if it failed."""

    what: str
    verdict: Verdict
    found: str
    advice: str = ""


def examine(configuration: Configuration) -> Iterator[Finding]:
    """Runs all checks; those of the source and the models only if they are configured."""
    checks: tuple[Callable[[Configuration], Iterator[Finding]], ...] = (
        *(_cores, _governor, _threads, _scheduling, _memory_lock, _memory, _runtime_dir, _shared_memory, _disk),
        *(_clock, _utc, _models, _source),
    )
    for check in checks:
        yield from check(configuration)


def table(findings: list[Finding]) -> str:
    """Returns the findings as a printable table."""
    rows = [f"{f.verdict:8}{f.what:18}{f.found}{f'  ->  {f.advice}' if f.advice else ''}" for f in findings]
    return "\n".join(rows)


def _cores(configuration: Configuration) -> Iterator[Finding]:
    usable = os.sched_getaffinity(0)
    cores, load = usable_cores(), os.getloadavg()[0]
    found = f"{cores:g} usable, load {load:.1f}"
    wanted = {node: set(configuration.realtime.of(node).cpus) - usable for node in NODES}
    beyond = {node: cpus for node, cpus in wanted.items() if cpus}
    if beyond:
        text = ", ".join(f"{node}: {', '.join(map(str, sorted(cpus)))}" for node, cpus in beyond.items())
        yield Finding("cores", "warning", f"{found}; {text} can't be used", "correct realtime.NODE.cpus")
    elif cores < MIN_CORES - 0.5:
        advice = (
            f"33 frames per second need {MIN_CORES} cores: use smaller networks or a lower rate, or raise CPUQuota="
        )
        yield Finding("cores", "warning", found, advice)
    elif load > cores:
        yield Finding("cores", "warning", found, "other programs use all of them: end them, or raise their nice value")
    else:
        yield Finding("cores", "ok", found)


def _threads(configuration: Configuration) -> Iterator[Finding]:
    """Checks the threads that run in parallel on a frame; BLAS has one in every node (runtime/environment.py)."""
    cores = len(os.sched_getaffinity(0))
    networks: dict[str, int] = {}
    for role, spec in configuration.models.in_use().items():
        with contextlib.suppress(ModelError):  # reported by `_models`
            networks[role] = load_network(role, spec, threads_of_a_network(usable_cores())).schedule.threads
    opencv = configuration.perceive.opencv_threads
    parts = [*(f"{role} {count}" for role, count in networks.items()), f"OpenCV {opencv}", "BLAS 1"]
    if sum(networks.values()) >= cores or opencv > cores:
        advice = f"leave a core to the odometry: models.ROLE.threads together below {cores}, perceive.opencv_threads"
        yield Finding("threads", "warning", ", ".join(parts), advice)
    else:
        yield Finding("threads", "ok", ", ".join(parts))


def _governor(configuration: Configuration) -> Iterator[Finding]:
    files = sorted(Path("/sys/devices/system/cpu").glob("cpu[0-9]*/cpufreq/scaling_governor"))
    found = sorted({path.read_text().strip() for path in files})
    if not found:
        yield Finding("governor", "ok", "none in the kernel (a virtual machine has none)")
    elif found == ["performance"]:
        yield Finding("governor", "ok", "performance")
    else:
        yield Finding("governor", "warning", ", ".join(found), "cpupower frequency-set -g performance")


def _scheduling(configuration: Configuration) -> Iterator[Finding]:
    if configuration.realtime.fifo == "off":
        yield Finding("SCHED_FIFO", "ok", "not configured (realtime.fifo)")
        return
    before, parameter = os.sched_getscheduler(0), os.sched_getparam(0)
    highest = max(configuration.realtime.of(node).priority for node in NODES)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(highest))
        os.sched_setscheduler(0, before, parameter)
    except PermissionError:
        advice = f"LimitRTPRIO={highest} in the unit, or rtprio in /etc/security/limits.conf"
        yield Finding("SCHED_FIFO", "warning", f"not permitted at priority {highest}", advice)
    else:
        yield Finding("SCHED_FIFO", "ok", f"permitted at priority {highest}")


def _memory_lock(configuration: Configuration) -> Iterator[Finding]:
    if configuration.realtime.lock_memory == "off":
        yield Finding("memory lock", "ok", "not configured (realtime.lock_memory)")
    elif realtime.may_lock_memory():
        yield Finding("memory lock", "ok", "permitted")
    else:
        limit_kib = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] // 1024
        yield Finding("memory lock", "warning", f"limited to {limit_kib} KiB", "LimitMEMLOCK=infinity in the unit")


def _memory(configuration: Configuration) -> Iterator[Finding]:
    lines = dict(line.split(":", 1) for line in Path("/proc/meminfo").read_text().splitlines())
    free_gib = int(lines["MemAvailable"].split()[0]) / 2**20
    enough = free_gib >= MIN_MEMORY_GIB
    advice = (
        "" if enough else f"the nodes and their spares need {MIN_MEMORY_GIB:g} GiB; runtime.spares=false halves that"
    )
    yield Finding("memory", "ok" if enough else "warning", f"{free_gib:.1f} GiB available", advice)


def _runtime_dir(configuration: Configuration) -> Iterator[Finding]:
    try:
        directory = runtime_dir_of(configuration.vehicle, configuration.runtime_dir)
    except (OSError, ValueError) as error:
        yield Finding("runtime directory", "error", str(error), "set runtime.runtime_dir to a directory of this user")
    else:
        yield Finding("runtime directory", "ok", str(directory))


def _shared_memory(configuration: Configuration) -> Iterator[Finding]:
    try:
        place = ring_path(configuration.vehicle, configuration.runtime_dir).parent
    except (OSError, ValueError):
        return  # reported by `_runtime_dir`
    camera = configuration.camera
    pixels = 1920 * 1080 if camera is None else camera.width_px * camera.height_px
    needed, free = RING_MARGIN * pixels * 3 * configuration.runtime.ring_slots, shutil.disk_usage(place).free
    found = f"{place}: {free / 2**20:.0f} MiB free, frames need {needed / 2**20:.0f}"
    if free < needed:
        yield Finding("shared memory", "error", found, f"mount -o remount,size={needed / 2**20:.0f}M {place}")
    elif str(place) != "/dev/shm":
        yield Finding("shared memory", "warning", found, "/dev/shm is not writable: frames are stored in a file system")
    else:
        yield Finding("shared memory", "ok", found)


def _disk(configuration: Configuration) -> Iterator[Finding]:
    place = Path(configuration.output).absolute()
    while not place.exists():
        place = place.parent
    free_gib = shutil.disk_usage(place).free / 2**30
    if not os.access(place, os.W_OK):
        yield Finding("output", "error", f"{place} is not writable", "name another --output")
    elif free_gib < 1.0:
        yield Finding("output", "warning", f"{place}: {free_gib:.1f} GiB free", "an hour of results is about 0.1 GiB")
    else:
        yield Finding("output", "ok", f"{place}: {free_gib:.0f} GiB free")


def _clock(configuration: Configuration) -> Iterator[Finding]:
    source = Path("/sys/devices/system/clocksource/clocksource0/current_clocksource")
    name = source.read_text().strip() if source.exists() else "unknown"
    if name in ("hpet", "acpi_pm", "jiffies"):
        yield Finding("clock", "warning", f"{name} is slow to read", "clocksource=tsc on the kernel's command line")
        return
    late_ms = max(_lateness_ms() for _ in range(20))
    verdict: Verdict = "ok" if late_ms < 5.0 else "warning"
    advice = "" if verdict == "ok" else "the machine is busy, or its idle states are too deep (cpupower idle-set -D 10)"
    yield Finding("clock", verdict, f"{name}, a sleep of 5 ms is late by up to {late_ms:.1f} ms", advice)


def _utc(configuration: Configuration) -> Iterator[Finding]:
    """Checks UTC, which planners on other machines need."""
    advice = "start a time service (chrony, systemd-timesyncd): planners on other machines use t_utc_ns"
    if time.time() < 1.6e9:
        yield Finding("UTC", "warning", "the date is before 2020", advice)
    elif not _synchronised():
        yield Finding("UTC", "warning", "not synchronized by a time service", advice)
    else:
        yield Finding("UTC", "ok", "synchronized by a time service")


def _synchronised() -> bool:
    """Whether a time daemon synchronizes the clock; otherwise adjtimex(2) returns TIME_ERROR."""
    libc, timex = ctypes.CDLL(None), ctypes.create_string_buffer(_TIMEX_BYTES)  # zeros: read only
    return 0 <= libc.adjtimex(timex) < _TIME_ERROR


def _lateness_ms() -> float:
    start_s = time.monotonic()
    time.sleep(0.005)
    return (time.monotonic() - start_s - 0.005) * 1e3


def _models(configuration: Configuration) -> Iterator[Finding]:
    specs = configuration.models.in_use()
    if not specs:
        yield Finding("models", "warning", "none: odometry only", "omit --model none to run the shipped network")
    from birdslam.perception.session import available_providers

    here = ", ".join(available_providers())
    for role, spec in specs.items():
        asked = spec.provider or configuration.perceive.provider
        try:
            network = load_network(role, msgspec.structs.replace(spec, provider=asked))
            described = network.describe()
        except ModelError as error:
            yield Finding(role, "error", str(error), "use the network that its manifest describes")
        else:
            found = f"{described['file']}, sha256 {described['sha256'][:12]}, by {asked} of {here}"
            if network.fell_back:
                advice = 'install its package (docs/networks.md), or set perceive.provider = "auto"'
                yield Finding(role, "warning", f"{found}: {network.fell_back}", advice)
            else:
                yield Finding(role, "ok", found)


def _source(configuration: Configuration) -> Iterator[Finding]:
    if not configuration.source.uri:
        yield Finding("camera", "warning", "none is configured", "--source v4l2:/dev/video0 --camera FILE")
        return
    try:
        source = open_source(configuration)
        first = next(source.frames())
    except (ConfigurationError, DatasetError, SourceError) as error:
        yield Finding("camera", "error", str(error), "check the cable, the files, and the group 'video'")
        return
    except StopIteration:
        yield Finding("camera", "error", f"{source.name}: has no frame", "record it again, or name another source")
        return
    source.close()
    size = "unreadable" if first.image is None else f"{first.image.shape[1]}x{first.image.shape[0]} px"
    verdict: Verdict = "error" if first.image is None else "ok"
    found = f"{source.name}: {size}, {source.rate_hz:g} Hz"
    yield Finding("camera", verdict, found, "" if first.image is not None else f"{first.error}: check the cable")
