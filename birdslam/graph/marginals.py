"""Marginal poses, velocities and covariances of the vehicles in world, from the covariance P of the window.

The error of a vehicle's size is common to all frames. It is a considered bias (Schmidt 1966) and is added here:
C + s^2 g g', g = (p, 0, v - v_ego), with s the edge's `depth_per_height` times `sigma_log_height`, p the vehicle's
position from the ego and v its velocity; docs/method.md has the derivation.
"""

from __future__ import annotations

import cmath
from collections.abc import Sequence

import numpy as np

from birdslam.geometry.arrays import Complexes, Floats
from birdslam.geometry.constant_twist import advance
from birdslam.geometry.se2 import SE2
from birdslam.graph.around.approach import approaches
from birdslam.graph.costs import Triple
from birdslam.graph.standing import judge, reported_velocities
from birdslam.graph.state_layout import EGO, TWIST
from birdslam.graph.vehicles import VehicleNode
from birdslam.graph.window import Window
from birdslam.types import Approach, VehicleEstimate

# Jacobian of a vehicle in world (position in its own axes, yaw, velocity) by (x, y, yaw) of the ego, of the vehicle in
# ego, and its twist: for each entry the row of `numbers` in `marginals_in_world`
_JACOBIAN = np.array(
    [
        [2, 3, 5, 2, 3, 7, 9, 10, 12],
        [4, 2, 6, 4, 2, 8, 11, 9, 13],
        [0, 0, 1, 0, 0, 1, 0, 0, 14],
        [0, 0, 18, 0, 0, 18, 15, 16, 20],
        [0, 0, 19, 0, 0, 19, 17, 15, 21],
    ]
)


def vehicle_estimates(
    window: Window,
    vehicles: Sequence[VehicleNode],
    t_ns: int,
    changes: Triple,
    ego_mps: complex = 0j,
    birth_det: float | None = None,
) -> tuple[VehicleEstimate, ...]:
    """Returns every vehicle at source time `t_ns`; older poses are predicted with their twist.

    `changes` (3,): growth of the variances of a twist per second. `ego_mps` is the ego's velocity in its own axes.
    `birth_det`: determinant of the velocity covariance of a new vehicle, for the decision stationary or moving
    (standing.py); None: no decision.
    """
    if not vehicles:
        return ()
    ahead_s = np.array([0.0 if v.is_fixed else max((t_ns - v.node_ns) * 1e-9, 0.0) for v in vehicles])
    sizes = np.array([v.size_bias_rel for v in vehicles])  # relative 1-sigma of each distance due to the size
    at, heading, velocities, covs = marginals_in_world(window, ahead_s, changes)
    covs += _of_sizes(window.world, ego_mps, sizes, at, heading, velocities)
    if birth_det is not None:
        judge(vehicles, velocities.view(np.float64).reshape(-1, 2), covs[:, 3:, 3:], birth_det, t_ns)
        velocities, covs[:, 3:, 3:] = reported_velocities(vehicles, velocities, covs[:, 3:, 3:])
    near = _approaches(window, ego_mps, sizes, at, velocities, covs[:, 3:, 3:])
    numbers = np.empty((len(vehicles), 18))  # a row for each record
    numbers[:, 0], numbers[:, 1], numbers[:, 2] = at.real, at.imag, np.arctan2(heading.imag, heading.real)
    numbers[:, 3], numbers[:, 4] = velocities.real, velocities.imag
    numbers[:, 5:9].reshape(-1, 2, 2)[...], numbers[:, 9:].reshape(-1, 3, 3)[...] = covs[:, 3:, 3:], covs[:, :3, :3]
    return tuple(
        VehicleEstimate(
            vehicle=v.vehicle,
            T_world_vehicle=SE2(x_m, y_m, yaw_rad),
            cov=(*cov,),
            velocity_mps=(x_mps, y_mps),
            velocity_cov=(xx, xy, yx, yy),
            age_ns=max(t_ns - v.seen_ns, 0),
            frames=v.frames,
            label=v.label,
            length_m=v.length_m,
            width_m=v.width_m,
            delay_ns=v.delay_ns,
            moves=v.moves,
            standing=0.5 if v.standing is None else v.standing,
            height_m=v.height_m or None,
            sigma_height_m=v.sigma_height_m,
            approach=approach,
        )
        for v, approach, (x_m, y_m, yaw_rad, x_mps, y_mps, xx, xy, yx, yy, *cov) in zip(
            vehicles, near, numbers.tolist(), strict=True
        )
    )


