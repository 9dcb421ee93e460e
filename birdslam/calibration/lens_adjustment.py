"""Bundle adjustment of short windows with shared focal length, distortion and readout time.

Normal equations are reduced by the corners and by the poses of each window (Schur complement). Each corner is observed
at the time of its row (Hedborg et al., CVPR 2012).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.pose import rotation_exp, rotation_log

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

IMAGES = 6  # per window
SIGMA_K1 = 0.3  # prior: dashboard cameras have -0.4 to 0
FIXED_SIGMA = 1e-6  # 1-sigma of a fixed parameter
SHARED = 3  # number of parameters common to all windows
_HUBER = 1.5  # sigmas
_ITERATIONS = 30
_CONVERGED = 1e-6  # relative change of the cost
_MIN_CORNERS = 8  # min. corners of a window, whose poses have 30 parameters
_MIN_INTERVAL_S = 1e-3  # min. interval between two images
_MIN_DISTANCE, _BEHIND_COST = 1e-3, 1e3  # min. depth of a corner; cost of a corner behind the camera


@dataclass(frozen=True)
class LensProblem:
    """P corners, each of a window w, observed at px (P, IMAGES, 2) from the image centre, with initial values."""

    px: Floats
    row: Floats  # (P, IMAGES) row of the observation: -0.5 first, 0.5 last
    of: Ints  # (P,) window of each corner
    t_s: Floats  # (W, IMAGES) readout time of the middle row of each image
    R: Floats  # (W, IMAGES, 3, 3) from the window's first camera to each
    t: Floats  # (W, IMAGES, 3)
    corner: Floats  # (P, 3) x / z, y / z, 1 / z in the window's first camera
    log_focal: float
    k1: float
    sigma_px: float  # of a corner; proportional to the image resolution
    fisheye: bool = False  # equidistant: the radius is proportional to the angle from the axis
    k1_prior: tuple[float, float] = (0.0, SIGMA_K1)  # prior of k1 with its 1-sigma
    readout_s: float = 0.0  # from the first row to the last
    readout_prior: tuple[float, float] = (0.0, FIXED_SIGMA)  # prior of it with its 1-sigma

    @property
    def shared(self) -> Floats:
        """(3,) parameters common to all windows: k1, log of the focal length, readout in s."""
        return np.array([self.k1, self.log_focal, self.readout_s])


@dataclass(frozen=True)
class FocalPrior:
    """Prior of the log of the focal length with its 1-sigma."""

    log_focal: float
    sigma: float


def set_focal_length(problem: LensProblem, log_focal: float) -> LensProblem:
    """Changes the focal length: lateral lengths and rotations scale inversely, depths stay."""
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
        k1_prior=(problem.k1_prior[0] / by**2, problem.k1_prior[1]),
        log_focal=log_focal,
    )


def select_corners(problem: LensProblem, some: NDArray[np.bool_]) -> LensProblem:
    """The problem with a subset (P,) of the corners; drops windows with too few."""
    left = np.bincount(problem.of[some], minlength=len(problem.R))
    some = some & (left >= _MIN_CORNERS)[problem.of]
    windows = np.unique(problem.of[some])
    return replace(
        problem,
        px=problem.px[some],
        row=problem.row[some],
        of=np.searchsorted(windows, problem.of[some]),
        t_s=problem.t_s[windows],
        R=problem.R[windows],
        t=problem.t[windows],
        corner=problem.corner[some],
    )


def adjust(problem: LensProblem, prior: FocalPrior | None = None, converged: float = _CONVERGED) -> LensProblem:
    """Levenberg-Marquardt on robust reprojection errors; without a prior the focal length is fixed.

    Stops when a step lowers the cost by less than the fraction `converged`.
    """
    damping = 1e-4
    cost, system = _linearise(problem, prior)
    for _ in range(_ITERATIONS):
        tried = _apply_step(problem, *_solve(system, damping))
        new_cost, new_system = _linearise(tried, prior)
        if not new_cost < cost:
            damping *= 10.0
            if damping > 1e3:
                break
            continue
        settled = cost - new_cost < converged * cost
        problem, cost, system, damping = tried, new_cost, new_system, max(0.2 * damping, 1e-9)
        if settled:
            break
    return problem


def robust_cost(problem: LensProblem, prior: FocalPrior) -> float:
    """The cost that `adjust` minimizes."""
    return _linearise(problem, prior)[0]


def step_shared(problem: LensProblem, prior: FocalPrior | None) -> tuple[Floats, Floats]:
    """`LensProblem.shared` after one Gauss-Newton step, and its information (3, 3)."""
    system = _linearise(problem, prior)[1]
    information, gradient, *_ = _reduce(system, 0.0)
    return problem.shared - np.linalg.solve(information, gradient), information


@dataclass(frozen=True)
class _System:
    """Normal equations of the corners and of each window's poses with the lens last, V = 6 (IMAGES - 1) + SHARED."""

    of: Ints  # (P,) window of each corner
    corner: Floats  # (P, 3, 3)
    corner_by_view: Floats  # (P, 3, V)
    view: Floats  # (W, V, V)
    corner_gradient: Floats  # (P, 3)
    view_gradient: Floats  # (W, V)
    prior: Floats  # (3, 3) information of the lens prior
    prior_gradient: Floats  # (3,)


