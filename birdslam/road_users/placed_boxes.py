"""Metric places of the boxes of another detector, one per box in their order."""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.se2 import SE2
from birdslam.road_users.track import VehicleTrack
from birdslam.types import Cov2, Estimate, VehicleEstimate


class PlacedBox(msgspec.Struct, frozen=True, kw_only=True):
    """The vehicle of a box in ego (m, x forward, y left), its velocity over the ground, and their covariances.

    For a reported vehicle it is the pose graph's estimate (`VehicleEstimate`). Otherwise it is the place in this frame
    alone, without track and velocity.
    """

    x_m: float  # centre of the footprint
    y_m: float
    cov: Cov2  # of x and y, row-major
    yaw_rad: float  # heading relative to the ego
    track: int | None = None  # track id; another tracker's own if it gave one
    velocity_mps: tuple[float, float] | None = None  # in ego axes; (0, 0) if stationary
    velocity_cov: Cov2 | None = None
    label: str = "car"

    @property
    def distance_m(self) -> float:
        """From the ego to its centre."""
        return math.hypot(self.x_m, self.y_m)

    @property
    def distance_sigma_m(self) -> float:
        """1-sigma of `distance_m`."""
        direction = np.array([self.x_m, self.y_m]) / max(self.distance_m, 1e-9)
        return math.sqrt(max(0.0, direction @ np.reshape(self.cov, (2, 2)) @ direction))

    @property
    def speed_mps(self) -> float | None:
        """Over the ground; None if the velocity is unknown."""
        return None if self.velocity_mps is None else math.hypot(*self.velocity_mps)

    @property
    def speed_sigma_mps(self) -> float | None:
        """1-sigma of `speed_mps` along the velocity; for a stationary vehicle along the less certain axis."""
        if self.velocity_mps is None or self.velocity_cov is None:
            return None
        cov, speed_mps = np.reshape(self.velocity_cov, (2, 2)), math.hypot(*self.velocity_mps)
        if speed_mps == 0.0:
            return math.sqrt(max(0.0, float(np.linalg.eigvalsh(cov)[-1])))
        direction = np.asarray(self.velocity_mps) / speed_mps
        return math.sqrt(max(0.0, direction @ cov @ direction))


def place_boxes(
    count: int,
    frame_id: int,
    tracks: Sequence[VehicleTrack],
    people: Sequence[tuple[int, Sequence[int]]],
    estimate: Estimate,
) -> tuple[PlacedBox | None, ...]:
    """Returns a place for each of `count` boxes of one frame; None for a box without a road user.

    `people` has the id of each person seen in it, with the rows of the boxes: a rider has two.
    """
    reported = {user.vehicle: user for user in estimate.road_users}
    placed: list[PlacedBox | None] = [None] * count
    for track in tracks:
        if track.frame.frame_id == frame_id:
            vehicle = reported.get(track.number)
            placed[track.observation.row] = (
                _place_from_track(track) if vehicle is None else _place_from_estimate(vehicle, estimate.T_world_ego)
            )
    for person, rows in people:
        if person in reported:
            for row in rows:
                placed[row] = _place_from_estimate(reported[person], estimate.T_world_ego)
    return tuple(placed)


def _place_from_track(track: VehicleTrack) -> PlacedBox:
    x_m, y_m = track.place.centre_m.tolist()
    yaw_rad = SE2(0.0, 0.0, track.frame.T_world_ego.yaw_rad).between(SE2(0.0, 0.0, track.yaw_rad)).yaw_rad
    return PlacedBox(x_m=x_m, y_m=y_m, cov=_row_major(track.place.cov), yaw_rad=yaw_rad, label=track.label)


def _place_from_estimate(vehicle: VehicleEstimate, T_world_ego: SE2) -> PlacedBox:
    T_ego_vehicle = T_world_ego.between(vehicle.T_world_vehicle)
    to_ego, R_world_ego = (
        T_ego_vehicle.rotation(),
        T_world_ego.rotation(),
    )  # the covariance of a pose is in its own axes
    cov = to_ego @ np.reshape(vehicle.cov, (3, 3))[:2, :2] @ to_ego.T
    velocity = R_world_ego.T @ np.asarray(vehicle.velocity_mps)
    velocity_cov = R_world_ego.T @ np.reshape(vehicle.velocity_cov, (2, 2)) @ R_world_ego
    return PlacedBox(
        x_m=T_ego_vehicle.x_m,
        y_m=T_ego_vehicle.y_m,
        cov=_row_major(cov),
        yaw_rad=T_ego_vehicle.yaw_rad,
        track=vehicle.vehicle,
        velocity_mps=(float(velocity[0]), float(velocity[1])),
        velocity_cov=_row_major(velocity_cov),
        label=vehicle.label,
    )


def _row_major(cov: NDArray[np.float64]) -> tuple[float, ...]:
    return tuple(cov.ravel().tolist())
