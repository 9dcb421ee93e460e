"""Resection: the pose of an image from the landmarks of the window (perspective-n-point).

Gauss-Newton on robust reprojection errors, whose variance includes the landmark's depth. Corners fixed in the image are
excluded if they change the pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.pose import Pose, rotation_log
from birdslam.odometry.corners.selection import Corners
from birdslam.odometry.corners.sliding_window import MIN_DEPTH, SlidingWindow, match_ids, rotate_rays
from birdslam.odometry.median import upper_median

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
PoseEstimate = tuple[Pose, Floats]  # a pose and its information (6, 6) of (translation, rotation) in camera axes

_MIN_LANDMARKS = 8
_HUBER_SIGMA = 1.5
_ITERATIONS = 8
_CONVERGED = 1e-5
_ADAPTIVE_ITERATIONS = 3  # first iterations, whose outlier threshold follows the residuals
_MAX_SAME_RAD, _MAX_SAME_RATIO = (
    0.0007,
    0.05,
)  # maximum difference of equal poses: rotation, and ratio of the translation
_GOOD_INLIER_RATIO = 0.7  # no further guess is tried above this


@dataclass(frozen=True)
class InlierLimits:
    """Acceptance limits of a resected pose."""

    min_inliers: int  # landmarks
    min_inlier_ratio: float  # of the visible landmarks
    max_step_m: float  # since the reference image


def pose_without_fixed_corners(
    window: SlidingWindow, corners: Corners, reference: Pose, guesses: Sequence[Pose], limits: InlierLimits
) -> tuple[Corners, PoseEstimate | None]:
    """The corners used and their pose; excludes the fixed corners if they change the pose.

    Parameters are as for `pose_from_landmarks`. Returns `corners` itself if none is excluded.
    """
    both = pose_from_landmarks(window, corners, reference, guesses, limits)
    if not corners.fixed.any():
        return corners, both
    street = corners.without_fixed()
    alone = pose_from_landmarks(window, street, reference, guesses, limits)
    if both is None or alone is None:
        return street, alone
    between, step = both[0].between(alone[0]), reference.between(alone[0])
    turned = float(np.linalg.norm(rotation_log(between.R))) > _MAX_SAME_RAD
    moved = float(np.linalg.norm(between.p)) > _MAX_SAME_RATIO * float(np.linalg.norm(step.p))
    return (street, alone) if turned or moved else (corners, both)


def pose_from_landmarks(
    window: SlidingWindow, corners: Corners, reference: Pose, guesses: Sequence[Pose], limits: InlierLimits
) -> PoseEstimate | None:
    """The image's pose in the window frame and its information (6, 6); None if too few landmarks are inliers.

    `reference` is the pose of the reference image. Tries the `guesses` in turn until one has enough inliers.
    """
    matches = len(match_ids(corners.ids, window.ids[np.isfinite(window.rho)])[0])
    best: tuple[int, Pose, Floats] | None = None
    if matches >= limits.min_inliers:
        for guess in guesses:
            pose, inliers, info = resect(window, guess, corners.ids, corners.xy)
            if best is None or inliers.sum() > best[0]:
                best = (int(inliers.sum()), pose, info)
            if best[0] > _GOOD_INLIER_RATIO * matches:
                break
    if best is None or best[0] < max(limits.min_inliers, limits.min_inlier_ratio * matches):
        return None
    return best[1:] if float(np.linalg.norm(best[1].p - reference.p)) <= limits.max_step_m else None


@dataclass(frozen=True)
class _Landmarks:
    """The N visible landmarks of known depth."""

    scaled: Floats  # (3, N) positions in window axes times the inverse depths
    rho: Floats  # (N,) inverse depth
    rho_sigma: Floats  # (N,) 0 if unknown
    p_anchor: Floats  # (3, N)
    target: Floats  # (2, N) observations, normalised coordinates


def resect(window: SlidingWindow, guess: Pose, ids: Ints, xy: Floats) -> tuple[Pose, Bools, Floats]:
    """Estimates the pose from observations of landmarks: ids (N,), xy (N, 2) in normalised coordinates.

    Returns the pose, the inliers (N,), and the pose's information (6, 6) of (translation, rotation) in camera axes;
    `guess` and zero information if too few landmarks are visible.
    """
    inliers = np.zeros(len(ids), bool)
    at, known = _match_landmarks(window, ids)
    if known.sum() < _MIN_LANDMARKS:
        return guess, inliers, np.zeros((6, 6))
    landmarks = _landmarks(window, at[known], xy[known])
    pose, info = guess, np.zeros((6, 6))
    limit = window.reject_px / window.sigma_px
    J = np.zeros((6, 2, len(landmarks.rho)))
    for k in range(_ITERATIONS):
        r, variance, ahead = _linearise(window, landmarks, pose, J)
        norm = np.sqrt((r[0] ** 2 + r[1] ** 2) / variance)
        gate = max(limit, 3.0 * 1.2 * upper_median(norm)) if k < _ADAPTIVE_ITERATIONS else limit
        w = np.where(ahead & (norm < gate), 1.0 / (np.maximum(1.0, norm / _HUBER_SIGMA) * variance), 0.0)
        flat = J.reshape(6, -1)
        Jw = (J * w).reshape(6, -1)
        info = Jw @ flat.T
        g = Jw @ r.reshape(-1)
        step = -np.linalg.solve(info + (1e-9 * np.trace(info) + 1e-9) * np.eye(6), g)
        pose = pose.moved(step)
        if k >= _ADAPTIVE_ITERATIONS and np.abs(step).max() < _CONVERGED:
            break
    inliers[np.flatnonzero(known)] = (norm < limit) & ahead
    return pose, inliers, info


def _match_landmarks(window: SlidingWindow, ids: Ints) -> tuple[Ints, Bools]:
    """(N,) index of each id's landmark in the window, and (N,) whether the landmark exists and has a depth."""
    at = np.searchsorted(window.ids, ids)
    at = np.minimum(at, max(len(window.ids) - 1, 0))
    known = np.zeros(len(ids), bool)
    if len(window.ids):
        known = (window.ids[at] == ids) & np.isfinite(window.rho[at])
    return at, known


