"""One followed vehicle as the tracker has it, the frame that it is seen from, and how vehicles are followed."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.se2 import SE2
from birdslam.types import MotionEdge
from birdslam.vehicles.placement.localisation import Observation, Place
from birdslam.vehicles.placement.uncertain_yaw import HeadingConfig
from birdslam.vehicles.state.parallax_config import ParallaxConfig


class TrackingConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """When boxes are the same vehicle, and how vehicles move."""

    min_iou: float = 0.15  # of a box with the one predicted from bird's-eye view
    min_iou_just_seen: float = 0.4  # of one seen within `just_seen_s` and not cut by the image's border: 1 of 1,000
    just_seen_s: float = 0.15  # boxes of a vehicle overlap less, nine of ten neighbours' do
    gate_sigma: float = 3.0  # Mahalanobis distance in bird's-eye view past which boxes are never the same vehicle
    birth_score: float = 0.5  # a detection must reach it to begin a track
    confirm_hits: int = 2  # a track gets its id when it has been seen so often; KITTI tracking chose between 2 and 3
    forget_unconfirmed_s: float = 0.25  # without a detection, of a track without an id
    forget_s: float = 1.0  # without a detection, of a track with an id
    sigma_accel_mps2: float = 3.0  # 1-sigma of a vehicle's acceleration
    sigma_birth_mps: float = 8.0  # 1-sigma of the velocity of a new track
    moving_mps: float = 2.0  # a slower vehicle, or one within moving_sigma of rest, has no yaw by motion
    moving_sigma: float = 3.0  # see moving_mps
    moving_of_ego: float = 0.3  # nor one below this fraction of the ego's speed: errors of the ground look like motion
    moved_along_rel: float = 0.15  # nor one that has come less far from where it was first seen, as fractions of its
    moved_across_rel: float = 0.05  # distance then: along the line of sight, and across it
    sigma_yaw_rate_radps: float = 0.5  # 1-sigma of a vehicle's turning
    direction_inflation: float = 3.0  # of the sigma of the motion's direction: its errors last for many frames
    body_yaw_inflation: float = 3.0  # of the sigma of a yaw that a network sees in the body: so do its errors
    sigma_yaw_unknown_rad: float = 0.2  # of a CV edge's yaw before motion or a network measures it
    sigma_yaw_moving_rad: float = 0.1  # at least, of a CV edge's yaw that is known
    parallax: ParallaxConfig = ParallaxConfig()
    heading: HeadingConfig = HeadingConfig()
    standing_probability: float = 0.5  # from it on, by parallax, a vehicle stands: motion does not correct its yaw
    sigma_standing_mps: float = 2.0  # 1-sigma of the zero-velocity update of one that stands: it may start
    late_sigma_m: float = 3.0  # a late detection whose place is less sure than that gives no edge in the present frame


def in_vehicle_axes(cov: NDArray[np.float64], yaw_rad: float) -> tuple[float, float, float]:
    """(xx, xy, yy) of a covariance (2, 2) in axes that are turned by `yaw_rad`, R' cov R, without arrays."""
    (xx, xy), (_, yy) = cov.tolist()
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return (
        c * c * xx + 2.0 * c * s * xy + s * s * yy,
        c * s * (yy - xx) + (c * c - s * s) * xy,
        s * s * xx - 2.0 * c * s * xy + c * c * yy,
    )


@dataclass(frozen=True)
class EgoFrame:
    """One frame and where the ego stands in it, in the odometry's world (dead reckoning since the start)."""

    frame_id: int
    t_source_ns: int
    T_world_ego: SE2
    step_cov: NDArray[np.float64] | None = None  # (3, 3) of the step to it, in its tangent; None without odometry


@dataclass(frozen=True)
class LastEdge:
    """Where a vehicle's last CV edge left it, in the odometry's world: its next VV edge starts there."""

    frame: int
    t_ns: int
    T_world_vehicle: SE2


class VehicleFilter(Protocol):
    """States of all followed vehicles: row k is of the tracker's k-th track, from its birth until it is forgotten.

    `Placing` appends a row to each such filter for a new vehicle; the tracker drops rows, of all of them at once.
    """

    def __len__(self) -> int: ...

    def keep_rows(self, rows: Sequence[int]) -> None: ...


@dataclass
class Track:
    """One vehicle; `state` is (x_m, y_m, vx_mps, vy_mps) of its centre in the odometry's world, `cov` (4, 4)."""

    state: NDArray[np.float64]
    cov: NDArray[np.float64]
    yaw_rad: float
    observation: Observation  # the last one
    place: Place  # and where it put the vehicle, in the ego of `frame`
    first_m: NDArray[np.float64]  # (2,) where it was first seen, in the odometry's world
    first_offset_m: NDArray[np.float64]  # (2,) from the ego to there, along the world's axes
    frame: EgoFrame  # in which it was last seen
    last_edge: LastEdge | None = None  # None until it has an id
    vehicle: int = -1  # the persistent id, once confirmed
    hits: int = 1
    missed: int = 0  # times that the detector looked since and did not see it
    votes: Counter[str] = field(default_factory=Counter)
    sigma_yaw_rad: float = 0.0  # of a yaw that motion or the body has measured
    yaw_known: bool = False
    front_logit: float = 0.0  # log odds that the yaw points to the front, not to the rear
    stands: bool = False  # probably, by parallax
    motion: MotionEdge | None = None  # VV: from its last CV edge to now, as predicted before it was seen again

    @property
    def label(self) -> str:
        return _most_voted(self.votes)

    def label_with(self, label: str) -> str:
        """What it is called most often, with one more vote."""
        return self.label if label == self.label else _most_voted(self.votes + Counter((label,)))

    def pose(self) -> SE2:
        """T_world_vehicle in the odometry's world."""
        return SE2(float(self.state[0]), float(self.state[1]), self.yaw_rad)


def _most_voted(votes: Counter[str]) -> str:
    return max(sorted(votes), key=votes.__getitem__)
