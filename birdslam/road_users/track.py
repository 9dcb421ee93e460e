"""A tracked vehicle, the frame of its observation, and the parameters of tracking."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.se2 import SE2
from birdslam.road_users.placement.localisation import Observation, Place
from birdslam.road_users.placement.uncertain_yaw import HeadingConfig
from birdslam.types import MotionEdge


class TrackingConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Parameters of association and of the motion model."""

    min_iou: float = 0.15  # with the predicted box
    birth_score: float = 0.5  # minimum score of a detection to start a track
    confirm_hits: int = 2  # number of detections until a track gets its id
    forget_unconfirmed_s: float = 0.25  # without a detection, of a track without an id
    forget_s: float = 1.0  # without a detection, of a track with an id
    sigma_accel_mps2: float = 3.0  # 1-sigma of a vehicle's acceleration
    moving_mps: float = 2.0  # minimum speed for a yaw by motion
    moving_sigma: float = 3.0  # and minimum Mahalanobis distance of the velocity from zero
    sigma_yaw_rate_radps: float = 0.5  # 1-sigma of a vehicle's turning
    direction_inflation: float = 3.0  # of the direction's sigma: its errors are correlated over frames
    body_yaw_inflation: float = 3.0  # of the sigma of a yaw from a network, for the same reason
    sigma_yaw_unknown_rad: float = 0.2  # of a CV edge's yaw before it is measured
    sigma_yaw_moving_rad: float = 0.1  # minimum of a CV edge's yaw after it is measured
    heading: HeadingConfig = HeadingConfig()
    standing_probability: float = 0.5  # above which a vehicle is stationary
    late_sigma_m: float = 3.0  # maximum position sigma of a late detection for an edge in the current frame


def in_vehicle_axes(cov: NDArray[np.float64], yaw_rad: float) -> tuple[float, float, float]:
    """(xx, xy, yy) of a covariance (2, 2) in axes rotated by `yaw_rad`, R' cov R, without arrays."""
    (xx, xy), (_, yy) = cov.tolist()
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return (
        c * c * xx + 2.0 * c * s * xy + s * s * yy,
        c * s * (yy - xx) + (c * c - s * s) * xy,
        s * s * xx - 2.0 * c * s * xy + c * c * yy,
    )


@dataclass(frozen=True)
class EgoFrame:
    """A frame and the ego pose in it, in the odometry world (dead reckoning since the start)."""

    frame_id: int
    t_source_ns: int
    T_world_ego: SE2
    step_cov: NDArray[np.float64] | None = None  # (3, 3) of the step to it, in its tangent space; None without odometry


@dataclass(frozen=True)
class LastEdge:
    """Pose of a vehicle at its last CV edge in the odometry world, where its next VV edge starts."""

    frame: int
    t_ns: int
    T_world_vehicle: SE2


@dataclass(kw_only=True)
class Track:
    """A tracked road user."""

    frame: EgoFrame  # of the last box
    number: int = -1  # persistent id, once confirmed
    hits: int = 1
    missed: int = 0  # number of frames with detections since the last box
    votes: Counter[str] = field(default_factory=Counter)  # labels of its boxes


@dataclass(kw_only=True)
class VehicleTrack(Track):
    """One vehicle as of `frame`; yaw and velocity are in the odometry world."""

    yaw_rad: float
    observation: Observation  # last observation
    place: Place  # its place in the ego of `frame`
    velocity_mps: NDArray[np.float64]  # (2,)
    kinematic_cov: NDArray[np.float64]  # (4, 4) of position and velocity by `user_filter`
    predicted_m: NDArray[np.float64]  # (2,) position at the newest frame by constant velocity
    last_edge: LastEdge | None = None  # None before the track has an id
    sigma_yaw_rad: float = 0.0  # of a yaw measured by motion or body
    is_yaw_known: bool = False
    front_logit: float = 0.0  # log odds that the yaw points to the front
    is_stationary: bool = False  # probably
    motion: MotionEdge | None = None  # VV edge from its last CV edge, as predicted before the update

    @property
    def label(self) -> str:
        return _most_voted(self.votes)

    def label_with(self, label: str) -> str:
        """The most frequent label, with one more vote."""
        return self.label if label == self.label else _most_voted(self.votes + Counter((label,)))

    def pose(self) -> SE2:
        """T_world_vehicle in the odometry's world, predicted to the newest frame."""
        return SE2(float(self.predicted_m[0]), float(self.predicted_m[1]), self.yaw_rad)


def _most_voted(votes: Counter[str]) -> str:
    return max(sorted(votes), key=votes.__getitem__)
