"""`birdslam doctor`: whether this machine can keep what a vehicle needs, and what to do where it can't."""

from __future__ import annotations

import os
import resource
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from birdslam.datasets import DatasetError
from birdslam.perception import ModelError, load_network
from runtime import realtime
from runtime.configuration import Configuration, ConfigurationError
from runtime.presence import ring_path, runtime_dir_of
from runtime.sources import CameraSource, SourceError, open_source

Verdict = Literal["ok", "warning", "failed"]
LEAST_CORES = 4
RING_MARGIN = 2.0  # /dev/shm holds a second ring while a restarted capture replaces its own


@dataclass(frozen=True)
class Finding:
    """One row: what was looked at, how it is, and what to do where it is not well."""

    what: str
    verdict: Verdict
    found: str
    advice: str = ""


def examine(configuration: Configuration) -> Iterator[Finding]:
    """All checks, one after the other; those of the source and the models only where they are configured."""
    checks: tuple[Callable[[Configuration], Iterator[Finding]], ...] = (
        *(_cores, _governor, _scheduling, _memory_lock, _runtime_dir, _shared_memory, _disk, _clock),
        *(_models, _source),
    )
    for check in checks:
        yield from check(configuration)


def table(findings: list[Finding]) -> str:
    """For a person."""
    rows = [f"{f.verdict:8}{f.what:18}{f.found}{f'  ->  {f.advice}' if f.advice else ''}" for f in findings]
    return "\n".join(rows)


def _cores(configuration: Configuration) -> Iterator[Finding]:
    cores = len(os.sched_getaffinity(0))
    load = os.getloadavg()[0]
    enough = cores >= LEAST_CORES
    yield Finding(
        *("cores", "ok" if enough else "warning", f"{cores} usable, load {load:.1f}"),
        "" if enough else f"33 frames a second want {LEAST_CORES} cores: choose smaller networks or a lower rate",
    )


def _governor(configuration: Configuration) -> Iterator[Finding]:
    files = sorted(Path("/sys/devices/system/cpu").glob("cpu[0-9]*/cpufreq/scaling_governor"))
    found = sorted({path.read_text().strip() for path in files})
    if not found:
        yield Finding("governor", "ok", "the kernel offers none (a virtual machine sets its own speed)")
    elif found == ["performance"]:
        yield Finding("governor", "ok", "performance")
    else:
        yield Finding("governor", "warning", ", ".join(found), "cpupower frequency-set -g performance")


def _scheduling(configuration: Configuration) -> Iterator[Finding]:
    before, parameter = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
        os.sched_setscheduler(0, before, parameter)
    except PermissionError:
        advice = "LimitRTPRIO= in the unit, or rtprio in /etc/security/limits.conf"
        yield Finding("SCHED_FIFO", "warning", "not permitted", advice)
    else:
        yield Finding("SCHED_FIFO", "ok", "permitted")


def _memory_lock(configuration: Configuration) -> Iterator[Finding]:
    if realtime.may_lock_memory():
        yield Finding("memory lock", "ok", "permitted")
    else:
        limit_kib = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] // 1024
        yield Finding("memory lock", "warning", f"limited to {limit_kib} KiB", "LimitMEMLOCK=infinity in the unit")


def _runtime_dir(configuration: Configuration) -> Iterator[Finding]:
    try:
        directory = runtime_dir_of(configuration.vehicle, configuration.runtime_dir)
    except (OSError, ValueError) as error:
        yield Finding("runtime directory", "failed", str(error), "set runtime.runtime_dir to a directory of this user")
    else:
        yield Finding("runtime directory", "ok", str(directory))


def _shared_memory(configuration: Configuration) -> Iterator[Finding]:
    try:
        place = ring_path(configuration.vehicle, configuration.runtime_dir).parent
    except (OSError, ValueError):
        return  # said already
    camera = configuration.camera
    pixels = 1920 * 1080 if camera is None else camera.width_px * camera.height_px
    needed, free = RING_MARGIN * pixels * 3 * configuration.runtime.ring_slots, shutil.disk_usage(place).free
    found = f"{place}: {free / 2**20:.0f} MiB free, frames need {needed / 2**20:.0f}"
    if free < needed:
        yield Finding("shared memory", "failed", found, f"mount -o remount,size={needed / 2**20:.0f}M {place}")
    elif str(place) != "/dev/shm":
        yield Finding("shared memory", "warning", found, "/dev/shm is not writable: frames go over a file system")
    else:
        yield Finding("shared memory", "ok", found)


def _disk(configuration: Configuration) -> Iterator[Finding]:
    place = Path(configuration.output).absolute()
    while not place.exists():
        place = place.parent
    free_gib = shutil.disk_usage(place).free / 2**30
    if not os.access(place, os.W_OK):
        yield Finding("output", "failed", f"{place} can't be written", "choose another --output")
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
    advice = "" if verdict == "ok" else "the machine is busy, or sleeps too deep (cpupower idle-set -D 10)"
    yield Finding("clock", verdict, f"{name}, a sleep of 5 ms is late by up to {late_ms:.1f} ms", advice)
    if time.time() < 1.6e9:
        yield Finding("UTC", "warning", "the date is before 2020", "start a time service (chrony, systemd-timesyncd)")


def _lateness_ms() -> float:
    begun_s = time.monotonic()
    time.sleep(0.005)
    return (time.monotonic() - begun_s - 0.005) * 1e3


def _models(configuration: Configuration) -> Iterator[Finding]:
    specs = configuration.models.in_use()
    if not specs:
        yield Finding("models", "warning", "none", "without --model none the shipped network runs; now odometry only")
    for role, spec in specs.items():
        try:
            described = load_network(role, spec).describe()
        except ModelError as error:
            yield Finding(role, "failed", str(error), "give the network that its manifest describes")
        else:
            yield Finding(role, "ok", f"{described['file']}, sha256 {described['sha256'][:12]}")


def _source(configuration: Configuration) -> Iterator[Finding]:
    if not configuration.source.uri:
        yield Finding("camera", "warning", "none is configured", "--source v4l2:/dev/video0 --camera FILE")
        return
    try:
        source = open_source(configuration)
        first = next(source.frames())
    except (ConfigurationError, DatasetError, SourceError) as error:
        yield Finding("camera", "failed", str(error), "check the cable, the camera file, and the group 'video'")
        return
    except StopIteration:
        yield Finding("camera", "failed", f"{source.name}: has no frame")
        return
    if isinstance(source, CameraSource):
        source.close()
    size = "unreadable" if first.image is None else f"{first.image.shape[1]}x{first.image.shape[0]} px"
    verdict: Verdict = "failed" if first.image is None else "ok"
    yield Finding("camera", verdict, f"{source.name}: {size}, {source.rate_hz:g} Hz", first.error or "")