def _project(problem: LensProblem) -> tuple[Floats, Floats, Floats, Floats]:
    """Projects the corners.

    Returns the rays rotated into each image (P, I, 3), positions q (P, I, 3) at the readout of each row, normalised
    coordinates u (P, I, 2), and the derivative of q by the readout (P, I, 3).
    """
    rays = np.concatenate([problem.corner[:, :2], np.ones((len(problem.corner), 1))], axis=1)
    turned = np.einsum("pikl,pl->pik", problem.R[problem.of], rays)
    q = turned + problem.corner[:, 2, None, None] * problem.t[problem.of]
    turn, shift = (rate[problem.of] for rate in _motion_rates(problem))
    by_readout = problem.row[..., None] * (np.cross(turn, q) + problem.corner[:, 2, None, None] * shift)
    q = q + problem.readout_s * by_readout
    u = q[..., :2] / np.maximum(q[..., 2:], _MIN_DISTANCE)
    return turned, q, u, by_readout


def _motion_rates(problem: LensProblem) -> tuple[Floats, Floats]:
    """Angular rate (rad/s) and velocity (1/s) of the world in the axes of each image: (W, IMAGES, 3) each.

    By central differences; rotations between images are small enough for their sine.
    """
    R, t = problem.R, problem.t
    step = R[:, 1:] @ R[:, :-1].transpose(0, 1, 3, 2)
    dt_s = np.maximum(np.diff(problem.t_s), _MIN_INTERVAL_S)[..., None]
    turn = 0.5 * np.stack([step[..., b, a] - step[..., a, b] for a, b in ((1, 2), (2, 0), (0, 1))], axis=-1) / dt_s
    shift = (t[:, 1:] - np.einsum("wkij,wkj->wki", step, t[:, :-1])) / dt_s
    turn, shift = (np.concatenate([x[:, :1], 0.5 * (x[:, 1:] + x[:, :-1]), x[:, -1:]], axis=1) for x in (turn, shift))
    return turn, shift


def _distort(problem: LensProblem, u: Floats) -> tuple[Floats, Floats, Floats]:
    """Distorts normalised coordinates u (..., 2) to d (..., 2); also returns the derivatives by u and by k1.

    d = u (1 + k1 r^2) with r = |u|; for a fisheye u / r theta (1 + k1 theta^2) with theta = atan r.
    """
    r = np.maximum(np.sqrt(np.square(u).sum(axis=-1, keepdims=True)), 1e-9)
    angle, angle_r = (np.arctan(r), 1.0 / (1.0 + r**2)) if problem.fisheye else (r, np.ones_like(r))
    along = u / r
    grows = angle * (1.0 + problem.k1 * angle**2) / r
    d_r = (1.0 + 3.0 * problem.k1 * angle**2) * angle_r
    d_u = grows[..., None] * np.eye(2) + (d_r - grows)[..., None] * along[..., :, None] * along[..., None, :]
    return grows * u, d_u, angle**3 * along


