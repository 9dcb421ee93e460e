"""Where a drive was in a map: `map.tum.txt` for the frames that are localised, `localisation.csv` for all.

Frames before a place was confirmed are localised too where odometry leads back to them within the limits of what counts
as localised: the drive is over when this is written.
"""

from __future__ import annotations

import csv
import math
from collections import Counter
from pathlib import Path

import numpy as np

from birdslam.geometry.se2 import SE2
from birdslam.loops.localiser import (
    LOST_SIGMA_M,
    LOST_SIGMA_RAD,
    Localisation,
    MapState,
    moved,
)
from birdslam.trajectory import ego_pose, tum_row
from birdslam.types import NS_PER_S, Estimate

FILES = "map.tum.txt", "localisation.csv"
MOST_BACK_M = 15.0  # of way by odometry alone, back from where a place was confirmed
HEADER = "t_s,state,x_m,y_m,yaw_rad,cov_xx,cov_xy,cov_xyaw,cov_yy,cov_yyaw,cov_yawyaw,inliers,map_epoch"


class MapTrajectory:
    """`add` takes every frame in order; `write` makes the files."""

    def __init__(self) -> None:
        self._rows: list[tuple[Localisation, SE2, int]] = []  # with T_odom_ego and the epoch of odometry
        self.as_found: list[MapState] = []  # the frames' states as they were known while driving

    def add(self, localisation: Localisation, estimate: Estimate) -> None:
        """One frame."""
        self.as_found.append(localisation.state)
        first = bool(self._rows) and self._rows[-1][0].state is not MapState.LOCALISED
        self._rows.append((localisation, estimate.T_world_ego, estimate.epoch))
        if localisation.state is MapState.LOCALISED and first:
            self._lead_back()

    def _lead_back(self) -> None:
        found, T_odom_found, epoch = self._rows[-1]
        assert found.T_map_ego is not None
        cov, way_m, T_later = found.cov, 0.0, T_odom_found
        for place in range(len(self._rows) - 2, -1, -1):
            lost, T_odom_ego, of_epoch = self._rows[place]
            step = T_later.between(T_odom_ego)
            way_m += math.hypot(step.x_m, step.y_m)
            cov = moved(cov, step)
            exact = max(cov[0, 0], cov[1, 1]) < LOST_SIGMA_M**2 and cov[2, 2] < LOST_SIGMA_RAD**2
            if lost.state is MapState.LOCALISED or of_epoch != epoch or way_m > MOST_BACK_M or not exact:
                return
            T_map_ego = found.T_map_ego @ T_odom_found.between(T_odom_ego)
            led = Localisation(
                *(lost.frame_id, lost.t_source_ns, MapState.LOCALISED, T_map_ego, cov, found.attitude),
                map_epoch=found.map_epoch,
            )
            self._rows[place], T_later = (led, T_odom_ego, of_epoch), T_odom_ego

    @property
    def counts(self) -> dict[str, int]:
        """Frames by their state."""
        counted = Counter(localisation.state.value for localisation, _, _ in self._rows)
        return {state.value: counted[state.value] for state in MapState}

    def localised(self) -> list[Localisation]:
        """The frames with a pose in the map."""
        return [localisation for localisation, _, _ in self._rows if localisation.state is MapState.LOCALISED]

    def write(self, directory: Path) -> None:
        """Raises OSError."""
        with (directory / FILES[0]).open("w", encoding="ascii") as tum:
            for found in self.localised():
                assert found.T_map_ego is not None
                tum.write(tum_row(found.t_source_ns, ego_pose(found.T_map_ego, found.attitude)) + "\n")
        with (directory / FILES[1]).open("w", encoding="ascii", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(HEADER.split(","))
            writer.writerows(_row(localisation) for localisation, _, _ in self._rows)


def _row(found: Localisation) -> list[str]:
    seconds, rest = divmod(found.t_source_ns, NS_PER_S)
    time = f"{seconds}.{rest:09d}" if found.t_source_ns >= 0 else f"{found.t_source_ns / NS_PER_S:.9f}"
    pose: list[str] = [""] * 9
    if found.T_map_ego is not None:
        T, upper = found.T_map_ego, found.cov[np.triu_indices(3)]
        pose = [f"{T.x_m:.4f}", f"{T.y_m:.4f}", f"{T.yaw_rad:.6f}", *(f"{number:.3e}" for number in upper)]
    return [time, found.state.value, *pose, str(found.inliers), str(found.map_epoch)]
