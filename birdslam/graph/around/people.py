"""People in the world of the graph: those that the front end follows, from the ego's newest pose.

They are filtered outside the joint graph (people/people_filter.py): sixty people more would not fit into a frame's
millisecond, and a person's box says nothing of the ego. What they get here is the graph's world, epoch and ego, with
the ego's covariance, and where frames bring no picture the way that they went on.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import chain

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.se2 import SE2
from birdslam.graph.around.approach import approaches
from birdslam.types import FollowedPerson, RoadUser

MOST = 60  # the nearest; a message and a frame's time have their limits
YAW_UNKNOWN = math.pi**2 / 3.0  # the variance of a direction of which nothing is known
CHANGE_MPS = 0.8  # 1-sigma by which a velocity changes within a second, as in `people_config.Sizes`
TURNS_MPS = 0.5  # who moves slower has no yaw
AS_COMPLEX = np.array([1.0, 1.0j])
FARTHEST_M, FASTEST_MPS = 1e4, 1e3  # somebody beyond is no person, but numbers that no front end made
_LIMITS = np.repeat([FARTHEST_M, FASTEST_MPS, FARTHEST_M**2, FASTEST_MPS**2], [2, 2, 4, 4])


def people_estimates(
    people: Sequence[FollowedPerson], since_s: float, world: SE2, ego_cov: Floats, ego_mps: complex, way: SE2
) -> tuple[RoadUser, ...]:
    """Everybody in world, `since_s` after they were seen in the ego's axes, over which the ego went on by `way`.

    `world` is T_world_ego when they were seen, `ego_cov` (3, 3) of its tangent; `ego_mps` is the ego's velocity.
    """
    if not people:
        return ()
    flat = chain.from_iterable((f.x_m, f.y_m, f.vx_mps, f.vy_mps, *f.cov, *f.velocity_cov) for f in people)
    table = np.fromiter(flat, np.float64, 12 * len(people)).reshape(-1, 12)
    sane = (np.abs(table) < _LIMITS).all(axis=1)
    if len(people) > MOST or not sane.all():
        away_m = np.hypot(table[:, 0], table[:, 1])
        nearest = sorted(np.flatnonzero(sane).tolist(), key=lambda k: (away_m[k], people[k].person))[:MOST]
        kept = sorted(nearest, key=lambda k: people[k].person)
        people, table = [people[k] for k in kept], table[kept]
    p, v = table[:, :2], table[:, 2:4]
    P, U = table[:, 4:8].reshape(-1, 2, 2), table[:, 8:].reshape(-1, 2, 2)
    if since_s > 0.0:
        p = p + v * since_s
        P = P + U * since_s**2 + np.eye(2) * (CHANGE_MPS**2 * since_s**3 / 3.0)
        U = U + np.eye(2) * (CHANGE_MPS**2 * since_s)
    both = np.array([P, U])
    means = 0.5 * (both[..., 0, 0] + both[..., 1, 1])
    deviators = 0.5 * (both[..., 0, 0] - both[..., 1, 1]) + 1j * both[..., 0, 1]
    near = approaches(p @ AS_COMPLEX - complex(way.x_m, way.y_m), v @ AS_COMPLEX - ego_mps, means, deviators)
    # The ego's error moves everybody: by its place, and by its yaw the more the farther they are
    J = np.zeros((len(p), 2, 3))
    J[:, 0, 0] = J[:, 1, 1] = 1.0
    J[:, 0, 2], J[:, 1, 2] = -p[:, 1], p[:, 0]
    P = P + J @ ego_cov @ J.transpose(0, 2, 1)
    across = np.stack([-v[:, 1], v[:, 0]], axis=1)
    U = U + max(float(ego_cov[2, 2]), 0.0) * across[:, :, None] * across[:, None, :]
    speed = np.hypot(v[:, 0], v[:, 1])
    heading = np.where(speed > TURNS_MPS, np.arctan2(v[:, 1], v[:, 0]), 0.0)  # against the ego
    c, s = np.cos(heading), np.sin(heading)
    R_ego_own = np.stack([c, -s, s, c], axis=1).reshape(-1, 2, 2)
    own = (R_ego_own.transpose(0, 2, 1) @ P @ R_ego_own).tolist()
    sideways = (across[:, None, :] @ U @ across[:, :, None])[:, 0, 0] / np.maximum(speed, TURNS_MPS) ** 4
    yaw_var = np.where(speed > TURNS_MPS, np.minimum(sideways, YAW_UNKNOWN), YAW_UNKNOWN).tolist()
    R = world.rotation()
    in_world, velocity = (world @ p).tolist(), (v @ R.T).tolist()
    velocity_cov = (R @ U @ R.T).tolist()
    later_ns = round(since_s * 1e9)
    yaws = np.arctan2(np.sin(heading + world.yaw_rad), np.cos(heading + world.yaw_rad)).tolist()
    return tuple(
        RoadUser(
            vehicle=f.person,
            T_world_vehicle=SE2(x, y, yaw_rad),
            cov=(xx, xy, 0.0, xy, yy, 0.0, 0.0, 0.0, yaw),
            velocity_mps=(vx, vy),
            velocity_cov=(uxx, uxy, uxy, uyy),
            age_ns=f.age_ns + later_ns,
            frames=f.frames,
            label=f.label,
            length_m=f.length_m,
            width_m=f.width_m,
            moves=f.moves,
            standing=f.standing,
            label_probability=f.label_probability,
            height_m=f.height_m,
            sigma_height_m=f.sigma_height_m,
            child=f.child,
            approach=approach,
        )
        for f, (x, y), (vx, vy), ((xx, xy), (_, yy)), ((uxx, uxy), (_, uyy)), yaw_rad, yaw, approach in zip(
            people, in_world, velocity, own, velocity_cov, yaws, yaw_var, near, strict=True
        )
    )
