"""Where odometry's frame lies in a map, as the map process says it: REP-105's odom and map frames.

Odometry's frame (`world` in an estimate) never jumps and drifts; the map's does not drift and may jump. `T_map_odom`
joins them, and the ego in the map is `T_map_odom @ T_world_ego`, with the newest estimate as well as with older ones.
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
    """What a pose in the map rests on."""

    LOCALISED = "localised"  # on the map: the pose is within its covariance
    ODOMETRY_ONLY = "odometry_only"  # on odometry since the last fix, or since the beginning of a new map
    LOST = "lost"  # there is no pose

    NEWER = LOST


class EarthPose(msgspec.Struct, frozen=True, kw_only=True):
    """The ego on Earth, WGS 84."""

    latitude_deg: float
    longitude_deg: float
    cov: Cov2  # of east and north, in m^2
    yaw_rad: float  # of the ego's x axis from east, counter-clockwise
    yaw_sigma_rad: float


class MapPose(msgspec.Struct, frozen=True, kw_only=True):
    """The map process -> planners: odometry's frame in the map (REP-105), by one frame.

    `frame_id`, the times and `epoch` are those of the estimate that it is of.
    """

    frame_id: int
    t_source_ns: int
    t_capture_ns: int
    t_utc_ns: int
    epoch: int  # of the estimates that T_map_odom takes into the map
    state: MapState
    map_epoch: int = 0  # rises where T_map_odom jumped: a place was recognised again, or a loop was closed
    T_map_odom: SE2 | None = None  # none where lost
    T_odom_ego: SE2 | None = None  # the estimate's T_world_ego, at which cov holds
    cov: Cov3 | None = None  # of T_map_odom @ T_odom_ego, of the tangent at that pose; none where lost
    inliers: int = 0  # points of the map that this frame's own fix rests on; 0: carried by odometry
    keyframes: int = 0  # that the map has
    earth: EarthPose | None = None  # none where the map is not on Earth


@dataclass(frozen=True, eq=False)
class InMap:
    """An estimate in the map."""

    state: MapState
    T_map_ego: SE2 | None  # none where lost
    cov: Floats  # (3, 3) of the tangent at the pose, with odometry's drift since `pose`; infinite where lost
    map_epoch: int
    pose: MapPose | None  # by which it was brought there; none: the map process never said one


STALE_NS = NS_PER_S  # an older pose may be followed by unknown motion

NOWHERE = InMap(MapState.LOST, None, np.full((3, 3), np.inf), 0, None)


def in_map(pose: MapPose | None, estimate: Estimate) -> InMap:
    """The ego of an estimate in the map, by the newest pose that is known; lost where that is of another epoch.

    Only `odometry_only` where the estimate is not valid, or over a second newer than the pose.
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
