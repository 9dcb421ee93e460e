"""Single-view metrology: pixels of the road to metres in bird's-eye view, and back (paper, Eq. 1).

Eq. 1 uses a normal n and a height H in camera axes. The points here are in the ego frame (x forward, y left), whose
origin is the camera's foot on the road.
"""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import PLANE_AT_M, Camera, GroundPlane

Numbers = TypeVar("Numbers", float, Floats)

MAX_RANGE_M = 200.0  # beyond this a pixel row covers tens of metres
_MIN_SLOPE = 1e-4  # of a ray that intersects the road


def meet_road(rays: Floats, fall: Floats, height_m: float) -> Floats:
    """Eq. 1: intersects rays from a camera `height_m` above the road with it; metres, in the axes of the rays.

    `fall` is the component of a ray towards the road, -n . ray for the road's unit normal n. Takes rays (N, 3) with
    `fall` (N, 1), or one component of each ray (N,) with `fall` (N,).
    """
    out: Floats = height_m * rays / fall  # Eq. 1
    return out


def road_slope(depth_m: Numbers, height_m: Numbers | float) -> Numbers:
    """Slope of the ray to the road `depth_m` ahead (Eq. 1); the arguments broadcast."""
    return height_m / depth_m


def meet_bend(slope: Floats, height_m: float, vertical_per_m: float) -> Floats:
    """(N,) distance ahead at which rays of `slope` (N,) intersect a road that rises by `vertical_per_m` x^2 / 2.

    Slopes are against the tangent plane of the road under the camera; solves
    vertical_per_m x^2 / 2 + slope x = height_m. A ray that passes over a crest gets the distance of the tangent ray.
    """
    if vertical_per_m:
        slope = 0.5 * (slope + np.sqrt(np.maximum(slope * slope + 2.0 * vertical_per_m * height_m, 0.0)))
    return meet_road(np.ones_like(slope), np.maximum(slope, _MIN_SLOPE), height_m)


def tilted(
    x_m: Floats, y_m: Floats, height_m: float, by_rad: Floats | float, vertical_per_m: float = 0.0
) -> tuple[Floats, Floats]:
    """Road points (x, y) corrected for a camera that is pitched down by a further `by_rad` (Eq. 1).

    The road rises by `vertical_per_m` x^2 / 2 over the plane under the camera.
    """
    x = meet_bend(road_slope(x_m, height_m) + by_rad, height_m, vertical_per_m)
    return x, y_m * x / x_m


class RoadProfile(NamedTuple):
    """The road ahead: height of the camera over the plane under it (m), and vertical curvature (1/m)."""

    height_m: float
    vertical_per_m: float = 0.0

    def slope(self, depth_m: Numbers, lower_m: Numbers | float = 0.0) -> Numbers:
        """Slope of the ray to a point `lower_m` under the road, `depth_m` ahead, against the plane."""
        return road_slope(depth_m, self.height_m + lower_m) - rise(depth_m, self.vertical_per_m)


def rise(depth_m: Numbers, vertical_per_m: float) -> Numbers:
    """Angle (rad) by which vertical curvature raises the ray to the road `depth_m` ahead over the ray to its plane."""
    return 0.5 * vertical_per_m * (depth_m - PLANE_AT_M)


def rays_cam(camera: Camera, px: Floats) -> Floats:
    """(N, 3) rays K^-1 x of pixels (N, 2), in camera axes, z = 1."""
    rays = np.ones((len(px), 3))
    rays[:, :2] = camera.to_xy(px)
    return rays


def bearing_and_slope(camera: Camera, ground: GroundPlane, px: Floats) -> Floats:
    """(N, 2) bearing y/x and slope -z/x, in the ego frame, of the rays of pixels (N, 2).

    A ray (1, bearing, -slope) intersects the road at x = `meet_road(1, slope, H)`. Slopes above the horizon are
    negative.
    """
    x, y, z = (rays_cam(camera, px) @ ground.R_ego_cam.T).T
    return np.column_stack([y / x, -z / x])


