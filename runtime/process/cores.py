"""Number of cores that this process may use."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

CGROUPS = Path("/sys/fs/cgroup")


def usable_cores() -> float:
    """Returns the number of cores allowed by the CPU affinity and the quota of the control groups."""
    return min(float(len(os.sched_getaffinity(0))), quota(CGROUPS))


def quota(root: Path) -> float:
    """Returns the CPU quota of this process's control groups, in cores; infinite without a limit."""
    group = Path("/proc/self/cgroup").read_text().strip().rpartition("::")[2].lstrip("/")
    limits = [float("inf")]
    for place in (root / group, *(root / group).parents):
        if not place.is_relative_to(root):
            break
        with contextlib.suppress(OSError, ValueError):
            allowed, period = (place / "cpu.max").read_text().split()
            limits.append(float(allowed) / float(period))  # "max" means no limit
    return min(limits)
