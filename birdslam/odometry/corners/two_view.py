"""The relative pose of two images from a guess of it: epipolar geometry with a car's motion for its prior.

Five points determine the pose of two images, but where most corners are far away a turn looks like a move to the side,
and among wrong matches or along a moving car RANSAC finds many corners that agree on one that no car makes. From a
guess near the truth the same residuals, weighted robustly, have one minimum. A residual says only how far a corner is
from its epipolar line; along it a corner moves away from where it would be at infinity, and one that has moved the
other way is a wrong match, or on something that moves along with the car.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.pose import Pose, rotation_exp
from birdslam.odometry.corners.relative_pose import two_view

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

# 1-sigma of a guess: a degree of rotation, as far as a search's cell and a car's roll go; of the direction of travel
# the mount's yaw and pitch and the slip of a camera in front of the rear axle
_SIGMA_ROTATION_RAD = 0.02
_SIGMA_DIRECTION_RAD = 0.07
# Of the robust weights, one a step: from wide to narrow
_WIDTHS_PX = (4.0, 3.0, 2.0, 1.5, 1.0, 1.0, 0.7, 0.7, 0.7, 0.7)
_STEP_RAD = 1e-5  # of the numerical derivative
# Of a car's way along the camera's axis, where it is of unit length: in a bend of 5 m radius it is 0.95 at 1.7 m before
# the rear axle. Five points of a ramp with one tree and rails found 0.68 (tests/roads/ramp_21_glare)
_LEAST_FORWARD = 0.87


def first_pose(
    xy_a: Floats, xy_b: Floats, guess: Pose, focal_px: float, threshold_px: float
) -> tuple[Pose, Bools] | None:
    """T_a_b (translation of unit length) and which of the N pairs fit it, from a guess of it and without one.

    The one from the guess goes before that of five points unless a tenth more fit the latter, or it is no car's.
    """
    guided = guided_two_view(xy_a, xy_b, guess, focal_px, threshold_px)
    free = two_view(xy_a, xy_b, focal_px, threshold_px)
    if free is not None:
        rays_a, rays_b = _rays(xy_a), _rays(xy_b)
        free = free[0], free[1] & (_nearer_px(free[0], rays_a, rays_b, focal_px) > -threshold_px)
    if guided is None or free is None:
        return free if guided is None else guided
    no_car = abs(float(free[0].p[2])) < _LEAST_FORWARD
    return guided if no_car or guided[1].sum() > 0.9 * free[1].sum() else free


def guided_two_view(
    xy_a: Floats, xy_b: Floats, guess: Pose, focal_px: float, threshold_px: float
) -> tuple[Pose, Bools] | None:
    """T_a_b (translation of unit length) near `guess`, and which of the N pairs fit it.

    xy_a, xy_b (N, 2) are normalised coordinates. None where the guess has no direction, or nothing fits.
    """
    length = float(np.linalg.norm(guess.p))
    if len(xy_a) < 12 or length < 1e-6:
        return None
    rays_a, rays_b = _rays(xy_a), _rays(xy_b)
    axes = _across(guess.p / length)
    prior = np.array([_SIGMA_ROTATION_RAD**-2] * 3 + [_SIGMA_DIRECTION_RAD**-2] * 2)
    x = np.zeros(5)
    for width_px in _WIDTHS_PX:
        T = _pose(x, guess, axes)
        r = _residuals(T, rays_a, rays_b, focal_px)
        J = np.empty((5, len(r)))
        for k in range(5):
            moved = x.copy()
            moved[k] += _STEP_RAD
            J[k] = (_residuals(_pose(moved, guess, axes), rays_a, rays_b, focal_px) - r) / _STEP_RAD
        w = 1.0 / np.square(1.0 + np.square(r / width_px)) / threshold_px**2  # Geman-McClure
        w *= _nearer_px(T, rays_a, rays_b, focal_px) > -width_px
        x = x - np.linalg.solve((J * w) @ J.T + np.diag(prior), (J * w) @ r + prior * x)
    if not np.isfinite(x).all():
        return None
    T = _pose(x, guess, axes)
    fits = np.abs(_residuals(T, rays_a, rays_b, focal_px)) < threshold_px
    fits &= _nearer_px(T, rays_a, rays_b, focal_px) > -threshold_px
    return (T, fits) if fits.any() else None


def _rays(xy: Floats) -> Floats:
    return np.column_stack([xy, np.ones(len(xy))])


def _across(direction: Floats) -> Floats:
    """(2, 3): two unit vectors across a direction and each other."""
    first = np.cross(direction, np.eye(3)[int(np.argmin(np.abs(direction)))])
    first = first / np.linalg.norm(first)
    return np.stack([first, np.cross(direction, first)])


def _pose(x: Floats, guess: Pose, axes: Floats) -> Pose:
    direction = guess.p / np.linalg.norm(guess.p) + x[3:] @ axes
    return Pose(rotation_exp(x[:3]) @ guess.R, direction / np.linalg.norm(direction))


def _residuals(T_a_b: Pose, rays_a: Floats, rays_b: Floats, focal_px: float) -> Floats:
    """(N,) px: Sampson's distance of each pair from the epipolar geometry."""
    tx, ty, tz = T_a_b.p
    E = np.array([[0.0, -tz, ty], [tz, 0.0, -tx], [-ty, tx, 0.0]]) @ T_a_b.R
    along_a, along_b = rays_b @ E.T, rays_a @ E
    norm2 = (along_a[:, :2] ** 2).sum(axis=1) + (along_b[:, :2] ** 2).sum(axis=1)
    out: Floats = focal_px * (rays_a * along_a).sum(axis=1) / np.sqrt(np.maximum(norm2, 1e-12))
    return out


def _nearer_px(T_a_b: Pose, rays_a: Floats, rays_b: Floats, focal_px: float) -> Floats:
    """(N,) px: how far each corner of b is from where it would be at infinity, the way that nearer ones go."""
    turned = rays_a @ T_a_b.R
    at_infinity = turned[:, :2] / np.maximum(turned[:, 2:], 1e-3)
    p_b_a = -(T_a_b.R.T @ T_a_b.p)
    way = p_b_a[:2] - at_infinity * p_b_a[2]
    length = np.maximum(np.linalg.norm(way, axis=1), 1e-6)
    out: Floats = focal_px * ((rays_b[:, :2] - at_infinity) * way).sum(axis=1) / length
    return out
