"""Marginal covariances in world: of the vehicles, with their poses and velocities, out of the window's P.

The error of a vehicle's size is the same in all frames, which P does not know. As a bias that is considered and not
estimated (Schmidt 1966) it is added here: C + s^2 g g', g = (p, 0, v - v_ego), with s the edge's `depth_per_height`
times `sigma_log_height`, p the vehicle's place from the ego and v its velocity; docs/method.md has the reasons.
"""

from __future__ import annotations

import cmath
from collections.abc import Sequence

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.constant_twist import advance
from birdslam.geometry.se2 import SE2
from birdslam.graph.around.approach import approaches
from birdslam.graph.costs import Triple
from birdslam.graph.standing import judge, reported_velocity
from birdslam.graph.vehicles import VehicleNode
from birdslam.graph.window import Window
from birdslam.types import Approach, VehicleEstimate

# The Jacobian of a vehicle in world (place in its own axes, yaw, velocity) by (x, y, yaw) of the ego, of the vehicle in
# ego, and of its twist: where each entry stands in a row of what `marginals_in_world` calls numbers
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
    """Every vehicle at source time `t_ns`; one whose newest pose is older is driven on with the twist it had.

    `changes` (3,): the variances of a twist grow by so much a second. `ego_mps` is the ego's velocity in its own axes.
    `birth_det`: the determinant of a velocity's covariance at birth, to judge by whether a vehicle stands
    (standing.py); None: nobody judges.
    """
    if not vehicles:
        return ()
    ahead_s = [max((t_ns - v.node_ns) * 1e-9, 0.0) for v in vehicles]
    poses, velocities, covs = marginals_in_world(window, ahead_s, changes)
    covs += _of_sizes(window.world, ego_mps, vehicles, poses, velocities)
    motions: list[tuple[tuple[float, float], tuple[float, float, float, float]]] = []
    for v, velocity, cov in zip(vehicles, velocities, covs.tolist(), strict=True):
        velocity_cov = cov[3][3], cov[3][4], cov[4][3], cov[4][4]
        if birth_det is not None:
            judge(v, velocity, velocity_cov, birth_det, t_ns)
            velocity, velocity_cov = reported_velocity(v, velocity, velocity_cov)
        motions.append((velocity, velocity_cov))
    near = _approaches(window, ego_mps, vehicles, poses, motions)
    out = []
    for v, pose, (velocity, velocity_cov), cov, approach in zip(
        vehicles, poses, motions, covs.tolist(), near, strict=True
    ):
        reported = VehicleEstimate(
            vehicle=v.vehicle,
            T_world_vehicle=pose,
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
            height_m=v.height_m or None,
            sigma_height_m=v.sigma_height_m,
            approach=approach,
        )
        out.append(reported)
    return tuple(out)


def _approaches(
    window: Window,
    ego_mps: complex,
    vehicles: Sequence[VehicleNode],
    poses: Sequence[SE2],
    motions: Sequence[tuple[tuple[float, float], tuple[float, float, float, float]]],
) -> list[Approach]:
    """Of each vehicle to the ego, in the ego's axes: without the ego's error in world, which both have."""
    back, origin = cmath.rect(1.0, -window.world.yaw_rad), complex(window.world.x_m, window.world.y_m)
    numbers: list[complex] = []
    for pose, ((x, y), (xx, xy, _, yy)), node in zip(poses, motions, vehicles, strict=True):
        at = (complex(pose.x_m, pose.y_m) - origin) * back
        velocity = complex(x, y) * back - ego_mps
        turned = complex(0.5 * (xx - yy), xy) * back * back
        by_size = node.size_bias_rel * at
        numbers += (at, velocity, 0.5 * (xx + yy), turned, 0.5 * abs(by_size) ** 2, 0.5 * by_size * by_size)
    p, v, u_mean, u_deviator, size_mean, size_deviator = np.array(numbers).reshape(-1, 6).T
    xx, xy, yy = window.P.take(window.layout.places)
    means = np.array([0.5 * (xx + yy) + size_mean.real, u_mean.real])
    return approaches(p, v, means, np.array([0.5 * (xx - yy) + 1j * xy + size_deviator, u_deviator]))


def _of_sizes(
    world: SE2,
    ego_mps: complex,
    vehicles: Sequence[VehicleNode],
    poses: Sequence[SE2],
    velocities: Sequence[tuple[float, float]],
) -> Floats:
    """(M, 5, 5), as the covariances of `marginals_in_world`: what errors of the vehicles' sizes add; see the module."""
    ego, velocity_mps = complex(world.x_m, world.y_m), ego_mps * cmath.rect(1.0, world.yaw_rad)
    numbers: list[float] = []
    for v, pose, (x_mps, y_mps) in zip(vehicles, poses, velocities, strict=True):
        s = v.size_bias_rel
        away = s * (complex(pose.x_m, pose.y_m) - ego) * cmath.rect(1.0, -pose.yaw_rad)  # in the vehicle's axes
        numbers += (away.real, away.imag, 0.0, s * (x_mps - velocity_mps.real), s * (y_mps - velocity_mps.imag))
    g = np.array(numbers).reshape(-1, 5, 1)
    return g @ g.transpose(0, 2, 1)


def marginals_in_world(
    window: Window, ahead_s: Sequence[float], changes: Triple
) -> tuple[list[SE2], list[tuple[float, float]], Floats]:
    """Vehicles in world, driven on by `ahead_s` (M,) past their newest pose: poses, velocities in m/s, and the
    covariances (M, 5, 5) of both. `changes` (3,): twists' variances grow by so much a second.
    """
    ego, origin = cmath.rect(1.0, window.world.yaw_rad), complex(window.world.x_m, window.world.y_m)
    poses: list[SE2] = []
    velocities: list[tuple[float, float]] = []
    numbers: list[float] = []
    means = zip(
        window.at[window.nodes :], window.heading[window.nodes :], window.velocity, window.turn_radps, strict=True
    )
    for (at, heading, velocity, turn_radps), t in zip(means, ahead_s, strict=True):
        way = g = d = 0j
        if t:
            way, heading, g, d = advance(heading, velocity, turn_radps, t)
            at += way
        back = heading.conjugate()  # to the vehicle's own axes
        in_world, place = heading * ego, at * ego + origin
        poses.append(SE2(place.real, place.imag, cmath.phase(in_world)))
        velocity *= in_world
        velocities.append((velocity.real, velocity.imag))
        lever, turn, g, d = 1j * back * at, 1j * back * way, back * g, back * d
        # An error of the yaw turns the velocity, one of the twist adds to it
        x, y, c, s = -velocity.imag, velocity.real, in_world.real, in_world.imag
        numbers += (0.0, 1.0, back.real, -back.imag, back.imag, lever.real, lever.imag, turn.real, turn.imag)
        numbers += (g.real, -g.imag, g.imag, d.real, d.imag, t, c, -s, s, x, y, t * x, t * y)
    J = np.fromiter(numbers, np.float64, len(numbers)).reshape(len(poses), -1).take(_JACOBIAN, axis=1)
    C = window.P.take(window.layout.own)
    if any(ahead_s):
        C.reshape(-1, 81)[:, 60::10] += np.outer(ahead_s, changes)
    covs: Floats = J @ C @ J.transpose(0, 2, 1)
    variances = covs.reshape(-1, 25)[:, ::6]
    np.maximum(variances, 0.0, out=variances)  # where all is known, rounding has either sign
    return poses, velocities, covs
