"""The machine under test: its description, and the CPU time that the hypervisor steals."""

from __future__ import annotations

import os
import platform
import subprocess
import time
from pathlib import Path
from typing import Any

import psutil

from birdslam.runtime.environment import library_versions

ROOT = Path(__file__).resolve().parent.parent.parent
_STEAL = 7  # of /proc/stat's columns: user nice system idle iowait irq softirq steal guest guest_nice
_TICKS = slice(0, 8)  # guest time is counted in user time already


def describe() -> dict[str, Any]:
    """Returns the date, the commit, the machine and the versions of the libraries, for the head of a report."""
    models = [line.partition(":")[2].strip() for line in _lines("/proc/cpuinfo") if line.startswith("model name")]
    return {
        "utc": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "cpu": models[0] if models else platform.processor(),
        "cores": os.cpu_count(),
        "memory_gb": round(psutil.virtual_memory().total / 2**30, 1),
        "kernel": f"{platform.system()} {platform.release()}",
        "hypervisor": any("hypervisor" in line for line in _lines("/proc/cpuinfo") if line.startswith("flags")),
        "load_before": round(os.getloadavg()[0], 2),
        "commit": _git("rev-parse", "--short=12", "HEAD"),
        "uncommitted_files": len(_git("status", "--porcelain").splitlines()),
        "versions": library_versions(),
    }


def describe_text(machine: dict[str, Any]) -> str:
    """Formats the result of `describe` in one line."""
    versions = ", ".join(f"{name} {version}" for name, version in machine["versions"].items())
    changed = f" with {machine['uncommitted_files']} uncommitted files" if machine["uncommitted_files"] else ""
    return f"{machine['utc']}, commit {machine['commit'] or 'unknown'}{changed}, {machine['cpu']}; {versions}"


def _lines(path: str) -> list[str]:
    return Path(path).read_text(encoding="utf-8").splitlines()


def _git(*arguments: str) -> str:
    try:
        done = subprocess.run(["git", "-C", str(ROOT), *arguments], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return ""  # not a git checkout
    return done.stdout.strip()


class Steal:
    """The share of CPU time stolen by the hypervisor since construction."""

    def __init__(self) -> None:
        self._started = _ticks()

    def percent(self) -> float:
        """Percent of the time of all cores."""
        passed = [now - then for now, then in zip(_ticks(), self._started, strict=True)]
        return round(100.0 * passed[_STEAL] / max(1, sum(passed)), 3)


def _ticks() -> list[int]:
    return [int(n) for n in _lines("/proc/stat")[0].split()[1:]][_TICKS]
