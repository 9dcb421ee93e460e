"""The relative pose of a new image: among the landmarks of the window, or from two views where there are none yet."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.pose import Pose
from birdslam.odometry.corners.sliding_window import MIN_DEPTH, SlidingWindow, turned
from birdslam.odometry.median import upper_median

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

_LEAST_LANDMARKS = 8
_HUBER_SIGMA = 1.5
_ITERATIONS = 8
_CONVERGED = 1e-5
_SOFT_ITERATIONS = 3  # the first ones, in which the limit of outliers follows the residuals themselves


@dataclass(frozen=True)
class _Landmarks:
    """The N landmarks of known depth that the image shows."""

    scaled: Floats  # (3, N) where they are in the window's axes, times their inverse depths
    rho: Floats  # (N,) inverse depth
    rho_sigma: Floats  # (N,) 0 where it is not known
    p_anchor: Floats  # (3, N)
    target: Floats  # (2, N) where the image shows them, in normalised coordinates


def locate(window: SlidingWindow, guess: Pose, ids: Ints, xy: Floats) -> tuple[Pose, Bools, Floats]:
    """Pose of one image from the window's landmarks (resection), robustly; ids (N,), xy (N, 2) normalised coordinates.

    Returns the pose, which of the N observations are inliers (N,), and the information matrix (6, 6) of the pose in
    (translation, rotation) of the camera's own axes; `guess` and no information where too few landmarks are seen.
    """
    inliers = np.zeros(len(ids), bool)
    at, known = _known(window, ids)
    if known.sum() < _LEAST_LANDMARKS:
        return guess, inliers, np.zeros((6, 6))
    landmarks = _landmarks(window, at[known], xy[known])
    pose, info = guess, np.zeros((6, 6))
    limit = window.reject_px / window.sigma_px
    J = np.zeros((6, 2, len(landmarks.rho)))
    for k in range(_ITERATIONS):
        r, variance, ahead = _linearise(window, landmarks, pose, J)
        norm = np.sqrt((r[0] ** 2 + r[1] ** 2) / variance)
        gate = max(limit, 3.0 * 1.2 * upper_median(norm)) if k < _SOFT_ITERATIONS else limit
        w = np.where(ahead & (norm < gate), 1.0 / (np.maximum(1.0, norm / _HUBER_SIGMA) * variance), 0.0)
        flat = J.reshape(6, -1)
        Jw = (J * w).reshape(6, -1)
        info = Jw @ flat.T
        g = Jw @ r.reshape(-1)
        step = -np.linalg.solve(info + (1e-9 * np.trace(info) + 1e-9) * np.eye(6), g)
        pose = pose.moved(step)
        if k >= _SOFT_ITERATIONS and np.abs(step).max() < _CONVERGED:
            break
    inliers[np.flatnonzero(known)] = (norm < limit) & ahead
    return pose, inliers, info


def _known(window: SlidingWindow, ids: Ints) -> tuple[Ints, Bools]:
    """(N,) the window's landmark of each id, and whether there is one of known depth."""
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
        scaled=turned(R, anchor, window.xy_of(anchor, m)) + rho * p_anchor,
        rho=rho,
        rho_sigma=np.where(np.isfinite(window.rho_sigma[m]), window.rho_sigma[m], 0.0),
        p_anchor=p_anchor,
        target=np.ascontiguousarray(xy.T),
    )


def _linearise(window: SlidingWindow, seen: _Landmarks, pose: Pose, J: Floats) -> tuple[Floats, Floats, Bools]:
    """Residuals (2, N) in px, their variances (N,), and which landmarks lie ahead; J (6, 2, N) is filled."""
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
    # An uncertain depth blurs the observation along its epipolar line; isotropic is near enough.
    a = pose.R.T @ seen.p_anchor - place
    along = (a[:2] - uv * a[2]) * (by_z * seen.rho_sigma)
    return (uv - seen.target) * f, window.sigma_px**2 + (along[0] ** 2 + along[1] ** 2), ahead


def two_view(xy_a: Floats, xy_b: Floats, focal_px: float, threshold_px: float) -> tuple[Pose, Bools] | None:
    """T_a_b (translation of unit length) of two images from normalised coordinates (N, 2), by 5-point RANSAC.

    None where the two views do not determine it.
    """
    if len(xy_a) < 12:
        return None
    cv2.setRNGSeed(1)
    E, mask = cv2.findEssentialMat(xy_a, xy_b, np.eye(3), cv2.USAC_MAGSAC, 0.999, threshold_px / focal_px, 500)
    if E is None or E.shape != (3, 3) or mask is None:
        return None
    # Depths are unbounded: by default recoverPose counts whatever is 50 baselines away as wrong.
    count, R, t, _, _ = cv2.recoverPose(E, xy_a, xy_b, cameraMatrix=np.eye(3), distanceThresh=1e5, mask=mask.copy())
    if count < 5:
        return None
    T_b_a = Pose(np.asarray(R, np.float64), np.asarray(t, np.float64).ravel())
    return T_b_a.inverse(), mask.ravel() > 0
