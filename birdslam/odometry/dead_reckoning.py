"""Dead reckoning: composes motions to the ego's pose on the road plane, its height and its tilt."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.geometry.se2 import SE2
from birdslam.odometry.motion import Motion
from birdslam.types import Attitude, EgoEdge


class DeadReckoning:
    """The ego's pose in the frame of its first motion, the local world frame of tracks, lanes and attitude.

    State: `T_world_ego` (m, rad) and `attitude` (m, rad) at frame `frame`. Input: each `Motion`. A motion starts at its
    `from_frame`, which need not be the newest frame: the next measured motion replaces a coasted one. The tilt decays
    over `memory_m` metres of travel, since roads are level on average.
    """

    def __init__(self, camera: Camera, memory_m: float) -> None:
        self._T_ego_cam = np.eye(4)
        self._T_ego_cam[:3, :3] = camera.ground.R_ego_cam
        self._T_ego_cam[2, 3] = camera.height_m
        self._T_cam_ego = np.linalg.inv(self._T_ego_cam)
        self._memory_m = memory_m
        self.T_world_ego = SE2()
        self.attitude = Attitude()
        self._from = (-1, self.T_world_ego, self.attitude)  # the start of the last motion
        self._to = self._from

    @property
    def frame(self) -> int:
        """Frame of `T_world_ego`; -1 before the first motion."""
        return self._to[0]

    def advance(self, motion: Motion) -> EgoEdge:
        """Moves to `motion.to_frame` and returns the CC edge from the previous frame.

        The motion starts at `motion.from_frame`, the start or the end of the last motion. The edge starts at the last
        frame even if that was coasted, so that no edge refers to a frame that the graph has marginalized.
        """
        last_frame, T_world_last = self.frame, self.T_world_ego
        self._chain(motion)
        chained = last_frame not in (-1, motion.from_frame)
        return EgoEdge(
            from_frame=last_frame if chained else motion.from_frame,
            to_frame=motion.to_frame,
            T_from_to=T_world_last.between(self.T_world_ego) if chained else motion.T_prev_curr,
            cov=tuple(np.ravel(motion.cov).tolist()),
        )

    def _chain(self, motion: Motion) -> None:
        if motion.from_frame != self._from[0] or self._from[0] < 0:
            self._from = (motion.from_frame, *self._to[1:])
        _, T_world_ego, attitude = self._from
        T_prev_curr = np.eye(4)
        T_prev_curr[:3, :3] = motion.R_prev_curr
        T_prev_curr[:3, 3] = motion.t_prev_curr_m
        T_ego_prev_curr = self._T_ego_cam @ T_prev_curr @ self._T_cam_ego
        R = _tilt(attitude) @ T_ego_prev_curr[:3, :3]
        dz_m = float((_tilt(attitude) @ T_ego_prev_curr[:3, 3])[2])
        keep = math.exp(-float(np.linalg.norm(motion.t_prev_curr_m)) / self._memory_m)
        self.T_world_ego = T_world_ego @ motion.T_prev_curr
        self.attitude = Attitude(
            z_m=attitude.z_m + dz_m,
            pitch_rad=keep * math.asin(max(-1.0, min(1.0, -R[2, 0]))),
            roll_rad=keep * math.atan2(R[2, 1], R[2, 2]),
        )
        self._to = (motion.to_frame, self.T_world_ego, self.attitude)


def _tilt(attitude: Attitude) -> NDArray[np.float64]:
    """(3, 3) rotation from ego to a level frame of the same yaw, Ry(pitch) Rx(roll)."""
    level = GroundPlane(1.0, attitude.pitch_rad, attitude.roll_rad).R_ego_cam
    out: NDArray[np.float64] = level @ GroundPlane(1.0).R_ego_cam.T
    return out
