"""Poses in world of the ego and of bodies on a street."""

from __future__ import annotations

import math

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.world.rendering import materials as m
from birdslam.world.rendering.scene import Bodies
from birdslam.world.street.street import Street
from birdslam.world.traffic.flow import Mover
from birdslam.world.traffic.placement import Scenery


def ego_pose(street: Street, s_m: float, d_m: float, turn_rad: float) -> Floats:
    """`T_world_ego` (4, 4) on the road at (s, d), rotated by `turn_rad` from the street's heading in the road plane."""
    x, y, z, yaw, slope = (float(v) for v in street.place(np.array(s_m), np.array(d_m)))
    along = np.array([math.cos(yaw), math.sin(yaw), slope])
    along /= np.linalg.norm(along)
    across = np.array([-math.sin(yaw), math.cos(yaw), 0.0])
    forward = math.cos(turn_rad) * along + math.sin(turn_rad) * across
    up = np.cross(along, across)
    out = np.eye(4)
    out[:3, 0], out[:3, 1], out[:3, 2], out[:3, 3] = forward, np.cross(up, forward), up, (x, y, z)
    return out


def place(street: Street, standing: Scenery) -> Bodies:
    """The scenery as bodies in world."""
    s, d = np.array(standing.s_m), np.array(standing.d_m)
    x, y, z, yaw, _ = street.place(s, d)
    n = len(s)
    return Bodies(
        np.array(standing.kind, np.int32), np.array(standing.parameters, np.float32).reshape(n, m.SLOTS),
        np.stack([x, y, z], axis=1), yaw + np.array(standing.turn_rad), np.zeros(n), np.full(n, -1, np.int32),
    )  # fmt: skip


def moving(street: Street, movers: list[Mover]) -> Bodies:
    """The movers as bodies in world; the object_id is the index in the list."""
    s, d = np.array([v.s_m for v in movers]), np.array([v.d_m for v in movers])
    turn = np.array([v.turn_rad for v in movers])
    x, y, z, yaw, slope = street.place(s, d)
    n = len(movers)
    z = z + np.array([street.rise(v.s_m, v.d_m) for v in movers])
    return Bodies(
        np.array([v.body.kind for v in movers], np.int32),
        np.array([v.body.parameters for v in movers], np.float32).reshape(n, m.SLOTS),
        np.stack([x, y, z], axis=1).reshape(n, 3), yaw + turn, slope * np.cos(turn), np.arange(n, dtype=np.int32),
    )  # fmt: skip
