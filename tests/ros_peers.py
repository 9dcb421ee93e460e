"""The other side of ROS 2: processes of the independent package zenoh-ros2-sdk, and the estimates that they receive."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from birdslam.geometry.se2 import SE2
from birdslam.types import Estimate, VehicleEstimate
from tests.records import new_estimate

PEER = "tests.ros_peer"
COV = tuple(np.diag([0.01, 0.01, 1e-4]).ravel().tolist())


@contextmanager
def peer(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    """A process of ros_peer.py that is ready."""
    command = [sys.executable, "-m", PEER, *arguments]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout.readline().strip() == "ready", f"{PEER} {arguments[0]} did not start"
            yield process
        finally:
            process.kill()


def estimate(frame: int, vehicles: int) -> Estimate:
    """As a drive among so many vehicles gives it, captured now."""
    now_ns = time.time_ns()
    users = tuple(
        VehicleEstimate(
            vehicle=k, T_world_vehicle=SE2(10.0 + k, 3.0, 0.1), cov=COV, velocity_mps=(5.0, 0.0),
            velocity_cov=(0.1, 0.0, 0.0, 0.1), age_ns=0, frames=9, label="car", length_m=4.2, width_m=1.8,
        )
        for k in range(vehicles)
    )  # fmt: skip
    return new_estimate(
        frame_id=frame,
        t_source_ns=now_ns,
        t_capture_ns=time.monotonic_ns(),
        t_utc_ns=now_ns,
        T_world_ego=SE2(0.1 * frame, 0.0, 0.0),
        cov=COV,
        vehicles=users,
    )
