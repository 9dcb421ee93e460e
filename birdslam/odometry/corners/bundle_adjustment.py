"""Bundle adjustment of the sliding window: keyframe poses and inverse depths of landmarks.

Gauss-Newton on robust reprojection errors in pixels. A landmark has one parameter, so that the Schur complement divides
by scalars. Arrays are (F keyframes, M landmarks); missing observations and those of the anchor have weight 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.pose import Pose, orthonormal, rotation_exp
from birdslam.odometry.corners.sliding_window import MIN_DEPTH, SlidingWindow

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

_MIN_LANDMARKS = 8
_HUBER_SIGMA = 1.5
_CONVERGED = 1e-5
_POSITION_PRIOR_SIGMA_RATIO = 0.1


def adjust(window: SlidingWindow, iterations: int, max_landmarks: int, prior: Floats) -> None:
    """Adjusts all poses of the window but the oldest, and the `max_landmarks` landmarks with most observations.

    `prior` (6,) is the information of each pose (translation, rotation vector) about its previous estimate. It fixes
    the gauge freedom of the scale by the mean of all poses; fixing two poses would give it the error of one short
    baseline. A position from the velocity prior gets _POSITION_PRIOR_SIGMA_RATIO of its sigma, since it includes the
    images.
    """
    problem = _select(window, max_landmarks)
    if problem is None:
        return
    free = len(window.poses) - 1
    priors = np.tile(prior, (free, 1))
    priors[:, :3] += 1.0 / np.square(_POSITION_PRIOR_SIGMA_RATIO * np.array(window.predicted_sigma_m[1:]))[:, None]
    total = np.zeros((free, 6))  # sum of the steps (translation, rotation vector), in window axes
    rho = window.rho[problem.landmarks].copy()
    for k in range(iterations):
        residuals = _reproject(window, problem, rho, outlier_factor=2.0 if k == 0 else 1.0)
        normal = _normal_equations(problem, residuals, rho)
        pose_steps, rho_steps = _solve(normal, priors, total)
        if not np.isfinite(pose_steps).all():
            return
        rho = np.maximum(rho - rho_steps, 0.0)
        for at, (T, by) in enumerate(zip(window.poses[1:], pose_steps, strict=True), start=1):
            window.poses[at] = Pose(rotation_exp(by[3:]) @ T.R, T.p + by[:3])
        total += pose_steps
        if np.abs(pose_steps).max() < _CONVERGED:
            break
    _write_back(window, problem, residuals, normal, rho)


@dataclass(frozen=True)
class _Problem:
    """The adjusted landmarks, sorted by anchor, and their observations."""

    landmarks: Ints  # (M,) indices in the window
    anchor: Ints  # (M,) ascending
    groups: list[slice]  # the landmarks of each anchor
    rays: Floats  # (3, M) observations by the anchors
    observed: Bools  # (F, M) by keyframes other than the anchor
    target: Floats  # (F, 2, M) normalised coordinates
    J_anchor: Floats  # (F, 6, 2, M) buffer: whitened derivatives by the anchor's pose


@dataclass(frozen=True)
class _Residuals:
    """Reprojection errors of all observations and their geometry."""

    rays_window: Floats  # (3, M) in window axes
    to_anchor: Floats  # (F, 3, M) from each keyframe to the anchor
    norm: Floats  # (F, M) in sigma
    whitened: Floats  # (F, 2, M)
    E: Floats  # (F, 3, 2, M) whitened derivative of both coordinates by the landmark in window axes


@dataclass(frozen=True)
class _NormalEquations:
    """J^T J and J^T r over all poses but the oldest (6 each) and the inverse depths."""

    A: Floats  # (F, 6, F, 6) poses by poses
    B: Floats  # (M, 6 (F - 1)) depths by poses
    C: Floats  # (M,) diagonal of the depths
    g: Floats  # (F, 6)
    g_rho: Floats  # (M,)


def _select(window: SlidingWindow, max_landmarks: int) -> _Problem | None:
    """Selects the landmarks with most observations; None if there are too few."""
    anchor = window.anchors()
    count = np.isfinite(window.obs[..., 0]).sum(axis=0)
    usable = np.isfinite(window.rho) & (count >= 2)
    F = len(window.poses)
    if usable.sum() < _MIN_LANDMARKS or F < 2:
        return None
    chosen = np.flatnonzero(usable)
    if len(chosen) > max_landmarks:
        chosen = np.sort(chosen[np.argsort(-count[chosen], kind="stable")][:max_landmarks])
    chosen = chosen[np.argsort(anchor[chosen], kind="stable")]
    anchor, xy = anchor[chosen], window.obs.take(chosen, axis=1)
    observed = np.isfinite(xy[..., 0]) & (np.arange(F)[:, None] != anchor[None])
    return _Problem(
        landmarks=chosen,
        anchor=anchor,
        groups=[slice(*np.searchsorted(anchor, [i, i + 1])) for i in range(F)],
        rays=np.concatenate([window.xy_of(anchor, chosen).T, np.ones((1, len(chosen)))]),
        observed=observed,
        target=np.where(observed[:, None], xy.transpose(0, 2, 1), 0.0),
        J_anchor=np.empty((F, 6, 2, len(chosen))),
    )


def _reproject(window: SlidingWindow, problem: _Problem, rho: Floats, outlier_factor: float) -> _Residuals:
    """Errors of all observations; the weight is 0 beyond `outlier_factor` times the window's outlier threshold."""
    R, p = window.stacked()
    f, sigma_px = window.focal_px, window.sigma_px
    rays_window = np.concatenate([R[i] @ problem.rays[:, of] for i, of in enumerate(problem.groups)], axis=1)
    to_anchor = (p.T - p[:, :, None]).take(problem.anchor, axis=2)
    c = rays_window + rho * to_anchor
    q = R.transpose(0, 2, 1) @ c
    ahead = q[:, 2] > MIN_DEPTH
    z = np.where(ahead, q[:, 2], 1.0)
    uv = q[:, :2] / z[:, None]
    r = (uv - problem.target) * f
    norm = np.sqrt((r**2).sum(axis=1)) / sigma_px
    inlier = problem.observed & ahead & (norm < window.reject_px / sigma_px * outlier_factor)
    w = np.where(inlier, 1.0 / np.maximum(1.0, norm / _HUBER_SIGMA), 0.0) / sigma_px**2
    sw = np.sqrt(w)
    E = (R[:, :, :2, None] - R[:, :, 2, None, None] * uv[:, None]) * (f * sw / z)[:, None, None]
    return _Residuals(rays_window, to_anchor, norm, r * sw[:, None], E)


