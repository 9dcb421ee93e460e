"""The tracked people in world, relative to the newest ego pose.

They are filtered outside the graph (road_users/models/), since their boxes carry no information about the ego.
This module transforms them to the world of the graph, adds the covariance of the ego, and predicts them over frames
without an image.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from itertools import chain

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.se2 import SE2
from birdslam.graph.around.approach import approaches
from birdslam.types import FollowedPerson, RoadUser

MAX_PEOPLE = 60  # the nearest ones; bounds the size of a message and the time of a frame
YAW_UNKNOWN = math.pi**2 / 3.0  # variance of a uniform direction
CHANGE_MPS = 0.8  # 1-sigma by which a velocity changes within a second, as in `people_config.Sizes`
TURNS_MPS = 0.5  # minimum speed for a yaw
MAX_DISTANCE_M, MAX_SPEED_MPS = 1e4, 1e3  # beyond them the record is corrupt
_LIMITS = np.repeat([MAX_DISTANCE_M, MAX_SPEED_MPS, MAX_DISTANCE_M**2, MAX_SPEED_MPS**2], [2, 2, 4, 4])


def people_estimates(
    people: Sequence[FollowedPerson], since_s: float, world: SE2, ego_cov: Floats, ego_mps: complex, way: SE2
) -> tuple[RoadUser, ...]:
    """Returns all people in world, `since_s` after they were seen in ego; `way` is the ego's motion since then.

    `world` is T_world_ego when they were seen, `ego_cov` (3, 3) of its tangent; `ego_mps` is the ego's velocity.
    """
    if not people:
        return ()
    parts = [part for f in people for part in ((f.x_m, f.y_m, f.vx_mps, f.vy_mps), f.cov, f.velocity_cov)]
    table = np.fromiter(chain.from_iterable(parts), np.float64, 12 * len(people)).reshape(-1, 12)
    sane = (np.abs(table) < _LIMITS).all(axis=1)
    if len(people) > MAX_PEOPLE or not sane.all():
        away_m = np.hypot(table[:, 0], table[:, 1])
        nearest = sorted(np.flatnonzero(sane).tolist(), key=lambda k: (away_m[k], people[k].person))[:MAX_PEOPLE]
        kept = sorted(nearest, key=lambda k: people[k].person)
        people, table = [people[k] for k in kept], table[kept]
    p, v = table.view(np.complex128)[:, :2].T
    (xx, yy), (xy,) = table[:, [4, 8, 7, 11]].T.reshape(2, 2, -1), table[:, [5, 9]].T[None]
    means, deviators = 0.5 * (xx + yy), 0.5 * (xx - yy) + 1j * xy  # of positions and velocities (2, N), as in costs.py
    if since_s > 0.0:
        p = p + v * since_s
        means[0] += means[1] * since_s**2 + CHANGE_MPS**2 * since_s**3 / 3.0
        deviators[0] += deviators[1] * since_s**2
        means[1] += CHANGE_MPS**2 * since_s
    near = approaches(p - complex(way.x_m, way.y_m), v - ego_mps, means, deviators)
    speed = np.abs(v)
    heading = np.where(speed > TURNS_MPS, v / np.maximum(speed, TURNS_MPS), 1.0)  # relative to the ego
    # The error of the ego adds to all: its position, and its yaw times the distance
    (exx, exy, ext), (_, eyy, eyt), (*_, ett) = ego_cov.tolist()
    yaw_var, with_yaw = max(ett, 0.0), complex(ext, eyt)
    lever, across = levers = 1j * np.array([p, v])
    means += 0.5 * yaw_var * (levers.real**2 + levers.imag**2)
    deviators += 0.5 * yaw_var * levers * levers
    means[0] += 0.5 * (exx + eyy) + (lever.conj() * with_yaw).real
    deviators[0] += complex(0.5 * (exx - eyy), exy) + lever * with_yaw
    along = deviators[0] * (heading * heading).conj()  # in their own axes
    sideways = means[1] * speed**2 + (deviators[1].conj() * across * across).real
    yaw_vars = np.where(speed > TURNS_MPS, sideways / np.maximum(speed, TURNS_MPS) ** 4, YAW_UNKNOWN)
    turn = cmath.rect(1.0, world.yaw_rad)
    at, velocity, turning = p * turn + complex(world.x_m, world.y_m), v * turn, deviators[1] * turn * turn
    columns = (
        at.real, at.imag, velocity.real, velocity.imag, np.angle(heading * turn), np.minimum(yaw_vars, YAW_UNKNOWN),
        means[0] + along.real, along.imag, means[0] - along.real,
        means[1] + turning.real, turning.imag, means[1] - turning.real,
    )  # fmt: skip
    later_ns = round(since_s * 1e9)
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
        for f, approach, (x, y, vx, vy, yaw_rad, yaw, xx, xy, yy, uxx, uxy, uyy) in zip(
            people, near, np.array(columns).T.tolist(), strict=True
        )
    )