def _huber(problem: LensProblem, q: Floats, d: Floats) -> tuple[Floats, Floats, Floats]:
    """Residuals in sigmas (P, I, 2), their weights and costs (P, I)."""
    r = (math.exp(problem.log_focal) * d - problem.px) / problem.sigma_px
    norm = np.sqrt(np.square(r).sum(axis=-1))
    ahead = q[..., 2] > _MIN_DISTANCE
    weight = np.where(ahead, 1.0 / np.maximum(1.0, norm / _HUBER), 0.0)
    cost = np.where(norm < _HUBER, 0.5 * norm**2, _HUBER * norm - 0.5 * _HUBER**2)
    return r, weight, np.where(ahead, cost, _BEHIND_COST)


def _linearise(problem: LensProblem, prior: FocalPrior | None) -> tuple[float, _System]:
    """The cost and the normal equations at the current values."""
    prior = prior or FocalPrior(problem.log_focal, FIXED_SIGMA)
    turned, q, u, q_readout = _project(problem)
    d, d_u, d_k1 = _distort(problem, u)
    r, weight, each = _huber(problem, q, d)
    focal_px, sigma_px = math.exp(problem.log_focal), problem.sigma_px
    k1, sigma_k1 = problem.k1_prior
    readout_s, sigma_s = problem.readout_prior
    known = np.array([k1, prior.log_focal, readout_s]), np.array([sigma_k1, prior.sigma, sigma_s]) ** -2.0
    away = problem.shared - known[0]
    cost = float(each.sum()) + 0.5 * float(known[1] @ away**2)

    u_q = np.concatenate([np.broadcast_to(np.eye(2), (*u.shape, 2)), -u[..., None]], axis=-1)
    J_q = (focal_px / sigma_px) * (d_u @ u_q) / np.maximum(q[..., 2], _MIN_DISTANCE)[..., None, None]  # (P, I, 2, 3)
    J_corner = np.concatenate(
        [
            np.einsum("pick,pikl->picl", J_q, problem.R[problem.of][..., :2]),
            np.einsum("pick,pik->pic", J_q, problem.t[problem.of])[..., None],
        ],
        axis=-1,
    )
    J_turn = np.cross(turned[:, :, None, :], J_q)  # d q / d w = -[turned]x
    J_pose = np.concatenate([J_turn, J_q * problem.corner[:, 2, None, None, None]], axis=-1)[:, 1:]
    J_readout = np.einsum("pick,pik->pic", J_q, q_readout)
    J_lens = np.concatenate([focal_px / sigma_px * np.stack([d_k1, d], axis=-1), J_readout[..., None]], axis=-1)

    P, poses = len(r), 6 * (IMAGES - 1)
    by_image = np.zeros((P, IMAGES, 2, poses + SHARED))
    for k in range(1, IMAGES):
        by_image[:, k, :, 6 * (k - 1) : 6 * k] = J_pose[:, k - 1]
    by_image[..., poses:] = J_lens
    J_view, J_corner, r = (x.reshape(P, 2 * IMAGES, -1) for x in (by_image, J_corner, r))
    w = np.repeat(weight, 2, axis=1)[..., None]
    weighed = J_view * w
    view = _sum_by_window(problem.of, weighed, J_view)
    gradient = _sum_by_window(problem.of, weighed, r)[..., 0]
    # A window has its own scale: its last image's distance is fixed
    last = slice(poses - 3, poses)
    for k, way in enumerate(problem.t[:, -1]):
        view[k, last, last] += 1e4 * np.outer(way, way) / float(way @ way)
    view += 1e-3 * np.eye(poses + SHARED)  # only matters if all corners of a window are outliers
    corner = (J_corner * w).transpose(0, 2, 1) @ J_corner + 1e-6 * np.eye(3)
    return cost, _System(
        of=problem.of,
        corner=corner,
        corner_by_view=J_corner.transpose(0, 2, 1) @ weighed,
        view=view,
        corner_gradient=np.einsum("pni,pn->pi", J_corner * w, r[..., 0]),
        view_gradient=gradient,
        prior=np.diag(known[1]),
        prior_gradient=known[1] * away,
    )


