"""Bundle adjustment of short windows of images together with the distortion of the lens that they share.

Each corner has three numbers, so that no image's noise is taken for the truth. Normal equations are reduced twice: by
the corners, and by each window's poses, since windows share the distortion alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.pose import rotation_exp, rotation_log

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

IMAGES = 6  # of a window
SIGMA_K1 = 0.3  # beforehand: dashboard cameras have -0.4 to 0
_HUBER = 1.5  # sigmas
_ITERATIONS = 20
_CONVERGED = 1e-6  # relative change of the cost
_NEAREST, _BEHIND_COST = 1e-3, 1e3  # a corner is no nearer; what one behind the camera costs


@dataclass(frozen=True)
class LensProblem:
    """What is adjusted: P corners, each of a window w; observed at px (P, IMAGES, 2), from the image's middle."""

    px: Floats
    of: Ints  # (P,) window of each corner
    R: Floats  # (W, IMAGES, 3, 3) from the window's first camera to each
    t: Floats  # (W, IMAGES, 3)
    corner: Floats  # (P, 3) x / z, y / z, 1 / z in the window's first camera
    log_focal: float
    k1: float
    sigma_px: float  # of a corner: a larger image has it in more pixels, whatever its lens turns out to be


def at_focal_length(problem: LensProblem, log_focal: float) -> LensProblem:
    """The same images by another focal length: lateral lengths and turns are the smaller, depths stay."""
    by = math.exp(problem.log_focal - log_focal)
    R = problem.R.copy()
    for window in R:
        for k in range(1, IMAGES):
            window[k] = rotation_exp(rotation_log(window[k]) * [by, by, 1.0])
    return replace(
        problem,
        R=R,
        t=problem.t * [by, by, 1.0],
        corner=problem.corner * [by, by, 1.0],
        k1=problem.k1 / by**2,
        log_focal=log_focal,
    )


def some_windows(problem: LensProblem, some: NDArray[np.bool_]) -> LensProblem:
    """The problem of some of the windows (W,) alone."""
    corners, number = some[problem.of], np.cumsum(some) - 1
    return replace(
        problem,
        px=problem.px[corners],
        of=number[problem.of[corners]],
        R=problem.R[some],
        t=problem.t[some],
        corner=problem.corner[corners],
    )


def adjust(problem: LensProblem) -> LensProblem:
    """Levenberg-Marquardt on robust reprojection errors, the focal length held."""
    damping = 1e-4
    cost, system = _linearise(problem)
    for _ in range(_ITERATIONS):
        tried = _moved(problem, *_solve(system, damping, len(problem.R)))
        new_cost, new_system = _linearise(tried)
        if not new_cost < cost:
            damping *= 10.0
            if damping > 1e3:
                break
            continue
        settled = cost - new_cost < _CONVERGED * cost
        problem, cost, system, damping = tried, new_cost, new_system, max(0.2 * damping, 1e-9)
        if settled:
            break
    return problem


@dataclass(frozen=True)
class _System:
    """Normal equations of the corners, and of each window's poses with k1 last, V = 6 (IMAGES - 1) + 1."""

    of: Ints  # (P,) window of each corner
    corner: Floats  # (P, 3, 3)
    corner_by_view: Floats  # (P, 3, V)
    view: Floats  # (W, V, V)
    corner_gradient: Floats  # (P, 3)
    view_gradient: Floats  # (W, V)
    k1_gradient: float  # of what is known of k1 beforehand


def _project(problem: LensProblem) -> tuple[Floats, Floats, Floats, Floats]:
    """Rays turned into each image (P, I, 3), places q (P, I, 3), normalised coordinates u and distorted d (P, I, 2)."""
    rays = np.concatenate([problem.corner[:, :2], np.ones((len(problem.corner), 1))], axis=1)
    turned = np.einsum("pikl,pl->pik", problem.R[problem.of], rays)
    q = turned + problem.corner[:, 2, None, None] * problem.t[problem.of]
    u = q[..., :2] / np.maximum(q[..., 2:], _NEAREST)
    return turned, q, u, u * (1.0 + problem.k1 * np.square(u).sum(axis=-1, keepdims=True))


def _huber(problem: LensProblem, q: Floats, d: Floats) -> tuple[Floats, Floats, Floats]:
    """Residuals in sigma (P, I, 2), their weights and costs (P, I)."""
    r = (math.exp(problem.log_focal) * d - problem.px) / problem.sigma_px
    norm = np.sqrt(np.square(r).sum(axis=-1))
    ahead = q[..., 2] > _NEAREST
    weight = np.where(ahead, 1.0 / np.maximum(1.0, norm / _HUBER), 0.0)
    cost = np.where(norm < _HUBER, 0.5 * norm**2, _HUBER * norm - 0.5 * _HUBER**2)
    return r, weight, np.where(ahead, cost, _BEHIND_COST)


def costs(problem: LensProblem) -> Floats:
    """(W,) what each window costs."""
    _, q, _, d = _project(problem)
    return np.asarray(np.bincount(problem.of, _huber(problem, q, d)[2].sum(axis=1), len(problem.R)), np.float64)


