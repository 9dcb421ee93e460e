"""Ground truth of a rendered scene: objects, lanes and roads, in ego and in the image."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.world.rendering import materials as m
from birdslam.world.rendering.scene import Bodies, Rendered
from birdslam.world.street.street import CROSSING, LINE_KINDS, Street
from birdslam.world.traffic.flow import Mover
from birdslam.world.truth import WorldFrame, WorldLane, WorldObject

LANE_AHEAD_M, LANE_BEHIND_M, LANE_STEP_M = 80.0, 12.0, 1.0
_SIDE_ROAD_M = 60.0


def frame_of(
    image: NDArray[np.uint8], rendered: Rendered, scene: Bodies, movers: list[Mover], street: Street, camera: Camera,
    T_world_ego: Floats, s_m: float, frame_id: int, t_source_ns: int,
) -> WorldFrame:  # fmt: skip
    """The ground truth of a rendered frame."""
    R_ego_cam = camera.ground.R_ego_cam
    T_ego_cam = np.eye(4)
    T_ego_cam[:3, :3], T_ego_cam[:3, 3] = R_ego_cam, (0.0, 0.0, camera.height_m)
    R_ego_world = T_world_ego[:3, :3].T
    pixels = np.bincount(rendered.instances.ravel(), minlength=len(movers) + 1)
    limits = np.array([camera.width_px - 1.0, camera.height_px - 1.0] * 2)
    objects = []
    for row, index in enumerate(rendered.moving):
        box = rendered.boxes_px[row]
        if np.isnan(box[0]):
            continue
        clipped = np.clip(box, 0.0, limits)
        area, inside = _area(box), _area(clipped)
        if inside <= 0.0:
            continue
        object_id = int(scene.object_id[index])
        mover = movers[object_id]
        base = R_ego_world @ (scene.position_m[index] - T_world_ego[:3, 3])
        yaw = scene.yaw_rad[index]
        forward = R_ego_world @ np.array([math.cos(yaw), math.sin(yaw), scene.slope[index]])
        T = SE2(float(base[0]), float(base[1]), math.atan2(float(forward[1]), float(forward[0])))
        P = scene.parameters[index]
        objects.append(
            WorldObject(
                object_id, mover.body.label, float(P[m.LENGTH]), float(P[m.WIDTH]), float(P[m.HEIGHT]), T,
                R_ego_cam.T @ (base - np.array([0.0, 0.0, camera.height_m])), T.yaw_rad, clipped, box,
                float(rendered.visible[row]), 1.0 - inside / area, int(pixels[object_id + 1]),
                _velocity(mover, float(yaw)),
            )
        )  # fmt: skip
    return WorldFrame(
        image, rendered.depth_m, rendered.classes, rendered.instances, tuple(objects),
        lanes_of(street, T_world_ego, s_m), roads_of(street, T_world_ego, s_m), camera,
        T_world_ego @ T_ego_cam, frame_id, t_source_ns,
    )  # fmt: skip


def _velocity(mover: Mover, yaw_rad: float) -> Floats:
    """Velocity over the ground, in world."""
    street_rad = yaw_rad - mover.turn_rad
    along, across = mover.velocity
    c, s = math.cos(street_rad), math.sin(street_rad)
    return np.array([c * along - s * across, s * along + c * across])


def _area(box: Floats) -> float:
    return float(max(box[2] - box[0], 0.0) * max(box[3] - box[1], 0.0))


def _to_ego(street: Street, T_world_ego: Floats, s: Floats, d: Floats) -> Floats:
    x, y, z, _, _ = street.place(s, d)
    points = np.stack([x, y, z], axis=1) - T_world_ego[:3, 3]
    out: Floats = (points @ T_world_ego[:3, :3])[:, :2]
    return out


def lanes_of(street: Street, T_world_ego: Floats, s_m: float) -> tuple[WorldLane, ...]:
    """All lines and edges along the street, interrupted at crossings."""
    s = np.arange(max(s_m - LANE_BEHIND_M, 0.0), min(s_m + LANE_AHEAD_M, street.length_m), LANE_STEP_M)
    lanes = []
    for line in street.lines:
        whole = np.ones(len(s), bool)
        for crossing in street.crossings:
            side = CROSSING.index("left" if line[0] > street.left_m - 0.4 else "right")
            edge = line[0] > street.left_m - 0.4 or line[0] < street.right_m + 0.4
            if not edge or crossing[side] > 0.5:
                reach = crossing[1] + (crossing[4] if int(line[1]) == 5 else 1.0)
                whole &= np.abs(s - crossing[0]) >= reach
        breaks = np.flatnonzero(np.diff(whole.astype(int)) != 0) + 1
        for part in np.split(np.arange(len(s)), breaks):
            if len(part) >= 2 and whole[part[0]]:
                points = _to_ego(street, T_world_ego, s[part], np.full(len(part), line[0], np.float64))
                lanes.append(WorldLane(int(line[8]), LINE_KINDS[int(line[1])], points))
    return tuple(lanes)


def roads_of(street: Street, T_world_ego: Floats, s_m: float) -> tuple[Floats, ...]:
    """Polygons of the main road and of each side road."""
    s = np.arange(max(s_m - LANE_BEHIND_M, 0.0), min(s_m + LANE_AHEAD_M, street.length_m), LANE_STEP_M)
    left = _to_ego(street, T_world_ego, s, np.full(len(s), street.left_m))
    right = _to_ego(street, T_world_ego, s, np.full(len(s), street.right_m))
    out = [np.concatenate([left, right[::-1]])]
    for row in street.crossings.astype(np.float64):
        if not s[0] - 10.0 < row[0] < s[-1] + 10.0:
            continue
        for flag, edge, sign in ((row[2], street.left_m, 1.0), (row[3], street.right_m, -1.0)):
            if flag > 0.5:
                beyond = np.concatenate([np.linspace(0.0, row[4], 8), [_SIDE_ROAD_M]])
                reach = (
                    row[1]
                    + row[4]
                    - np.sqrt(np.maximum(row[4] ** 2 - np.square(np.maximum(row[4] - beyond, 0.0)), 0.0))
                )
                d = np.concatenate([edge + sign * beyond, (edge + sign * beyond)[::-1]])
                at = np.concatenate([row[0] + reach, row[0] - reach[::-1]])
                out.append(_to_ego(street, T_world_ego, at, d))
    return tuple(out)
