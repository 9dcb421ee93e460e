"""External odometry: motions from a metric trajectory of the camera, or of the ego on the road.

Poses are interpolated at the frame times. A frame without a pose is predicted at constant velocity and has the status
odometry_coasting. The ground is the calibrated plane. No corners are tracked, so that only lanes have CP edges.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera
from birdslam.geometry.pose import Pose
from birdslam.geometry.se2 import SE2
from birdslam.geometry.timed_poses import TimedPoses
from birdslam.odometry.motion import Motion, MotionConfig, coasting_cov, on_plane, planar
from birdslam.types import NS_PER_S, SpeedReading, Status

Floats = NDArray[np.float64]
NotNegative = Annotated[float, msgspec.Meta(ge=0.0)]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]

_MIN_S = 1e-6


class ExternalConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The uncertainty of a trajectory that states none."""

    ego: bool = False  # poses are of the ego on the road, x forward; False: of the camera, z forward
    sigma_scale_rel: NotNegative = 0.02  # 1-sigma of the scale: of the distance travelled, along the motion
    sigma_direction_rad: NotNegative = 0.005  # 1-sigma of the direction of travel
    sigma_yaw_rad: Positive = 0.0005  # 1-sigma of a turn between two frames
    sigma_turn_rel: NotNegative = 0.01  # 1-sigma proportional to the turn
    sigma_floor_m: Positive = 0.002  # minimum 1-sigma of a motion
    longest_gap_s: Positive = 0.25  # maximum gap between two interpolated poses
    longest_coast_s: Positive = 2.0  # maximum time without a pose; then the world restarts
    sigma_pitch_rad: Positive = 0.006  # 1-sigma of the road against the calibrated plane


class WithoutImages:
    """Base of an EgoMotion that uses no images."""

    bonnet_px: Floats | None = None

    @property
    def road_tracks(self) -> tuple[NDArray[np.int64], Floats]:
        """Empty: no corners are tracked."""
        return np.zeros(0, np.int64), np.zeros((0, 2))

    def track(self, image: NDArray[np.uint8]) -> None:
        """Does nothing."""


class ExternalOdometry(WithoutImages):
    """An EgoMotion of the front end from `trajectory`, of the camera or, with `config.ego`, of the ego."""

    def __init__(self, camera: Camera, trajectory: TimedPoses, config: ExternalConfig) -> None:
        self.camera = camera
        self.config = config
        self._trajectory = trajectory
        self._max_gap_ns = round(config.longest_gap_s * NS_PER_S)
        self._coasting = MotionConfig()
        self._last: tuple[int, int, Pose] | None = None  # frame, time and pose of the last frame with a pose
        self._velocity: tuple[SE2, float] | None = None  # the last motion and its duration in s

    def estimate(
        self,
        tracks: None,
        frame_id: int,
        t_source_ns: int,
        vehicle_boxes_px: Floats,
        road_mask: NDArray[np.bool_] | None = None,
        speeds: Sequence[SpeedReading] = (),
    ) -> Motion | None:
        """The motion since the last frame with a pose; None if there is none. Ignores the car's speed."""
        pose, last = self._trajectory.at(frame_id, t_source_ns, self._max_gap_ns), self._last
        if last is None or pose is None:
            if pose is not None:
                self._last = frame_id, t_source_ns, pose
                return None
            return None if last is None else self._coast(*last[:2], frame_id, t_source_ns)
        last_frame, last_ns, before = last
        step = before.between(pose)
        if self.config.ego:
            mount = Pose(self.camera.ground.R_ego_cam, np.array([0.0, 0.0, self.camera.ground.height_m]))
            step = mount.inverse() @ step @ mount
        T = planar(step, self.camera.ground)
        self._last = frame_id, t_source_ns, pose
        self._velocity = T, max((t_source_ns - last_ns) / NS_PER_S, _MIN_S)
        return self._motion(last_frame, frame_id, step, T, self._cov(T))

    def _coast(self, from_frame: int, from_ns: int, frame_id: int, t_source_ns: int) -> Motion | None:
        """The constant-velocity prediction; None after `longest_coast_s`."""
        elapsed_s = (t_source_ns - from_ns) / NS_PER_S
        if elapsed_s > self.config.longest_coast_s:
            self._last = self._velocity = None
            return None
        T = SE2()
        if self._velocity is not None:
            moved, dt_s = self._velocity
            T = SE2.exp(moved.log() * (elapsed_s / dt_s))
        cov = coasting_cov(self._coasting, T, elapsed_s, self._velocity is not None, self.config.sigma_scale_rel)
        step = on_plane(T, self.camera.ground)
        return self._motion(from_frame, frame_id, step, T, cov, (Status.ODOMETRY_COASTING,))

    def _cov(self, T: SE2) -> Floats:
        """(3, 3) covariance of a motion of the trajectory, in the axes of its end pose."""
        config = self.config
        along = np.array([T.x_m, T.y_m, 0.0])
        across = np.array([-T.y_m, T.x_m, 0.0])
        yaw = config.sigma_yaw_rad**2 + (config.sigma_turn_rel * T.yaw_rad) ** 2
        out: Floats = np.diag([config.sigma_floor_m**2, config.sigma_floor_m**2, yaw])
        out += config.sigma_scale_rel**2 * np.outer(along, along)
        return out + config.sigma_direction_rad**2 * np.outer(across, across)

    def _motion(
        self, from_frame: int, frame_id: int, step: Pose, T: SE2, cov: Floats, status: tuple[Status, ...] = ()
    ) -> Motion:
        return Motion(
            from_frame=from_frame,
            to_frame=frame_id,
            R_prev_curr=step.R,
            t_prev_curr_m=step.p,
            T_prev_curr=T,
            cov=cov,
            scale_sigma_rel=self.config.sigma_scale_rel,
            ground=self.camera.ground,
            tilt_cov=np.eye(2) * self.config.sigma_pitch_rad**2,
            standstill=False,
            status=status,
        )