def _normal_equations(problem: _Problem, residuals: _Residuals, rho: Floats) -> _NormalEquations:
    """Linearises the problem.

    The derivative of a residual by the observing pose is -L times that by the anchor's pose, with L = [I 0; [b]x I] and
    the baseline b. L is the same for all landmarks of an anchor, so that only products of the anchor's derivatives are
    summed over landmarks.
    """
    F, anchor = len(problem.groups), problem.anchor
    E, J_anchor, rw = residuals.E, problem.J_anchor, residuals.whitened
    J_rho = (E * residuals.to_anchor[:, :, None]).sum(axis=1)  # (F, 2, M)
    np.multiply(E, rho, out=J_anchor[:, :3])
    _cross(residuals.rays_window[None, :, None], E, J_anchor[:, 3:])

    N, n = np.zeros((F, F, 6, 6)), np.zeros((F, F, 6))  # J J^T and J r, (anchor, observer)
    L = np.zeros((F, F, 6, 6))
    L[..., range(6), range(6)] = 1.0
    for i, of in enumerate(problem.groups):
        if of.start == of.stop:
            continue
        of_i = J_anchor[..., of].reshape(F, 6, -1)
        N[i] = of_i @ of_i.transpose(0, 2, 1)
        n[i] = (of_i @ rw[..., of].reshape(F, -1, 1))[..., 0]
        x, y, z = residuals.to_anchor[:, :, of.start].T
        L[i, :, 3, 1], L[i, :, 3, 2], L[i, :, 4, 2] = -z, y, -x
        L[i, :, 4, 0], L[i, :, 5, 0], L[i, :, 5, 1] = z, -y, x
    mixed = -N @ L.swapaxes(2, 3)  # 0 where the observer is the anchor
    A = mixed.transpose(0, 2, 1, 3) + mixed.transpose(1, 3, 0, 2)
    A[range(F), :, range(F)] += N.sum(axis=1) - (L @ mixed).sum(axis=0)
    g = n.sum(axis=1) - (L @ n[..., None])[..., 0].sum(axis=0)

    by_depth = J_rho[:, None, 0] * J_anchor[:, :, 0] + J_rho[:, None, 1] * J_anchor[:, :, 1]  # (F, 6, M)
    B = np.empty_like(by_depth)
    np.negative(by_depth[:, :3], out=B[:, :3])
    _cross(by_depth[:, :3], residuals.to_anchor, B[:, 3:])
    B[:, 3:] -= by_depth[:, 3:]
    B[anchor, :, np.arange(len(anchor))] += by_depth.sum(axis=0).T
    B = B[1:].reshape(6 * (F - 1), -1).T
    C = (J_rho**2).sum(axis=(0, 1)) + 1e-6
    return _NormalEquations(A, B, C, g, (J_rho * rw).sum(axis=(0, 1)))


def _solve(normal: _NormalEquations, priors: Floats, total: Floats) -> tuple[Floats, Floats]:
    """Steps of all poses but the oldest (F - 1, 6), and steps of the inverse depths (M,), to be subtracted.

    `priors` (F - 1, 6) is the information of the poses. The depths are eliminated by the Schur complement.
    """
    free, B, C = len(total), normal.B, normal.C
    A = normal.A[1:, :, 1:].reshape(6 * free, 6 * free) + np.diag(priors.ravel())
    g = (normal.g[1:] + priors * total).reshape(-1)
    S = A - B.T @ (B / C[:, None])
    step: Floats = np.negative(np.linalg.solve(S, g - B.T @ (normal.g_rho / C)))
    return step.reshape(free, 6), (normal.g_rho + B @ step) / C


def _write_back(
    window: SlidingWindow, problem: _Problem, residuals: _Residuals, normal: _NormalEquations, rho: Floats
) -> None:
    """Writes the result back; resets landmarks with mostly outlier observations to unknown depth."""
    rotations = orthonormal(window.stacked()[0])
    window.poses = [Pose(R, T.p) for R, T in zip(rotations, window.poses, strict=True)]
    window.rho[problem.landmarks] = rho
    window.rho_sigma[problem.landmarks] = 1.0 / np.sqrt(normal.C)
    observed = problem.observed
    inliers = (observed & (residuals.norm < window.reject_px / window.sigma_px)).sum(axis=0)
    window.rho[problem.landmarks[2 * inliers < observed.sum(axis=0)]] = np.nan


def _cross(a: Floats, b: Floats, out: Floats) -> None:
    """Writes a x b along the second axis of (F, 3, ..., M) to `out`."""
    out[:, 0] = a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1]
    out[:, 1] = a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2]
    out[:, 2] = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