def _linearise(problem: LensProblem) -> tuple[float, _System]:
    """The cost and the normal equations at the present values."""
    turned, q, u, d = _project(problem)
    r, weight, each = _huber(problem, q, d)
    focal_px, sigma_px = math.exp(problem.log_focal), problem.sigma_px
    cost = float(each.sum()) + 0.5 * (problem.k1 / SIGMA_K1) ** 2

    r2 = np.square(u).sum(axis=-1)[..., None, None]
    d_u = (1.0 + problem.k1 * r2) * np.eye(2) + 2.0 * problem.k1 * u[..., :, None] * u[..., None, :]
    u_q = np.concatenate([np.broadcast_to(np.eye(2), (*u.shape, 2)), -u[..., None]], axis=-1)
    J_q = (focal_px / sigma_px) * (d_u @ u_q) / np.maximum(q[..., 2], _NEAREST)[..., None, None]  # (P, I, 2, 3)
    J_corner = np.concatenate(
        [
            np.einsum("pick,pikl->picl", J_q, problem.R[problem.of][..., :2]),
            np.einsum("pick,pik->pic", J_q, problem.t[problem.of])[..., None],
        ],
        axis=-1,
    )
    J_turn = np.cross(turned[:, :, None, :], J_q)  # d q / d w = -[turned]x
    J_pose = np.concatenate([J_turn, J_q * problem.corner[:, 2, None, None, None]], axis=-1)[:, 1:]
    J_k1 = focal_px / sigma_px * u * r2[..., 0]

    P, poses = len(r), 6 * (IMAGES - 1)
    by_image = np.zeros((P, IMAGES, 2, poses + 1))
    for k in range(1, IMAGES):
        by_image[:, k, :, 6 * (k - 1) : 6 * k] = J_pose[:, k - 1]
    by_image[..., poses] = J_k1
    J_view, J_corner, r = (x.reshape(P, 2 * IMAGES, -1) for x in (by_image, J_corner, r))
    w = np.repeat(weight, 2, axis=1)[..., None]
    by_view = (J_view * w).transpose(0, 2, 1) @ J_view
    begin = np.flatnonzero(np.diff(problem.of, prepend=-1))  # corners of one window stand together
    view = np.add.reduceat(by_view, begin, axis=0)
    gradient = np.add.reduceat(np.einsum("pni,pn->pi", J_view * w, r[..., 0]), begin, axis=0)
    # A window's unit of length is its own: the way to its last image is held where it is
    last = slice(poses - 3, poses)
    for k, way in enumerate(problem.t[:, -1]):
        view[k, last, last] += 1e4 * np.outer(way, way) / float(way @ way)
    corner = (J_corner * w).transpose(0, 2, 1) @ J_corner + 1e-6 * np.eye(3)
    return cost, _System(
        of=problem.of,
        corner=corner,
        corner_by_view=(J_corner * w).transpose(0, 2, 1) @ J_view,
        view=view,
        corner_gradient=np.einsum("pni,pn->pi", J_corner * w, r[..., 0]),
        view_gradient=gradient,
        k1_gradient=problem.k1 / SIGMA_K1**2,
    )


def _solve(system: _System, damping: float, windows: int) -> tuple[Floats, float, Floats]:
    """Steps of the poses (W, IMAGES - 1, 6), of k1 and of the corners (P, 3), which are eliminated first (Schur)."""
    inverse = np.linalg.inv(system.corner * (1.0 + damping * np.eye(3)))
    part = inverse @ system.corner_by_view
    begin = np.flatnonzero(np.diff(system.of, prepend=-1))
    view = system.view * (1.0 + damping * np.eye(system.view.shape[-1]))
    view = view - np.add.reduceat(system.corner_by_view.transpose(0, 2, 1) @ part, begin, axis=0)
    taken = np.einsum("pij,pi->pj", part, system.corner_gradient)
    gradient = system.view_gradient - np.add.reduceat(taken, begin, axis=0)
    # Windows share k1 alone, so their poses go next, each window's by itself
    solved = np.linalg.solve(view[:, :-1, :-1], np.concatenate([view[:, :-1, -1:], gradient[:, :-1, None]], axis=2))
    by_k1, by_gradient = solved[..., 0], solved[..., 1]
    information = float((view[:, -1, -1] - (view[:, -1, :-1] * by_k1).sum(axis=1)).sum()) + SIGMA_K1**-2.0
    slope = float((gradient[:, -1] - (view[:, -1, :-1] * by_gradient).sum(axis=1)).sum()) + system.k1_gradient
    k1 = -slope / information
    poses = -by_gradient - by_k1 * k1
    steps = np.concatenate([poses, np.full((windows, 1), k1)], axis=1)[system.of]
    corner = -np.einsum(
        "pij,pj->pi", inverse, system.corner_gradient + np.einsum("pij,pj->pi", system.corner_by_view, steps)
    )
    return poses.reshape(windows, IMAGES - 1, 6), k1, corner


def _moved(problem: LensProblem, poses: Floats, k1: float, corner: Floats) -> LensProblem:
    R, t = problem.R.copy(), problem.t.copy()
    t[:, 1:] += poses[..., 3:]
    for window, steps in zip(R, poses, strict=True):
        for k, step in enumerate(steps, start=1):
            window[k] = rotation_exp(step[:3]) @ window[k]
    moved = problem.corner + corner
    moved[:, 2] = np.maximum(moved[:, 2], 0.0)
    return replace(problem, R=R, t=t, corner=moved, k1=problem.k1 + float(np.clip(k1, -0.2, 0.2)))
