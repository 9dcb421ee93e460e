"""Search for an unknown length, by landmarks on the road and by regression of the road's image.

An alignment (alignment.py) converges only within the size of the road's texture; the search initializes it. Landmarks
give a length that is up to a tenth too short, but reflections and periodic stripes do not affect it. So they bound the
accepted alignments.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera, plane_normal
from birdslam.geometry.pose import Pose
from birdslam.odometry.corners.sliding_window import SlidingWindow
from birdslam.odometry.road.alignment import RoadAligner
from birdslam.odometry.road.fit import ROAD, RoadFit
from birdslam.odometry.road.kalman_filter import RoadFilter
from birdslam.odometry.road.road_image import RoadImage

Floats = NDArray[np.float64]

_LENGTHS_M = np.geomspace(0.03, 6.0, 84)  # candidates of an unknown length
_SAMPLES = 900  # compared pixels
_MIN_FLOW_PX = 1.5  # of a pixel that moves with the road: a smaller one is like no motion
_MIN_VISIBLE_RATIO = 0.5  # of the pixels, those that move within the image
_MIN_EXPLAINED = 0.03  # minimum squared partial correlation of a motion
_MIN_UNEXPLAINED = 1e-3  # minimum ratio of variance that an image leaves unexplained: noise
# Landmarks on the road: area of a lane and its neighbours, maximum sigma of the depth, width of the mode
_ROAD_NEAR_M, _ROAD_FAR_M, _ROAD_HALF_WIDTH_M = 3.0, 30.0, 6.0
_DEPTH_SIGMA_REL = 0.25
_MODE_WIDTH_LOG = 0.1
_MIN_VOTES, _MIN_VOTE_SHARE = 6.0, 0.45
_MODE_GRID_LOG = np.linspace(-4.0, 4.0, 321)
# Tolerances of the log length: landmarks are up to a tenth short, and a pitch error of a degree adds a fifth
_LANDMARK_GATE, _AGREEMENT_GATE = 0.4, 0.15
_MAX_SIGMA_LOG = 0.5  # of a length from a search, unless the landmarks agree


@dataclass(frozen=True)
class LengthSearch:
    """Parameters of the search for a doubtful scale."""

    tilt: tuple[float, float]  # (pitch, roll) in rad
    lead: float  # minimum difference of the correlation to that at the predicted length
    tilt_sigma_rad: float  # added to the prior of the tilt


def best_alignment(
    aligner: RoadAligner,
    filter_: RoadFilter,
    past: RoadImage,
    present: RoadImage,
    T: Pose,
    px: NDArray[np.int64],
    by_landmarks: float | None,
    sigma_motion: tuple[float, float],
    search: LengthSearch | None,
    readout_share: float = 0.0,
) -> tuple[RoadFit, float, Floats] | None:
    """Returns the best fit, the factor on T_past_present that it starts from, and the filter's covariance for it.

    The alignment starts from the predicted length and, with a `search`, from the searched one and `by_landmarks`. Fits
    that the landmarks contradict are dropped; None if none is left. `readout_share` as in `RoadAligner.align`.
    """
    (prior, predicted_cov), prior_cov = filter_.prediction, filter_.cov.copy()
    fit = aligner.align(past, present, T, px, prior, predicted_cov, sigma_motion, readout_share)
    factor, cov = 1.0, prior_cov
    if fit is not None and _contradicts(fit.state[0], by_landmarks):
        fit = None
    if search is not None:
        length = float(np.linalg.norm(T.p))
        searched = search_length(aligner.camera, past, present, T, px, search.tilt, _LENGTHS_M) / length
        loose = prior_cov.copy()
        loose[0, :] = loose[:, 0] = 0.0
        loose[0, 0] = 0.3**2
        if search.tilt_sigma_rad:
            loose[1:3, 1:3] += np.eye(2) * search.tilt_sigma_rad**2
        for start in (searched,) if by_landmarks is None else (searched, by_landmarks):
            started = Pose(T.R, T.p * start)
            other = aligner.align(past, present, started, px, prior, loose[:ROAD, :ROAD], sigma_motion, readout_share)
            if other is None:
                continue
            log_length = float(np.log(start)) + other.state[0]
            if _contradicts(log_length, by_landmarks):
                continue
            if _is_vague(other) and not agrees(log_length, by_landmarks):
                continue
            if fit is None or other.correlation > fit.correlation + search.lead:
                fit, factor, cov = other, start, loose
    return None if fit is None else (fit, factor, cov)


def _is_vague(fit: RoadFit) -> bool:
    """Whether a search found no length, by the image gradients or since other lengths are as likely."""
    return fit.cov[0, 0] > _MAX_SIGMA_LOG**2 or fit.length_information < _MAX_SIGMA_LOG**-2


def _contradicts(log_length: float, by_landmarks: float | None) -> bool:
    """Whether a log factor on the lengths is inconsistent with the factor of the landmarks."""
    return by_landmarks is not None and abs(log_length - float(np.log(by_landmarks))) > _LANDMARK_GATE


def agrees(log_length: float, by_landmarks: float | None) -> bool:
    """Whether the landmarks on the road confirm a log factor on the lengths."""
    return by_landmarks is not None and abs(log_length - float(np.log(by_landmarks))) <= _AGREEMENT_GATE


def search_length(
    camera: Camera,
    past: RoadImage,
    present: RoadImage,
    T_past_present: Pose,
    px: NDArray[np.int64],
    tilt: tuple[float, float],
    lengths: Floats,
) -> float:
    """Returns that of `lengths` (L,) in metres that explains most of the image of a flat road, over three pitches.

    `px` (N, 2) are pixels of the current image that show road, `tilt` is (pitch, roll) in rad. Only the direction of
    the translation of `T_past_present` is used.
    """
    px = px[:: max(1, len(px) // _SAMPLES)]
    R = T_past_present.R
    translations = lengths[:, None] * (T_past_present.p / max(float(np.linalg.norm(T_past_present.p)), 1e-9))
    tilts = [(pitch_rad, tilt[1]) for pitch_rad in (tilt[0] - 0.01, tilt[0], tilt[0] + 0.01)]
    gains = np.array([explained_by_motion(camera, past, present, R, translations, px, each) for each in tilts])
    return float(lengths[best_length(gains)[1]])


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


def scale_from_landmarks(camera: Camera, tilt: tuple[float, float], window: SlidingWindow) -> float | None:
    """Metres per scale of the window, from the mode of the camera's height over the landmarks on the road.

    `tilt` is (pitch, roll) in rad. None if too few landmarks agree on one height.
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
    if road.sum() < _MIN_VOTES:
        return None
    ratio = np.log(inverse_depth[road] / by_plane[road])
    votes = np.exp(-0.5 * np.square((_MODE_GRID_LOG[:, None] - ratio) / _MODE_WIDTH_LOG)).sum(axis=1)
    best = int(votes.argmax())
    if votes[best] < max(_MIN_VOTES, _MIN_VOTE_SHARE * len(ratio)):
        return None
    return float(np.exp(_MODE_GRID_LOG[best]))
