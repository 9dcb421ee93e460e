"""Ground-truth camera poses at the frames, from nav_msgs/Odometry or sensor_msgs/NavSatFix of a bag.

A GNSS fix has no heading; it is taken from the course. For such a truth compare positions after alignment in SE(3)
(`ate_se3_m`), not headings.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import GroundPlane
from birdslam.ros.frames import StaticFrames
from birdslam.trajectory import Transform, inverse, mount_pose

MIN_COURSE_M = 5.0  # distance between two fixes for the course, since GNSS errors are about 1 m
WGS84_A_M, WGS84_E2 = 6378137.0, 6.69437999014e-3  # semi-major axis, first eccentricity squared


def truth_rows(
    times_ns: list[int], truth: list[tuple[int, Any]], frames: StaticFrames, camera_frame: str, mount: GroundPlane
) -> Floats:
    """(N, 3, 4) poses of the camera relative to its first, in camera axes, interpolated at the frames; nan outside.

    `truth`: times and messages. Without a transform in /tf_static between their frame and the camera, they are taken
    as poses of the camera's foot on the road. Raises ValueError for an unusable trajectory.
    """
    fixes = hasattr(truth[0][1], "latitude") if truth else False
    usable = [(t_ns, m) for t_ns, m in truth if not fixes or (m.status.status >= 0 and np.isfinite(m.latitude))]
    t_ns, order = np.unique([t for t, _ in usable], return_index=True)
    if len(t_ns) < 2:
        raise ValueError(f"has {len(t_ns)} poses at different times, needs 2")
    messages = [usable[i][1] for i in order]
    frame = messages[0].header.frame_id if fixes else messages[0].child_frame_id
    T_world_body = _from_fixes(messages) if fixes else _from_odometry(messages)
    T_body_cam = frames.find(frame, camera_frame) if frame else None
    T_body_cam = mount_pose(mount) if T_body_cam is None else T_body_cam
    if fixes:  # the antenna's orientation is unknown: assumed level and along the car
        T_body_cam[:3, :3] = mount.R_ego_cam
    T_world_cam = T_world_body @ T_body_cam
    t_s, at_s = (t_ns - t_ns[0]) / 1e9, (np.array(times_ns) - t_ns[0]) / 1e9
    inside = (at_s >= 0.0) & (at_s <= t_s[-1])
    if not inside.any():
        raise ValueError(f"its times {t_ns[0] / 1e9:.3f} to {t_ns[-1] / 1e9:.3f} s are outside the images'")
    out = np.full((len(times_ns), 4, 4), np.nan)
    out[inside] = np.eye(4)
    out[inside, :3, :3] = Slerp(t_s, Rotation.from_matrix(T_world_cam[:, :3, :3]))(at_s[inside]).as_matrix()
    for axis in range(3):
        out[inside, axis, 3] = np.interp(at_s[inside], t_s, T_world_cam[:, axis, 3])
    rows: Floats = (inverse(out[inside][0]) @ out)[:, :3]
    return rows


def _from_odometry(messages: list[Any]) -> Transform:
    out = np.tile(np.eye(4), (len(messages), 1, 1))
    poses = [message.pose.pose for message in messages]
    quaternions = np.array([(p.orientation.x, p.orientation.y, p.orientation.z, p.orientation.w) for p in poses])
    places = np.array([(p.position.x, p.position.y, p.position.z) for p in poses])
    wrong = ~(np.isfinite(places).all(axis=1) & (np.abs(np.linalg.norm(quaternions, axis=1) - 1.0) < 1e-3))
    if wrong.any():
        raise ValueError(
            f"pose {np.flatnonzero(wrong)[0]} is invalid: position not finite or quaternion not of unit length"
        )
    out[:, :3, :3] = Rotation.from_quat(quaternions).as_matrix()
    out[:, :3, 3] = places
    return out


def _from_fixes(messages: list[Any]) -> Transform:
    places = east_north_up(
        [(m.latitude, m.longitude, m.altitude if np.isfinite(m.altitude) else 0.0) for m in messages]
    )
    distance_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places[:, :2], axis=0), axis=1))])
    if distance_m[-1] < MIN_COURSE_M:
        raise ValueError(f"is {distance_m[-1]:.1f} m long; the course needs {MIN_COURSE_M:g} m")
    last = len(distance_m) - 1
    behind = (
        np.searchsorted(
            distance_m, np.clip(distance_m - 0.5 * MIN_COURSE_M, 0.0, distance_m[-1] - MIN_COURSE_M), side="right"
        )
        - 1
    )
    ahead = np.minimum(np.searchsorted(distance_m, distance_m[behind] + MIN_COURSE_M), last)
    course = places[ahead] - places[behind]
    out = np.tile(np.eye(4), (len(messages), 1, 1))
    out[:, :3, :3] = Rotation.from_euler("z", np.arctan2(course[:, 1], course[:, 0])[:, None]).as_matrix()
    out[:, :3, 3] = places
    return out


def east_north_up(fixes: list[tuple[float, float, float]]) -> Floats:
    """(N, 3) m east, north, up of the first fix; `fixes`: latitude and longitude in degrees, height in m (WGS 84)."""
    lat, lon, height = np.array(fixes).T
    lat, lon = np.radians(lat), np.radians(lon)
    normal = WGS84_A_M / np.sqrt(1.0 - WGS84_E2 * np.sin(lat) ** 2)
    ecef = np.stack(
        [
            (normal + height) * np.cos(lat) * np.cos(lon),
            (normal + height) * np.cos(lat) * np.sin(lon),
            (normal * (1.0 - WGS84_E2) + height) * np.sin(lat),
        ],
        axis=-1,
    )
    sin_lat, cos_lat, sin_lon, cos_lon = np.sin(lat[0]), np.cos(lat[0]), np.sin(lon[0]), np.cos(lon[0])
    R_enu_ecef = np.array(
        [
            [-sin_lon, cos_lon, 0.0],
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
        ]
    )
    out: Floats = (ecef - ecef[0]) @ R_enu_ecef.T
    return out
