"""Relative pose of two images: essential matrix by five points, or robust least squares from a motion prior.

For distant corners the essential matrix confuses rotation with lateral translation; least squares from a prior does
not. The sign of the parallax along the epipolar line rejects outliers with a small epipolar distance.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.pose import Pose, rotation_exp

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

_SIGMA_ROTATION_RAD = 0.02  # prior: the resolution of the search (initialisation.py) and the car's roll
_SIGMA_DIRECTION_RAD = 0.07  # prior: the mount's yaw and pitch, and the lateral motion in front of the rear axle
# Of the robust kernel, one per iteration
_KERNEL_WIDTHS_PX = (4.0, 3.0, 2.0, 1.5, 1.0, 1.0, 0.7, 0.7, 0.7, 0.7)
_STEP_RAD = 1e-5  # of the numerical derivative
# Forward part of a unit translation; 0.95 in a bend of 5 m radius, 1.7 m in front of the rear axle
_MIN_FORWARD_RATIO = 0.87


def initial_two_view(
    xy_a: Floats, xy_b: Floats, guess: Pose, focal_px: float, threshold_px: float
) -> tuple[Pose, Bools] | None:
    """T_a_b (unit translation) and the inliers among the N pairs, from the prior or by five points.

    Prefers five points only if they have 10 % more inliers and a mostly forward motion.
    """
    from_prior = two_view_from_prior(xy_a, xy_b, guess, focal_px, threshold_px)
    five_point = five_point_pose(xy_a, xy_b, focal_px, threshold_px)
    if five_point is not None:
        rays_a, rays_b = _rays(xy_a), _rays(xy_b)
        five_point = (
            five_point[0],
            five_point[1] & (_parallax_px(five_point[0], rays_a, rays_b, focal_px) > -threshold_px),
        )
    if from_prior is None or five_point is None:
        return five_point if from_prior is None else from_prior
    sideways = abs(float(five_point[0].p[2])) < _MIN_FORWARD_RATIO
    return from_prior if sideways or from_prior[1].sum() > 0.9 * five_point[1].sum() else five_point


def two_view_from_prior(
    xy_a: Floats, xy_b: Floats, guess: Pose, focal_px: float, threshold_px: float
) -> tuple[Pose, Bools] | None:
    """T_a_b (unit translation) near `guess` and the inliers among the N pairs, by iteratively reweighted least squares.

    xy_a, xy_b (N, 2) are normalised coordinates. None if the guess has no translation or there is no inlier.
    """
    length = float(np.linalg.norm(guess.p))
    if len(xy_a) < 12 or length < 1e-6:
        return None
    rays_a, rays_b = _rays(xy_a), _rays(xy_b)
    axes = _tangent_basis(guess.p / length)
    prior = np.array([_SIGMA_ROTATION_RAD**-2] * 3 + [_SIGMA_DIRECTION_RAD**-2] * 2)
    x = np.zeros(5)
    for width_px in _KERNEL_WIDTHS_PX:
        T = _pose(x, guess, axes)
        r = _residuals(T, rays_a, rays_b, focal_px)
        J = np.empty((5, len(r)))
        for k in range(5):
            moved = x.copy()
            moved[k] += _STEP_RAD
            J[k] = (_residuals(_pose(moved, guess, axes), rays_a, rays_b, focal_px) - r) / _STEP_RAD
        w = 1.0 / np.square(1.0 + np.square(r / width_px)) / threshold_px**2  # Geman-McClure
        w *= _parallax_px(T, rays_a, rays_b, focal_px) > -width_px
        x = x - np.linalg.solve((J * w) @ J.T + np.diag(prior), (J * w) @ r + prior * x)
    if not np.isfinite(x).all():
        return None
    T = _pose(x, guess, axes)
    fits = np.abs(_residuals(T, rays_a, rays_b, focal_px)) < threshold_px
    fits &= _parallax_px(T, rays_a, rays_b, focal_px) > -threshold_px
    return (T, fits) if fits.any() else None


def five_point_pose(xy_a: Floats, xy_b: Floats, focal_px: float, threshold_px: float) -> tuple[Pose, Bools] | None:
    """T_a_b (unit translation) and the inliers, by 5-point RANSAC on normalised coordinates (N, 2).

    None if the two views do not determine it.
    """
    if len(xy_a) < 12:
        return None
    cv2.setRNGSeed(1)
    E, mask = cv2.findEssentialMat(xy_a, xy_b, np.eye(3), cv2.USAC_MAGSAC, 0.999, threshold_px / focal_px, 500)
    if E is None or E.shape != (3, 3) or mask is None:
        return None
    # By default recoverPose rejects points beyond 50 baselines
    count, R, t, _, _ = cv2.recoverPose(E, xy_a, xy_b, cameraMatrix=np.eye(3), distanceThresh=1e5, mask=mask.copy())
    if count < 5:
        return None
    T_b_a = Pose(np.asarray(R, np.float64), np.asarray(t, np.float64).ravel())
    return T_b_a.inverse(), mask.ravel() > 0


def _rays(xy: Floats) -> Floats:
    return np.column_stack([xy, np.ones(len(xy))])


def _tangent_basis(direction: Floats) -> Floats:
    """(2, 3) orthonormal basis of the plane perpendicular to a unit direction."""
    first = np.cross(direction, np.eye(3)[int(np.argmin(np.abs(direction)))])
    first = first / np.linalg.norm(first)
    return np.stack([first, np.cross(direction, first)])


def _pose(x: Floats, guess: Pose, axes: Floats) -> Pose:
    direction = guess.p / np.linalg.norm(guess.p) + x[3:] @ axes
    return Pose(rotation_exp(x[:3]) @ guess.R, direction / np.linalg.norm(direction))


def _residuals(T_a_b: Pose, rays_a: Floats, rays_b: Floats, focal_px: float) -> Floats:
    """(N,) px: Sampson distances."""
    tx, ty, tz = T_a_b.p
    E = np.array([[0.0, -tz, ty], [tz, 0.0, -tx], [-ty, tx, 0.0]]) @ T_a_b.R
    line_a, line_b = rays_b @ E.T, rays_a @ E
    norm2 = (line_a[:, :2] ** 2).sum(axis=1) + (line_b[:, :2] ** 2).sum(axis=1)
    out: Floats = focal_px * (rays_a * line_a).sum(axis=1) / np.sqrt(np.maximum(norm2, 1e-12))
    return out


def _parallax_px(T_a_b: Pose, rays_a: Floats, rays_b: Floats, focal_px: float) -> Floats:
    """(N,) px: parallax of each corner along its epipolar line, positive for positive depths."""
    turned = rays_a @ T_a_b.R
    at_infinity = turned[:, :2] / np.maximum(turned[:, 2:], 1e-3)
    p_b_a = -(T_a_b.R.T @ T_a_b.p)
    towards = p_b_a[:2] - at_infinity * p_b_a[2]
    length = np.maximum(np.linalg.norm(towards, axis=1), 1e-6)
    out: Floats = focal_px * ((rays_b[:, :2] - at_infinity) * towards).sum(axis=1) / length
    return out
