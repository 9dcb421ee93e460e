"""Processes that benchmarks start: `birdslam` and its nodes."""

from __future__ import annotations

import contextlib
import socket
import sys
from collections.abc import Collection

import psutil


def birdslam_command(*arguments: str) -> list[str]:
    """The command line of `birdslam` with this interpreter."""
    return [sys.executable, "-m", "birdslam.runtime.cli.main", *arguments]


def processes_of(pid: int, names: Collection[str]) -> dict[str, psutil.Process]:
    """The processes of a run by name: "supervisor" with this pid, each node, and "NODE spare" for its spare."""
    found = {"supervisor": psutil.Process(pid)}
    children = []
    with contextlib.suppress(psutil.NoSuchProcess):
        for child in found["supervisor"].children():
            with contextlib.suppress(psutil.Error):  # the process has ended
                children.append((child.create_time(), child.pid, child, child.cmdline()))
    for _, _, child, command in sorted(children, key=lambda one: one[:2]):  # a spare is younger than its node
        for name in names:
            if name in command:
                found[f"{name} spare" if name in found else name] = child
    return found


def free_port() -> int:
    """A free TCP port of this computer."""
    with socket.socket() as holder:
        holder.bind(("127.0.0.1", 0))
        port: int = holder.getsockname()[1]
        return port