def _landmarks(window: SlidingWindow, m: Ints, xy: Floats) -> _Landmarks:
    anchor = window.anchors()[m]
    R, p = window.stacked()
    rho, p_anchor = window.rho[m], p.T.take(anchor, axis=1)
    return _Landmarks(
        scaled=rotate_rays(R, anchor, window.xy_of(anchor, m)) + rho * p_anchor,
        rho=rho,
        rho_sigma=np.where(np.isfinite(window.rho_sigma[m]), window.rho_sigma[m], 0.0),
        p_anchor=p_anchor,
        target=np.ascontiguousarray(xy.T),
    )


def _linearise(window: SlidingWindow, seen: _Landmarks, pose: Pose, J: Floats) -> tuple[Floats, Floats, Bools]:
    """Residuals (2, N) in px, variances (N,), and which landmarks lie ahead; writes the Jacobian J (6, 2, N)."""
    f, rho = window.focal_px, seen.rho
    place = (pose.R.T @ pose.p)[:, None]
    q = pose.R.T @ seen.scaled - rho * place
    ahead = q[2] > MIN_DEPTH
    z = np.maximum(q[2], MIN_DEPTH)
    u, v = uv = q[:2] / z
    by_z = f / z
    along_z, fu, fv = rho * by_z, f * u, f * v
    J[0, 0] = J[1, 1] = -along_z
    np.multiply(along_z, uv, out=J[2])
    J[3, 0] = fu * v
    np.negative(J[3, 0], out=J[4, 1])
    f_z = f * (q[2] / z)
    J[3, 1] = f_z + fv * v
    J[4, 0] = -(f_z + fu * u)
    J[5, 0] = fv
    np.negative(fu, out=J[5, 1])
    # The variance of the depth along the epipolar line, approximated as isotropic
    a = pose.R.T @ seen.p_anchor - place
    along = (a[:2] - uv * a[2]) * (by_z * seen.rho_sigma)
    return (uv - seen.target) * f, window.sigma_px**2 + (along[0] ** 2 + along[1] ** 2), ahead
