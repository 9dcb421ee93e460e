"""Writes the poses of a drive in a map: `map.tum.txt` has localised frames, `localisation.csv` all frames.

Odometry propagates a localisation back to earlier frames, as long as its covariance stays within the limit.
"""

from __future__ import annotations

import contextlib
import csv
import math
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from birdslam.geometry.se2 import SE2
from birdslam.loops.drift import is_exact, moved
from birdslam.loops.localiser import Localisation
from birdslam.loops.map_pose import MapState
from birdslam.trajectory import ego_pose, tum_row
from birdslam.types import NS_PER_S, Estimate

FILES = "map.tum.txt", "localisation.csv"
MAX_BACK_M = 15.0  # travelled between an earlier frame and the localisation
MAX_WAITING_FRAMES = 3000  # bounds memory if the ego is stationary
HEADER = "t_s,state,x_m,y_m,yaw_rad,cov_xx,cov_xy,cov_xyaw,cov_yy,cov_yyaw,cov_yawyaw,inliers,map_epoch"


class _EgoState(NamedTuple):
    """The fields of an estimate that back propagation needs; thousands of frames may wait."""

    epoch: int
    T_world_ego: SE2
    valid: bool
    scale_sigma_rel: float


class MapTrajectory:
    """`add` takes every frame in order and returns the settled ones; `finish` returns the rest.

    A frame that is not localised waits until the ego has moved more than MAX_BACK_M.
    """

    def __init__(self) -> None:
        self._waiting: deque[tuple[Localisation, _EgoState]] = deque()
        self.counts = {state.value: 0 for state in MapState}  # settled frames by state
        self.first_ns: int | None = None  # source time of the first frame that was localised during the drive
        self.frames_before = 0  # before that frame

    def add(self, localisation: Localisation, estimate: Estimate) -> list[Localisation]:
        """Adds one frame."""
        state = _EgoState(estimate.epoch, estimate.T_world_ego, estimate.valid, estimate.scale_sigma_rel)
        is_localised = localisation.state is MapState.LOCALISED
        if is_localised and self.first_ns is None:
            self.first_ns = localisation.t_source_ns
        self.frames_before += self.first_ns is None
        self._waiting.append((localisation, state))
        if is_localised:
            self._propagate_back()
            return self.finish()
        out = []
        while len(self._waiting) > MAX_WAITING_FRAMES or self._is_too_far(state):
            out.append(self._waiting.popleft()[0])
        return self._settled(out)

    def finish(self) -> list[Localisation]:
        """Returns all waiting frames."""
        out = [localisation for localisation, _ in self._waiting]
        self._waiting.clear()
        return self._settled(out)

    def _is_too_far(self, newest: _EgoState) -> bool:
        _, first = self._waiting[0]
        step = first.T_world_ego.between(newest.T_world_ego)
        return first.epoch != newest.epoch or math.hypot(step.x_m, step.y_m) > MAX_BACK_M

    def _settled(self, rows: list[Localisation]) -> list[Localisation]:
        for row in rows:
            self.counts[row.state.value] += 1
        return rows

    def _propagate_back(self) -> None:
        found, newest = self._waiting[-1]
        assert found.T_map_ego is not None
        cov, travelled_m, later = found.cov, 0.0, newest
        for index in range(len(self._waiting) - 2, -1, -1):
            lost, state = self._waiting[index]
            step = later.T_world_ego.between(state.T_world_ego)
            travelled_m += math.hypot(step.x_m, step.y_m)
            cov = moved(cov, step, later.valid, later.scale_sigma_rel)
            if state.epoch != newest.epoch or travelled_m > MAX_BACK_M or not is_exact(cov):
                return
            T_map_ego = found.T_map_ego @ newest.T_world_ego.between(state.T_world_ego)
            propagated = Localisation(
                *(lost.frame_id, lost.t_source_ns, MapState.LOCALISED, T_map_ego, cov, found.attitude),
                map_epoch=found.map_epoch,
            )
            self._waiting[index], later = (propagated, state), state


class TrajectoryFiles(contextlib.AbstractContextManager["TrajectoryFiles"]):
    """Writes `map.tum.txt` and `localisation.csv` row by row, until `close`. Raises OSError."""

    def __init__(self, directory: Path) -> None:
        self._tum = (directory / FILES[0]).open("w", encoding="ascii")
        self._csv = (directory / FILES[1]).open("w", encoding="ascii", newline="")
        self._rows = csv.writer(self._csv, lineterminator="\n")
        self._rows.writerow(HEADER.split(","))

    def write(self, settled: Sequence[Localisation]) -> None:
        """Writes the next frames."""
        for found in settled:
            if found.state is MapState.LOCALISED and found.T_map_ego is not None:
                self._tum.write(tum_row(found.t_source_ns, ego_pose(found.T_map_ego, found.attitude)) + "\n")
            self._rows.writerow(_row(found))

    def close(self) -> None:
        """Closes the files."""
        self._tum.close()
        self._csv.close()

    def __exit__(self, *failure: object) -> None:
        self.close()


def _row(found: Localisation) -> list[str]:
    seconds, rest = divmod(found.t_source_ns, NS_PER_S)
    time = f"{seconds}.{rest:09d}" if found.t_source_ns >= 0 else f"{found.t_source_ns / NS_PER_S:.9f}"
    pose: list[str] = [""] * 9
    if found.T_map_ego is not None:
        T, upper = found.T_map_ego, found.cov[np.triu_indices(3)]
        pose = [f"{T.x_m:.4f}", f"{T.y_m:.4f}", f"{T.yaw_rad:.6f}", *(f"{number:.3e}" for number in upper)]
    return [time, found.state.value, *pose, str(found.inliers), str(found.map_epoch)]
