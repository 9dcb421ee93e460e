"""Search for an unknown length, by landmarks on the road and by correlation of the road's image.

An alignment (alignment.py) converges only within the size of the road's texture; the search initializes it. Landmarks
give a length that is up to a tenth too short, but reflections and periodic stripes do not affect it. So they bound the
accepted alignments.
"""

from __future__ import annotations

from collections.abc import Callable
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
_STATIONARY_M = 0.1  # a shorter motion is a standstill
_MIN_LEAD = 0.1  # of the changed pixels' correlation over that at standstill
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
    """Returns that of `lengths` (L,) in metres with the best correlation on a flat road, over three pitches.

    `px` (N, 2) are pixels of the current image that show road, `tilt` is (pitch, roll) in rad. Only the direction of
    the translation of `T_past_present` is used.
    """
    px = px[:: max(1, len(px) // 900)]
    tilts = [(pitch_rad, tilt[1]) for pitch_rad in (tilt[0] - 0.01, tilt[0], tilt[0] + 0.01)]
    translations = lengths[:, None] * (T_past_present.p / max(float(np.linalg.norm(T_past_present.p)), 1e-9))

    def correlate(changed: bool) -> Floats:
        shown = far_changed_pixels(past, present, px) if changed else px
        return np.array(
            [correlations(camera, past, present, T_past_present.R, translations, shown, each) for each in tilts]
        )

    return float(lengths[best_correlation(correlate, lengths)[1]])


def best_correlation(correlate: Callable[[bool], Floats], lengths: Floats) -> tuple[int, int]:
    """Indices of the pitch and of the length, of `lengths` (L,) ascending in metres, with the best correlation.

    `correlate(changed)` returns correlations (pitches, L) over the whole road, or over its changed far pixels. No
    length explains the changed pixels of a stationary car. If one does, the bonnet or encoder artifacts correlate at
    standstill.
    """
    by_road = correlate(False)
    pitch, length = np.unravel_index(int(by_road.argmax()), by_road.shape)
    if lengths[length] < _STATIONARY_M:
        by_change = correlate(True)
        changed_pitch, changed_length = np.unravel_index(int(by_change.argmax()), by_change.shape)
        if by_change[changed_pitch, changed_length] > by_change[:, lengths < _STATIONARY_M].max() + _MIN_LEAD:
            pitch, length = changed_pitch, changed_length
    return int(pitch), int(length)


def far_changed_pixels(past: RoadImage, present: RoadImage, px: NDArray[np.int64]) -> NDArray[np.int64]:
    """The most changed half of the farther half of the road's pixels (N, 2) in the current image."""
    far = px[px[:, 1] < np.median(px[:, 1])]
    then, now = (image.grey[far[:, 1] - image.top_px, far[:, 0]] for image in (past, present))
    change = np.abs(now - then)
    return far[change >= np.median(change)] if len(far) else far


def correlations(
    camera: Camera,
    past: RoadImage,
    present: RoadImage,
    R_past_present: Floats,
    translations: Floats,
    px: NDArray[np.int64],
    tilt: tuple[float, float],
) -> Floats:
    """(L,) correlation of the road's pixels (N, 2) with the past image, for each of the translations (L, 3)."""
    f32 = np.float32
    focal_px, centre_px = [camera.fx_px, camera.fy_px], [camera.cx_px, camera.cy_px]
    rays = np.stack([*((px - centre_px) / focal_px).T, np.ones(len(px))]).astype(f32)
    here = present.grey[px[:, 1] - present.top_px, px[:, 0]]
    rho = (plane_normal(*tilt)[0].astype(f32) @ rays) * f32(-1.0 / camera.height_m)
    q = (R_past_present.astype(f32) @ rays)[:, None, :] + translations.astype(f32).T[:, :, None] * rho
    by_z = f32(1.0) / np.maximum(q[2], f32(1e-3))
    u = q[0] * by_z * f32(camera.fx_px) + f32(camera.cx_px)
    v = q[1] * by_z * f32(camera.fy_px) + f32(camera.cy_px - past.top_px)
    rows, cols = past.grey.shape
    inside = ((u > 0) & (u < cols - 1) & (v > 0) & (v < rows - 1)).astype(f32)
    count = np.maximum(inside.sum(axis=1), 1.0)
    a, b = cv2.remap(past.grey, u, v, cv2.INTER_LINEAR) * inside, here * inside
    mean_a, mean_b = a.sum(axis=1) / count, b.sum(axis=1) / count
    ab, aa, bb = (np.einsum("ij,ij->i", *pair) for pair in ((a, b), (a, a), (b, b)))
    variances = (aa - count * mean_a**2) * (bb - count * mean_b**2)
    out: Floats = (ab - count * mean_a * mean_b) / np.sqrt(np.maximum(variances, 1e-9))
    out[count < 0.5 * len(px)] = -1.0  # most pixels leave the image
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
