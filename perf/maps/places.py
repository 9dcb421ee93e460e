"""Streets of corners with descriptors: what a map of places sees of a world, without images, with exact truth.

Facades stand along a route. A corner is a point with 256 bits, of which a share differs each time that it is seen, as
it does in images; in another light a larger one. In look-alike streets the same house stands again and again.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.loops.features import DESCRIPTOR_BYTES, Features
from birdslam.loops.foot import body_pose
from birdslam.trajectory import inverse, mount_pose
from birdslam.types import NS_PER_S, Attitude, Estimate

CAMERA = Camera(width_px=1242, height_px=375, fx_px=720.0, fy_px=720.0, cx_px=621.0, cy_px=180.0, height_m=1.65)
CORNERS_PER_M = 4.0
SIGHT_M = 60.0
MAX_SEEN = 220
NOISE_PX = 0.5
SAME_BITS, OTHER_LIGHT_BITS = 0.06, 0.14  # of a descriptor, that differ when a corner is seen again
SCALE_DRIFT, YAW_DRIFT_RAD = 0.01, 0.0008  # of the simulated odometry, by the root of a metre; scale: of a whole drive


@dataclass(frozen=True, eq=False)
class Street:
    """A route (N, 3) of x, y, yaw a metre apart, and the corners beside it."""

    route: Floats
    corners_m: Floats  # (M, 3)
    descriptors: NDArray[np.uint8]  # (M, 32)
    max_seen: int = MAX_SEEN  # corners of an image

    def see(
        self, T_world_ego: SE2, chance: np.random.Generator, bits: float = SAME_BITS, pitch_rad: float = 0.0
    ) -> Features:
        """The corners in the camera's image, each a little wrong."""
        body = body_pose(T_world_ego, Attitude(pitch_rad=pitch_rad), CAMERA.height_m)
        T = inverse(body @ mount_pose(CAMERA.ground))
        near = np.flatnonzero(np.hypot(*(self.corners_m[:, :2] - (T_world_ego.x_m, T_world_ego.y_m)).T) < SIGHT_M)
        p = self.corners_m[near] @ T[:3, :3].T + T[:3, 3]
        ahead = p[:, 2] > 2.0
        near, p = near[ahead], p[ahead]
        px = CAMERA.to_px(p[:, :2] / p[:, 2:])
        inside = ((px > 0.0) & (px < (CAMERA.width_px, CAMERA.height_px))).all(axis=1)
        near, px = near[inside], px[inside]
        seen = np.sort(chance.permutation(len(near))[: self.max_seen])
        near, px = near[seen], px[seen] + NOISE_PX * chance.standard_normal((len(seen), 2))
        flips = np.packbits(chance.random((len(near), 8 * DESCRIPTOR_BYTES)) < bits, axis=1)
        return Features(px, np.full(len(px), NOISE_PX), self.descriptors[near] ^ flips)


def block(side_m: float) -> Floats:
    """A route once around a square with round corners of 12 m radius, a metre apart."""
    straight, arc = side_m - 24.0, 12.0 * math.pi / 2.0
    steps = []
    for _ in range(4):
        steps += [0.0] * round(straight) + [math.pi / 2.0 / round(arc)] * round(arc)
    return along(steps)


def along(turns_rad: list[float]) -> Floats:
    """A route of steps of a metre, each with its turn."""
    T, rows = SE2(), []
    for turn_rad in turns_rad:
        rows.append((T.x_m, T.y_m, T.yaw_rad))
        T = T @ SE2.exp(np.array([1.0, 0.0, turn_rad]))
    return np.array(rows)


def build(route: Floats, seed: int, house_m: float = 0.0) -> Street:
    """Facades along a route; `house_m` > 0: the same house again every so many metres."""
    chance = np.random.default_rng(seed)
    per_m = round(CORNERS_PER_M)
    unit = round(house_m) if house_m else len(route)
    side = chance.choice([-1.0, 1.0], (unit, per_m)) * chance.uniform(5.0, 11.0, (unit, per_m))
    height = chance.uniform(0.2, 7.0, (unit, per_m))
    forward = chance.uniform(0.0, 1.0, (unit, per_m))
    bits = chance.integers(0, 256, (unit, per_m, DESCRIPTOR_BYTES), dtype=np.uint8)
    rows = np.arange(len(route)) % unit
    c, s = np.cos(route[:, 2])[:, None], np.sin(route[:, 2])[:, None]
    x = route[:, 0][:, None] + c * forward[rows] - s * side[rows]
    y = route[:, 1][:, None] + s * forward[rows] + c * side[rows]
    corners = np.stack([x, y, height[rows]], axis=2).reshape(-1, 3)
    return Street(route, corners, bits[rows].reshape(-1, DESCRIPTOR_BYTES))


def drive(
    street: Street,
    rows: range,
    seed: int,
    lateral_m: float = 0.0,
    bits: float = SAME_BITS,
    first_frame: int = 0,
    nod_rad: float = 0.0,
) -> Iterator[tuple[Estimate, Features, SE2]]:
    """A drive along rows of the route, `lateral_m` left of it: odometry's estimate, what is seen, and the truth.

    The car nods by `nod_rad` (1-sigma), of which odometry's attitude says nothing.
    """
    chance, nods = np.random.default_rng(seed), np.random.default_rng([seed, 1])
    scale = 1.0 + SCALE_DRIFT * float(chance.standard_normal())
    T_odom, T_last = SE2(), None
    for number, row in enumerate(rows):
        x_m, y_m, yaw_rad = street.route[row % len(street.route)]
        T_world_ego = SE2(float(x_m), float(y_m), float(yaw_rad)) @ SE2(0.0, lateral_m, 0.0)
        if T_last is not None:
            step = T_last.between(T_world_ego)
            noise = chance.standard_normal(3) * (0.01, 0.003, YAW_DRIFT_RAD)
            T_odom = T_odom @ SE2(scale * step.x_m, scale * step.y_m, step.yaw_rad) @ SE2.exp(noise)
        T_last, frame_id = T_world_ego, first_frame + number
        t_ns = frame_id * NS_PER_S // 10
        estimate = Estimate(
            epoch=0,
            frame_id=frame_id,
            t_source_ns=t_ns,
            t_capture_ns=t_ns,
            t_utc_ns=0,
            T_world_ego=T_odom,
            cov=(0.0,) * 9,
            valid=True,
        )
        yield estimate, street.see(T_world_ego, chance, bits, nod_rad * nods.standard_normal()), T_world_ego
