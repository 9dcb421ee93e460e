"""Marginal covariances in world: of the vehicles, with their poses and velocities, out of the window's P."""

from __future__ import annotations

import cmath
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.planar import advance, pairs
from birdslam.geometry.se2 import SE2
from birdslam.graph.standing import judge, told_velocity
from birdslam.graph.vehicles import VehicleNode
from birdslam.graph.window import Window
from birdslam.types import VehicleEstimate

Floats = NDArray[np.float64]

_AXES = np.arange(3)
# By (x, y, yaw) of the ego, of a vehicle that stands at it, and of the vehicle's twist: x + iy, the yaw, the velocity
_PLACE = np.array([1.0, 1j, 0.0, 1.0, 1j, 0.0, 0.0, 0.0, 0.0])
_YAW = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
_TWIST = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1j, 0.0])


def vehicle_estimates(
    window: Window, vehicles: Sequence[VehicleNode], t_ns: int, changes: Floats, birth_det: float | None = None
) -> tuple[VehicleEstimate, ...]:
    """Every vehicle at source time `t_ns`; one whose newest pose is older is driven on with the twist it had.

    `changes` (3,): the variances of a twist grow by so much a second. `birth_det`: the determinant of a velocity's
    covariance at birth, to judge by whether a vehicle stands (standing.py); None: nobody judges.
    """
    if not vehicles:
        return ()
    ahead_s = None
    if any(v.node_ns < t_ns for v in vehicles):
        ahead_s = np.array([max((t_ns - v.node_ns) * 1e-9, 0.0) for v in vehicles])
    poses, velocities, covs = marginals_in_world(window, ahead_s, changes)
    out = []
    for v, pose, (vx, vy), cov in zip(vehicles, poses.tolist(), velocities.tolist(), covs.tolist(), strict=True):
        velocity, velocity_cov = (vx, vy), (cov[3][3], cov[3][4], cov[4][3], cov[4][4])
        if birth_det is not None:
            judge(v, velocity, velocity_cov, birth_det, t_ns)
            velocity, velocity_cov = told_velocity(v, velocity, velocity_cov)
        told = VehicleEstimate(
            vehicle=v.vehicle,
            T_world_vehicle=SE2(*pose),
            cov=(*cov[0][:3], *cov[1][:3], *cov[2][:3]),
            velocity_mps=velocity,
            velocity_cov=velocity_cov,
            age_ns=max(t_ns - v.seen_ns, 0),
            frames=v.frames,
            label=v.label,
            length_m=v.length_m,
            width_m=v.width_m,
            delay_ns=v.delay_ns,
            moves=v.moves,
            standing=0.5 if v.standing is None else v.standing,
        )
        out.append(told)
    return tuple(out)


def marginals_in_world(window: Window, ahead_s: Floats | None, changes: Floats) -> tuple[Floats, Floats, Floats]:
    """Vehicles in world, driven on by `ahead_s` (M,), if any, past their newest pose: poses (M, 3), velocities
    (M, 2), and the covariances (M, 5, 5) of both. `changes` (3,): twists' variances grow by so much a second.
    """
    M = len(window.velocity)
    at, heading = window.at[window.nodes :], window.heading[window.nodes :]
    # How the errors of (ego in world, vehicle's pose, twist) move its place and yaw
    place, yaw = _PLACE, _YAW
    if ahead_s is not None:
        way, heading, partial = advance(heading, window.velocity, window.turn_radps, ahead_s)
        at = at + way
        place, yaw = np.tile(place, (M, 1)), np.tile(yaw, (M, 1))
        place[:, 3:], yaw[:, 8] = partial, ahead_s
    back = heading.conj()
    place = back[:, None] * place  # in the vehicle's own axes
    place[:, 2] = 1j * back * at
    ego = cmath.exp(1j * window.world.yaw_rad)
    at, heading = at * ego + complex(window.world.x_m, window.world.y_m), heading * ego
    velocity = heading * window.velocity
    # An error of the yaw turns the velocity, one of the twist adds to it
    turns = (1j * velocity)[:, None] * yaw + heading[:, None] * _TWIST
    J = np.empty((M, 5, 9))
    J[:, :2], J[:, 2], J[:, 3:] = pairs(place), yaw, pairs(turns)
    C = window.P[window.layout.own]
    if ahead_s is not None:
        C[:, _AXES + 6, _AXES + 6] += ahead_s[:, None] * changes
    covs: Floats = J @ C @ J.transpose(0, 2, 1)
    variances = covs.reshape(M, 25)[:, ::6]
    np.maximum(variances, 0.0, out=variances)  # where all is known, rounding has either sign
    poses = np.empty((M, 3))
    poses[:, 0], poses[:, 1] = at.real, at.imag
    np.arctan2(heading.imag, heading.real, out=poses[:, 2])
    return poses, velocity.view(np.float64).reshape(M, 2), covs