def _sum_by_window(of: Ints, a: Floats, b: Floats) -> Floats:
    """Sum of a_p' b_p over the corners p of each window: (W, V, N) from (P, M, V) and (P, M, N)."""
    ends = np.flatnonzero(np.diff(of)) + 1  # corners are ordered by window
    parts = zip(np.split(a, ends), np.split(b, ends), strict=True)
    return np.stack([x.reshape(-1, x.shape[-1]).T @ y.reshape(-1, y.shape[-1]) for x, y in parts])


def _reduce(system: _System, damping: float) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Eliminates the corners (Schur complement), then the poses of each window.

    Returns information (3, 3) and gradient (3,) of the lens; dependence of the poses on it (W, V - 3, 3) and their
    solution without it (W, V - 3); inverses of the corners' blocks (P, 3, 3).
    """
    inverse = np.asarray(np.linalg.inv(system.corner * (1.0 + damping * np.eye(3))), np.float64)
    part = inverse @ system.corner_by_view
    view = system.view * (1.0 + damping * np.eye(system.view.shape[-1]))
    view = view - _sum_by_window(system.of, system.corner_by_view, part)
    gradient = system.view_gradient - _sum_by_window(system.of, part, system.corner_gradient[..., None])[..., 0]
    poses, lens = slice(None, -SHARED), slice(-SHARED, None)
    solved = np.linalg.solve(view[:, poses, poses], np.concatenate([view[:, poses, lens], gradient[:, poses, None]], 2))
    by_lens, alone = solved[..., :SHARED], solved[..., SHARED]
    information = np.asarray(
        (view[:, lens, lens] - view[:, lens, poses] @ by_lens).sum(axis=0) + system.prior, np.float64
    )
    of_lens = gradient[:, lens] - np.einsum("wij,wj->wi", view[:, lens, poses], alone)
    return information, of_lens.sum(axis=0) + system.prior_gradient, by_lens, alone, inverse


def _solve(system: _System, damping: float) -> tuple[Floats, Floats, Floats]:
    """Steps of the poses (W, IMAGES - 1, 6), of the lens (3,) and of the corners (P, 3)."""
    information, gradient, by_lens, alone, inverse = _reduce(system, damping)
    lens = np.asarray(-np.linalg.solve(information, gradient), np.float64)
    poses = np.asarray(-alone - by_lens @ lens, np.float64)
    windows = len(poses)
    steps = np.concatenate([poses, np.tile(lens, (windows, 1))], axis=1)[system.of]
    corner = -np.einsum(
        "pij,pj->pi", inverse, system.corner_gradient + np.einsum("pij,pj->pi", system.corner_by_view, steps)
    )
    return poses.reshape(windows, IMAGES - 1, 6), lens, corner


def _apply_step(problem: LensProblem, poses: Floats, lens: Floats, corner: Floats) -> LensProblem:
    R, t = problem.R.copy(), problem.t.copy()
    t[:, 1:] += poses[..., 3:]
    for window, steps in zip(R, poses, strict=True):
        for k, step in enumerate(steps, start=1):
            window[k] = rotation_exp(step[:3]) @ window[k]
    moved = problem.corner + corner
    moved[:, 2] = np.maximum(moved[:, 2], 0.0)
    k1, log_focal, readout_s = problem.shared + np.clip(lens, -0.2, 0.2)
    return replace(
        problem, R=R, t=t, corner=moved, k1=float(k1), log_focal=float(log_focal), readout_s=float(readout_s)
    )
