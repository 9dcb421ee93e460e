"""The effect of an uncertain camera height or focal length: all lengths of an estimate share one factor."""

from __future__ import annotations

import math
from typing import TypeVar

import msgspec

from birdslam.geometry.se2 import SE2
from birdslam.types import Estimate, Lane, LaneLine, Lanes, RoadUser

Curve = TypeVar("Curve", LaneLine, Lane)


def with_camera_scale(estimate: Estimate, sigma_rel: float) -> Estimate:
    """Returns the estimate with covariances that include a common factor of 1 +- `sigma_rel` on all lengths.

    The factor is constant over a drive, so that no window averages it: it scales the world about its origin and changes
    a position p by sigma * p, a velocity v by sigma * v. Headings do not change.
    """
    if not sigma_rel:
        return estimate
    return msgspec.structs.replace(
        estimate,
        cov=_widened(estimate.cov, estimate.T_world_ego, sigma_rel),
        vehicles=tuple(_road_user(vehicle, sigma_rel) for vehicle in estimate.vehicles),
        people=tuple(_road_user(person, sigma_rel) for person in estimate.people),
        lanes=None if estimate.lanes is None else _lanes(estimate.lanes, sigma_rel),
        scale_sigma_rel=math.hypot(estimate.scale_sigma_rel, sigma_rel),
    )


def _road_user(vehicle: RoadUser, sigma_rel: float) -> RoadUser:
    u, v = (sigma_rel * along for along in vehicle.velocity_mps)
    uu, uv, vu, vv = vehicle.velocity_cov
    return msgspec.structs.replace(
        vehicle,
        cov=_widened(vehicle.cov, vehicle.T_world_vehicle, sigma_rel),
        velocity_cov=(uu + u * u, uv + u * v, vu + u * v, vv + v * v),
    )


def _lanes(lanes: Lanes, sigma_rel: float) -> Lanes:
    return msgspec.structs.replace(
        lanes,
        lines=tuple(_curve(line, sigma_rel) for line in lanes.lines),
        lanes=tuple(
            msgspec.structs.replace(
                _curve(lane, sigma_rel), width_sigma_m=math.hypot(lane.width_sigma_m, sigma_rel * lane.width_m)
            )
            for lane in lanes.lanes
        ),
        leader=lanes.leader
        and msgspec.structs.replace(
            lanes.leader, gap_sigma_m=math.hypot(lanes.leader.gap_sigma_m, sigma_rel * lanes.leader.gap_m)
        ),
    )


def _curve(curve: Curve, sigma_rel: float) -> Curve:
    """Slopes do not change, a curvature is divided by the factor and its rate by the square."""
    moved = (curve.offset_m, 0.0, -curve.curvature_per_m, -2.0 * curve.curvature_rate_per_m2)
    by_factor = (sigma_rel * sigma_rel * a * b for a in moved for b in moved)
    return msgspec.structs.replace(curve, cov=tuple(c + d for c, d in zip(curve.cov, by_factor, strict=True)))


def _widened(cov: tuple[float, ...], pose: SE2, sigma_rel: float) -> tuple[float, ...]:
    """Returns the covariance of a pose, row-major, in the axes of the body."""
    cos, sin = math.cos(pose.yaw_rad), math.sin(pose.yaw_rad)
    x_m = sigma_rel * (cos * pose.x_m + sin * pose.y_m)
    y_m = sigma_rel * (cos * pose.y_m - sin * pose.x_m)
    out = list(cov)
    out[0] += x_m * x_m
    out[1] += x_m * y_m
    out[3] += x_m * y_m
    out[4] += y_m * y_m
    return tuple(out)
