"""Likelihoods of a factor on all lengths, for the posterior of an unknown scale (scale_posterior.py).

The road's image determines the length between two images, but stripes and shadows that move have other maxima.
Landmarks determine the height of the camera: few lie below the road, whatever the image of the road shows.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera, plane_normal
from birdslam.geometry.pose import Pose
from birdslam.odometry.corners.sliding_window import SlidingWindow
from birdslam.odometry.road.road_image import RoadImage

Floats = NDArray[np.float64]

_MIN_LENGTH_M, _MAX_LENGTH_M = 0.03, 6.0  # of a motion between two aligned images
# Gauss-Hermite quadrature over the pitch: nodes in sigmas, and logs of their weights
_PITCH_SIGMAS: Floats = np.sqrt(3.0) * np.array([-1.0, 0.0, 1.0])
_LOG_WEIGHTS: Floats = np.log([1.0 / 6.0, 2.0 / 3.0, 1.0 / 6.0])[:, None]
_SAMPLES = 900  # compared pixels
_MIN_FLOW_PX = 1.5  # of a pixel that moves with the road: a smaller one is like no motion
_MIN_VISIBLE_RATIO = 0.5  # of the pixels, those that move within the image
_MIN_EXPLAINED = 0.03  # minimum squared partial correlation of a motion
_MIN_UNEXPLAINED = 1e-3  # minimum ratio of variance that an image leaves unexplained: noise
# Landmarks on or over the road: area of a lane and its neighbours, maximum sigma of the depth
_ROAD_NEAR_M, _ROAD_FAR_M, _ROAD_HALF_WIDTH_M = 3.0, 30.0, 6.0
_DEPTH_SIGMA_REL = 0.25
_LANDMARK_SIGMA_LOG = 0.15  # landmarks are up to a tenth short, and a pitch error of a degree adds a fifth
_MIN_LANDMARKS = 6
_P_ON_ROAD, _P_BELOW = 0.3, 0.1  # of a landmark; one below the road is an outlier
_HEIGHT_RANGE_LOG = 3.0  # over which the heights of other landmarks are uniform


def road_log_likelihood(
    camera: Camera,
    past: RoadImage,
    present: RoadImage,
    T_past_present: Pose,
    px: NDArray[np.int64],
    tilt: tuple[float, float],
    sigma_pitch_rad: float,
    log_factors: Floats,
    effective_fraction: float,
) -> Floats:
    """(N,) log likelihood of the road's image at each factor on the translation of `T_past_present`, over all pitches.

    -n/2 log(1 - c^2) for a correlation c of n independent samples, a fraction of `px` (M, 2), the pixels of the current
    image that show road. `tilt` is (pitch, roll) in rad. 0 where the length is out of range.
    """
    samples = effective_fraction * len(px)
    px = px[:: max(1, len(px) // _SAMPLES)]
    lengths_m = float(np.linalg.norm(T_past_present.p)) * np.exp(log_factors)
    inside = (lengths_m > _MIN_LENGTH_M) & (lengths_m < _MAX_LENGTH_M)
    out = np.zeros(len(log_factors))
    if not inside.any():
        return out
    translations = np.exp(log_factors[inside])[:, None] * T_past_present.p
    R, tilts = T_past_present.R, [(tilt[0] + off_rad, tilt[1]) for off_rad in sigma_pitch_rad * _PITCH_SIGMAS]
    explained = np.array([explained_by_motion(camera, past, present, R, translations, px, each) for each in tilts])
    by_pitch = -0.5 * samples * np.log(np.maximum(1.0 - explained, _MIN_UNEXPLAINED))
    out[inside] = np.logaddexp.reduce(by_pitch + _LOG_WEIGHTS, axis=0)
    return out


def best_length(explained: Floats) -> tuple[int, int]:
    """Indices of the pitch and of the length with the largest of `explained` (pitches, L); the first if all are small.

    The lengths ascend; the first is that of a stationary camera.
    """
    pitch, length = np.unravel_index(int(explained.argmax()), explained.shape)
    if explained[pitch, length] < _MIN_EXPLAINED:
        return int(pitch), 0
    return int(pitch), int(length)


def explained_by_motion(
    camera: Camera,
    past: RoadImage,
    present: RoadImage,
    R_past_present: Floats,
    translations: Floats,
    px: NDArray[np.int64],
    tilt: tuple[float, float],
) -> Floats:
    """(L,) squared partial correlation of the road in two images for each of the translations (L, 3), 0 to 1.

    The present image is a regression on the past image, warped by the motion over a flat road, and on the past image as
    it is. The second regressor explains what does not move with the road: the bonnet, reflections, drops, and encoder
    artifacts on smooth asphalt. The result is the ratio of what it leaves unexplained that the motion explains.
    `px` (N, 2) are pixels of the current image that show road, `tilt` is (pitch, roll) in rad.
    """
    f32 = np.float32
    focal_px, centre_px = [camera.fx_px, camera.fy_px], [camera.cx_px, camera.cy_px]
    rays = np.stack([*((px - centre_px) / focal_px).T, np.ones(len(px))]).astype(f32)
    rho = (plane_normal(*tilt)[0].astype(f32) @ rays) * f32(-1.0 / camera.height_m)
    q = (R_past_present.astype(f32) @ rays)[:, None, :] + translations.astype(f32).T[:, :, None] * rho
    by_z = f32(1.0) / np.maximum(q[2], f32(1e-3))
    u = q[0] * by_z * f32(camera.fx_px) + f32(camera.cx_px)
    v = q[1] * by_z * f32(camera.fy_px) + f32(camera.cy_px - past.top_px)
    rows, cols = past.grey.shape
    static_u, static_v = px[:, 0].astype(f32), (px[:, 1] - past.top_px).astype(f32)
    moves = np.abs(u - static_u) + np.abs(v - static_v) > _MIN_FLOW_PX
    inside = ((u > 0) & (u < cols - 1) & (v > 0) & (v < rows - 1) & moves).astype(f32)
    warped = cv2.remap(past.grey, u, v, cv2.INTER_LINEAR) * inside
    here, static = (image.grey[px[:, 1] - image.top_px, px[:, 0]] for image in (present, past))

    count, here_sum, static_sum, here_sq, static_sq, here_static = (
        inside @ np.stack([np.ones_like(here), here, static, here * here, static * static, here * static], axis=1)
    ).T.astype(np.float64)
    n = np.maximum(count, 1.0)
    warped_sum, warped_sq = warped.sum(axis=1), np.einsum("ij,ij->i", warped, warped)
    warped_here, warped_static = (warped @ np.stack([here, static], axis=1)).T

    def correlation(ab: Floats, a: Floats, b: Floats, aa: Floats, bb: Floats) -> Floats:
        variances = np.maximum(aa - a * a / n, 1e-6) * np.maximum(bb - b * b / n, 1e-6)
        out: Floats = np.clip((ab - a * b / n) / np.sqrt(variances), -1.0, 1.0)
        return out

    by_road = correlation(warped_here, warped_sum, here_sum, warped_sq, here_sq)
    by_static = correlation(here_static, here_sum, static_sum, here_sq, static_sq).clip(0.0)
    between = correlation(warped_static, warped_sum, static_sum, warped_sq, static_sq)
    partial = (by_road - between * by_static) / np.sqrt(
        np.maximum((1.0 - between**2) * (1.0 - by_static**2), _MIN_UNEXPLAINED)
    )
    partial = np.where(count < _MIN_VISIBLE_RATIO * len(px), 0.0, partial.clip(0.0, 1.0))
    out: Floats = partial**2
    return out


def landmark_log_likelihood(
    camera: Camera, tilt: tuple[float, float], window: SlidingWindow, log_factors: Floats, effective_fraction: float
) -> Floats | None:
    """(N,) log likelihood of each factor on the window's lengths by its landmarks; None: too few.

    A landmark lies on the road, above it, or is an outlier below it. Only a fraction of them has independent errors.
    `tilt` is (pitch, roll) in rad.
    """
    seen = np.isfinite(window.obs[-1, :, 0]) & np.isfinite(window.rho) & (window.rho > 1e-6)
    seen &= window.rho_sigma < _DEPTH_SIGMA_REL * window.rho
    xy, newest = window.obs[-1, seen], window.poses[-1]
    rays = np.column_stack([xy, np.ones(len(xy))])
    by_plane = -(rays @ plane_normal(*tilt)[0]) / camera.height_m  # 1 / m
    inverse_depth = window.inverse_depths(newest)[seen]
    road = (
        (by_plane > 1.0 / _ROAD_FAR_M)
        & (by_plane < 1.0 / _ROAD_NEAR_M)
        & (np.abs(xy[:, 0]) < _ROAD_HALF_WIDTH_M * by_plane)
    )
    road &= np.isfinite(inverse_depth) & (inverse_depth > 0.0)
    if road.sum() < _MIN_LANDMARKS:
        return None
    ratio = np.log(inverse_depth[road] / by_plane[road])
    above = ratio - log_factors[:, None]
    on_road = np.exp(-0.5 * np.square(above / _LANDMARK_SIGMA_LOG)) / (np.sqrt(2.0 * np.pi) * _LANDMARK_SIGMA_LOG)
    elsewhere = np.where(above > 0.0, 1.0 - _P_ON_ROAD - _P_BELOW, _P_BELOW) / _HEIGHT_RANGE_LOG
    out: Floats = effective_fraction * np.log(_P_ON_ROAD * on_road + elsewhere).sum(axis=1)
    return out
