"""How many cores this process may use."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

CGROUPS = Path("/sys/fs/cgroup")


def usable_cores() -> float:
    """By its affinity and by the quota of its control groups."""
    return min(float(len(os.sched_getaffinity(0))), quota(CGROUPS))


def quota(root: Path) -> float:
    """Cores that this process' control groups, in the tree at `root`, leave it; infinite where they set no limit."""
    group = Path("/proc/self/cgroup").read_text().strip().rpartition("::")[2].lstrip("/")
    limits = [float("inf")]
    for place in (root / group, *(root / group).parents):
        if not place.is_relative_to(root):
            break
        with contextlib.suppress(OSError, ValueError):
            allowed, period = (place / "cpu.max").read_text().split()
            limits.append(float(allowed) / float(period))  # "max" is no number, and no limit
    return min(limits)
