"""One followed vehicle, as the tracker keeps it."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.se2 import SE2
from birdslam.types import MotionEdge
from birdslam.vehicles.localisation import Observation, Place


@dataclass(frozen=True)
class Shown:
    """Where a vehicle's last CV edge left it, in the odometry's world: its next VV edge starts there."""

    frame: int
    t_ns: int
    T_world_vehicle: SE2


@dataclass
class Track:
    """One vehicle; `state` is (x_m, y_m, vx_mps, vy_mps) of its centre in the odometry's world, `cov` (4, 4)."""

    state: NDArray[np.float64]
    cov: NDArray[np.float64]
    yaw_rad: float
    observation: Observation  # the last one
    place: Place  # and where it put the vehicle, in the ego of frame `seen_frame`
    serial: int  # known to the horizon by it
    first_m: NDArray[np.float64]  # (2,) where it was first seen, in the odometry's world
    first_sight_m: NDArray[np.float64]  # (2,) from the ego to there, along world's axes
    seen_frame: int
    seen_ns: int
    T_world_ego: SE2  # of frame `seen_frame`
    shown: Shown | None = None  # None until it has an id, since edges name it
    vehicle: int = -1  # the persistent id, once confirmed
    hits: int = 1
    missed: int = 0  # times that the detector looked since and did not see it
    votes: Counter[str] = field(default_factory=Counter)
    sigma_yaw_rad: float = 0.0  # of a yaw that motion has shown
    yaw_known: bool = False
    front_logit: float = 0.0  # of the yaw's end being the front, by what a network saw of the body
    stands: bool = False  # in all likelihood
    motion: MotionEdge | None = None  # VV: from when it was last shown to now, as predicted before it was seen again

    @property
    def label(self) -> str:
        return max(sorted(self.votes), key=self.votes.__getitem__)

    def pose(self) -> SE2:
        """T_world_vehicle in the odometry's world."""
        return SE2(float(self.state[0]), float(self.state[1]), self.yaw_rad)