def road_point_cam(camera: Camera, ground: GroundPlane, px: Floats) -> Floats:
    """(N, 3) road points of pixels (N, 2), in camera axes, metres; NaN where the ray misses the road (Eq. 1)."""
    rays = rays_cam(camera, np.atleast_2d(np.asarray(px, dtype=np.float64)))
    fall = -(rays @ ground.normal_cam)
    with np.errstate(divide="ignore", invalid="ignore"):
        points = meet_road(rays, fall[:, None], ground.height_m)
    points[(fall <= 0.0) | (points[:, 2] > MAX_RANGE_M)] = np.nan
    return points


def pixel_to_ego(camera: Camera, ground: GroundPlane, px: Floats, vertical_per_m: float = 0.0) -> Floats:
    """(N, 2) road points of pixels (N, 2), in the ego frame, metres; NaN above the horizon or beyond MAX_RANGE_M.

    `vertical_per_m` is the road's vertical curvature over the ground plane.
    """
    if not vertical_per_m:
        return (road_point_cam(camera, ground, px) @ ground.R_ego_cam.T)[:, :2]
    bearing, slope = bearing_and_slope(camera, ground, np.atleast_2d(np.asarray(px, dtype=np.float64))).T
    x = meet_bend(slope + rise(0.0, vertical_per_m), ground.height_m, vertical_per_m)
    x[x > MAX_RANGE_M] = np.nan
    return np.column_stack([x, bearing * x])


def ego_to_pixel(camera: Camera, ground: GroundPlane, points: Floats) -> Floats:
    """(N, 2) pixels of ego-frame points, (N, 2) on the road or (N, 3); NaN behind the camera."""
    points = np.atleast_2d(np.asarray(points, dtype=np.float64))
    if points.shape[1] == 2:
        points = np.column_stack([points, np.zeros(len(points))])
    cam = (points - np.array([0.0, 0.0, ground.height_m])) @ ground.R_ego_cam
    with np.errstate(divide="ignore", invalid="ignore"):
        px = camera.to_px(cam[:, :2] / cam[:, 2:])
    px[cam[:, 2] <= 0.0] = np.nan
    return px


def road_point_cov(
    camera: Camera,
    ground: GroundPlane,
    px: Floats,
    sigma_px: Floats | float,
    sigma_pitch_rad: float = 0.0,
    sigma_height_rel: float = 0.0,
) -> Floats:
    """(N, 2, 2) covariances in m^2 of `pixel_to_ego`, to first order.

    `sigma_px` is the pixel noise, a scalar or (2,) for u and v. Pitch and height errors are common to all points of a
    frame but are treated as independent here; `road_point_errors` returns them separately.
    """
    J = road_point_errors(camera, ground, px, sigma_px, sigma_pitch_rad, sigma_height_rel)
    out: Floats = J @ np.swapaxes(J, 1, 2)
    return out


def road_point_errors(
    camera: Camera,
    ground: GroundPlane,
    px: Floats,
    sigma_px: Floats | float,
    sigma_pitch_rad: float,
    sigma_height_rel: float,
    vertical_per_m: float = 0.0,
) -> Floats:
    """(N, 2, 4) in m: displacement of each point by 1-sigma of its column, its row, the pitch and the height."""
    px = np.atleast_2d(np.asarray(px, dtype=np.float64))
    sigma_u, sigma_v = np.broadcast_to(np.asarray(sigma_px, dtype=np.float64), (2,))
    step_px, step_rad = 0.5, 1e-4
    steps_px = np.array([[0.0, 0.0], [step_px, 0.0], [-step_px, 0.0], [0.0, step_px], [0.0, -step_px]])
    stepped = (px + steps_px[:, None]).reshape(-1, 2)
    here, right, left, below, above = pixel_to_ego(camera, ground, stepped, vertical_per_m).reshape(5, -1, 2)

    def pitched(d_rad: float) -> Floats:
        turned = GroundPlane(ground.height_m, ground.pitch_rad + d_rad, ground.roll_rad)
        return pixel_to_ego(camera, turned, px, vertical_per_m)

    columns = [
        (right - left) / (2.0 * step_px) * sigma_u,
        (below - above) / (2.0 * step_px) * sigma_v,
        (pitched(step_rad) - pitched(-step_rad)) / (2.0 * step_rad) * sigma_pitch_rad,
        here * sigma_height_rel,
    ]
    out: Floats = np.stack(columns, axis=-1)
    return out
