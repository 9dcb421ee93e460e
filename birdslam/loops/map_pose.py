"""The pose of odometry's frame in the map frame, published by the map process (REP-105).

Odometry's frame (`world` of an estimate) drifts but does not jump; the map frame does not drift but may jump. The ego
in the map is `T_map_odom @ T_world_ego`, for the newest estimate and older ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import msgspec
import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.se2 import SE2
from birdslam.loops.drift import is_exact, moved
from birdslam.types import NS_PER_S, Cov2, Cov3, Estimate, Word


class MapState(Word):
    """The state of the localisation in the map."""

    LOCALISED = "localised"  # localised in the map
    ODOMETRY_ONLY = "odometry_only"  # predicted by odometry since the last fix, or since the start of a new map
    LOST = "lost"  # no pose

    NEWER = LOST


class EarthPose(msgspec.Struct, frozen=True, kw_only=True):
    """The ego on Earth, WGS 84."""

    latitude_deg: float
    longitude_deg: float
    cov: Cov2  # of east and north, in m^2
    yaw_rad: float  # of the ego's x axis from east, counter-clockwise
    yaw_sigma_rad: float


class MapPose(msgspec.Struct, frozen=True, kw_only=True):
    """The map process -> planners: odometry's frame in the map frame (REP-105), for one frame.

    `frame_id`, the times and `epoch` are those of its estimate.
    """

    frame_id: int
    t_source_ns: int
    t_capture_ns: int
    t_utc_ns: int
    epoch: int  # of the estimates for which T_map_odom holds
    state: MapState
    map_epoch: int = 0  # increases when T_map_odom jumps, by a relocalisation or a loop closure
    T_map_odom: SE2 | None = None  # none when lost
    T_odom_ego: SE2 | None = None  # the estimate's T_world_ego, at which cov holds
    cov: Cov3 | None = None  # of T_map_odom @ T_odom_ego, of the tangent at that pose; none when lost
    inliers: int = 0  # map points of this frame's fix; 0: predicted by odometry
    keyframes: int = 0  # of the map
    earth: EarthPose | None = None  # none if the map is not georeferenced


@dataclass(frozen=True, eq=False)
class InMap:
    """An estimate in the map frame."""

    state: MapState
    T_map_ego: SE2 | None  # none when lost
    cov: Floats  # (3, 3) of the tangent at the pose, with odometry's drift since `pose`; infinite when lost
    map_epoch: int
    pose: MapPose | None  # its source; none: no pose was published


STALE_NS = NS_PER_S  # max. age of a pose

NOWHERE = InMap(MapState.LOST, None, np.full((3, 3), np.inf), 0, None)


def in_map(pose: MapPose | None, estimate: Estimate) -> InMap:
    """Converts an estimate to the map frame by the newest pose; lost if that is of another epoch.

    At most `odometry_only` if the estimate is invalid, or more than STALE_NS newer than the pose.
    """
    if pose is None:
        return NOWHERE
    if pose.epoch != estimate.epoch or pose.T_map_odom is None or pose.T_odom_ego is None or pose.cov is None:
        return InMap(MapState.LOST, None, np.full((3, 3), np.inf), pose.map_epoch, pose)
    step = pose.T_odom_ego.between(estimate.T_world_ego)
    cov = moved(np.array(pose.cov).reshape(3, 3), step, scale_rel=estimate.scale_sigma_rel)
    state = pose.state
    stale = estimate.t_source_ns - pose.t_source_ns > STALE_NS
    if state is MapState.LOCALISED and (stale or not estimate.valid or not is_exact(cov)):
        state = MapState.ODOMETRY_ONLY
    return InMap(state, pose.T_map_odom @ estimate.T_world_ego, cov, pose.map_epoch, pose)