def _approaches(
    window: Window, ego_mps: complex, sizes: Floats, at: Complexes, velocities: Complexes, covs: Floats
) -> list[Approach]:
    """Returns the closest approach of each vehicle, computed in ego, where the ego's error in world cancels.

    `at` and `velocities` (M,) and the covariances (M, 2, 2) of the latter are in world; `sizes` (M,).
    """
    back, origin = cmath.rect(1.0, -window.world.yaw_rad), complex(window.world.x_m, window.world.y_m)
    p, v = (at - origin) * back, velocities * back - ego_mps
    both = np.empty((2, 2, 2, len(p)))
    both[:, :, 0], both[:, :, 1] = window.each_vehicle[:, :2, :2].transpose(1, 2, 0), covs.transpose(1, 2, 0)
    means, deviators = 0.5 * (both[0, 0] + both[1, 1]), 0.5 * (both[0, 0] - both[1, 1]) + 1j * both[0, 1]
    by_size = sizes * p
    square = 0.5 * by_size * by_size
    means[0] += np.abs(square)
    deviators[0] += square
    deviators[1] *= back * back
    return approaches(p, v, means, deviators)


def _of_sizes(
    world: SE2, ego_mps: complex, sizes: Floats, at: Complexes, heading: Complexes, velocities: Complexes
) -> Floats:
    """Returns the covariances (M, 5, 5) due to the errors of the vehicles' `sizes` (M,)."""
    ego, velocity_mps = complex(world.x_m, world.y_m), ego_mps * cmath.rect(1.0, world.yaw_rad)
    g = np.zeros((len(at), 5))
    away, closing = sizes * (at - ego) * heading.conj(), sizes * (velocities - velocity_mps)  # in the vehicle's axes
    g[:, 0], g[:, 1], g[:, 3], g[:, 4] = away.real, away.imag, closing.real, closing.imag
    return g[:, :, None] * g[:, None]


def marginals_in_world(
    window: Window, ahead_s: Floats, changes: Triple
) -> tuple[Complexes, Complexes, Complexes, Floats]:
    """Returns the vehicles in world, predicted by `ahead_s` (M,) past their newest pose.

    Positions, headings and velocities (M,) in m/s, and the covariances (M, 5, 5) of pose and velocity. `changes` (3,):
    growth of the variances of the twists per second.
    """
    ego, origin, n = cmath.rect(1.0, window.world.yaw_rad), complex(window.world.x_m, window.world.y_m), window.nodes
    at, heading, velocities = window.at[n:], window.heading[n:], window.velocity
    late = ahead_s.any()
    numbers = np.zeros((22, len(at)))  # the rows of _JACOBIAN
    if late:
        way, heading, g, d = advance(heading, velocities, window.turn_radps, ahead_s)
        at = at + way
        back = heading.conj()
        turn, g, d = 1j * back * way, back * g, back * d
        numbers[7:9] = turn.real, turn.imag
        numbers[9:15] = g.real, -g.imag, g.imag, d.real, d.imag, ahead_s
    back = heading.conj()  # to the vehicles' own axes
    in_world, lever = heading * ego, 1j * back * at
    velocities = velocities * in_world
    # A yaw error turns the velocity, a twist error adds to it
    x, y, c, s = -velocities.imag, velocities.real, in_world.real, in_world.imag
    numbers[1:7] = np.ones(len(at)), back.real, -back.imag, back.imag, lever.real, lever.imag
    numbers[15:20] = c, -s, s, x, y
    numbers[20:] = ahead_s * x, ahead_s * y
    J = numbers.T.take(_JACOBIAN, axis=1)
    C = np.empty((len(at), 9, 9))  # of the ego in world and of each vehicle
    own = slice(0, TWIST.stop)
    C[:, :3, :3], C[:, 3:, :3] = window.ego_cov, window.with_egos[:, own, EGO]
    C[:, 3:, 3:] = window.each_vehicle[:, own, own]
    C[:, :3, 3:] = C[:, 3:, :3].transpose(0, 2, 1)
    if late:
        C.reshape(-1, 81)[:, 60::10] += np.outer(ahead_s, changes)
    covs: Floats = J @ C @ J.transpose(0, 2, 1)
    variances = covs.reshape(-1, 25)[:, ::6]
    np.maximum(variances, 0.0, out=variances)  # rounding may make a zero variance negative
    return at * ego + origin, in_world, velocities, covs
