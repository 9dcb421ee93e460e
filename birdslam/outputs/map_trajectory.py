"""Where a drive was in a map: `map.tum.txt` for the frames that are localised, `localisation.csv` for all.

Frames before a place was confirmed are localised too where odometry leads back to them within the limits of what counts
as localised: the drive is over when this is written.
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
MAX_BACK_M = 15.0  # of way by odometry alone, back from where a place was confirmed
MAX_WAITING = 3000  # frames of an ego that stands somewhere unknown
HEADER = "t_s,state,x_m,y_m,yaw_rad,cov_xx,cov_xy,cov_xyaw,cov_yy,cov_yyaw,cov_yawyaw,inliers,map_epoch"


class _Moment(NamedTuple):
    """What of an estimate a row that waits is led back by: of whole ones, thousands would wait."""

    epoch: int
    T_world_ego: SE2
    valid: bool
    scale_sigma_rel: float


class MapTrajectory:
    """`add` takes every frame in order and gives those that are settled; `finish` gives the rest.

    A frame without a place waits for one until the ego is too far on to be led back from there.
    """

    def __init__(self) -> None:
        self._waiting: deque[tuple[Localisation, _Moment]] = deque()
        self.counts = {state.value: 0 for state in MapState}  # settled frames by their state
        self.first_ns: int | None = None  # source time of the first frame that was localised while driving
        self.frames_before = 0  # that came before it

    def add(self, localisation: Localisation, estimate: Estimate) -> list[Localisation]:
        """One frame."""
        moment = _Moment(estimate.epoch, estimate.T_world_ego, estimate.valid, estimate.scale_sigma_rel)
        localised = localisation.state is MapState.LOCALISED
        if localised and self.first_ns is None:
            self.first_ns = localisation.t_source_ns
        self.frames_before += self.first_ns is None
        self._waiting.append((localisation, moment))
        if localised:
            self._lead_back()
            return self.finish()
        out = []
        while len(self._waiting) > MAX_WAITING or self._too_far(moment):
            out.append(self._waiting.popleft()[0])
        return self._settled(out)

    def finish(self) -> list[Localisation]:
        """All that wait, as they are."""
        out = [localisation for localisation, _ in self._waiting]
        self._waiting.clear()
        return self._settled(out)

    def _too_far(self, newest: _Moment) -> bool:
        _, first = self._waiting[0]
        step = first.T_world_ego.between(newest.T_world_ego)
        return first.epoch != newest.epoch or math.hypot(step.x_m, step.y_m) > MAX_BACK_M

    def _settled(self, rows: list[Localisation]) -> list[Localisation]:
        for row in rows:
            self.counts[row.state.value] += 1
        return rows

    def _lead_back(self) -> None:
        found, newest = self._waiting[-1]
        assert found.T_map_ego is not None
        cov, way_m, later = found.cov, 0.0, newest
        for place in range(len(self._waiting) - 2, -1, -1):
            lost, moment = self._waiting[place]
            step = later.T_world_ego.between(moment.T_world_ego)
            way_m += math.hypot(step.x_m, step.y_m)
            cov = moved(cov, step, later.valid, later.scale_sigma_rel)
            if moment.epoch != newest.epoch or way_m > MAX_BACK_M or not is_exact(cov):
                return
            T_map_ego = found.T_map_ego @ newest.T_world_ego.between(moment.T_world_ego)
            led = Localisation(
                *(lost.frame_id, lost.t_source_ns, MapState.LOCALISED, T_map_ego, cov, found.attitude),
                map_epoch=found.map_epoch,
            )
            self._waiting[place], later = (led, moment), moment


class TrajectoryFiles(contextlib.AbstractContextManager["TrajectoryFiles"]):
    """`map.tum.txt` and `localisation.csv`, row by row, until `close`. Raises OSError."""

    def __init__(self, directory: Path) -> None:
        self._tum = (directory / FILES[0]).open("w", encoding="ascii")
        self._csv = (directory / FILES[1]).open("w", encoding="ascii", newline="")
        self._rows = csv.writer(self._csv, lineterminator="\n")
        self._rows.writerow(HEADER.split(","))

    def write(self, settled: Sequence[Localisation]) -> None:
        """The next frames."""
        for found in settled:
            if found.state is MapState.LOCALISED and found.T_map_ego is not None:
                self._tum.write(tum_row(found.t_source_ns, ego_pose(found.T_map_ego, found.attitude)) + "\n")
            self._rows.writerow(_row(found))

    def close(self) -> None:
        """All is written."""
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
