"""A lens from the drive alone: focal length and radial distortion, by bundle adjustment of short windows of images.

Two images do not show a lens: its distortion trades against its focal length and the motion. Several do, where corners
pass outwards through the image, and only a camera that turns shows the focal length (Sturm, "Critical motion
sequences", CVPR 1997). So each window has images, corners that all of them show, and poses and corners of its own; the
lens is common to all. The principal point is the image's centre, the pixels are square, higher terms are left out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.pose import rotation_exp, rotation_log

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

IMAGES = 6  # of a window
_STEP_RAD = 0.016  # so far corners have moved from one image of a window to the next: most of them, by _MOVED
_MOVED = 0.6
_MOST_WINDOWS = 40
_LEAST_WINDOWS = 4
_LEAST_CORNERS = 20  # of a window
_MOST_CORNERS = 160
_TWO_VIEW_PX = 1.5  # outliers' limit of the first poses, by pixels of a lens of _FOCAL_PX
_FOCAL_PX = 720.0
_SIGMA_PX = 0.5  # of a corner, by the same pixels
_HUBER = 1.5  # sigmas
_FARTHEST = 80.0  # of a corner that begins the adjustment, in baselines of its window
_ITERATIONS = 20
_CONVERGED = 1e-6  # relative change of the cost
# Focal lengths that are tried, as the log of their ratio to the best one so far; after the first round finer ones
_TRIED_LOG = (np.linspace(-0.4, 0.4, 9), np.linspace(-0.12, 0.12, 7))
_FOLDS = 5  # of the windows, for the sigma
SIGMA_K1 = 0.3  # beforehand: dashboard cameras have -0.4 to 0
LEAST_SIGMA_REL = 0.03  # of the focal length: on 19 real drives the fit's own was up to 26 times too small
LEAST_SIGMA_K1 = 0.01
_NEAREST, _BEHIND_COST = 1e-3, 1e3  # a corner is no nearer; what one behind the camera costs


@dataclass(frozen=True)
class Lens:
    """A lens with square pixels, its principal point in the middle: pixel = focal_px u (1 + k1 |u|^2) + middle.

    `u` are normalised coordinates. `turned_rad` is how far the camera turned within the windows, all together;
    `focal_shown` whether the drive itself says more of the focal length than was known before.
    """

    focal_px: float
    k1: float
    focal_sigma_rel: float
    k1_sigma: float
    windows: int
    corners: int
    turned_rad: float
    focal_shown: bool


@dataclass(frozen=True)
class CornersOfImage:
    """Followed corners of one raw image: ids (N,) ascending, px (N, 2)."""

    ids: Ints
    px: Floats


@dataclass(frozen=True)
class _Window:
    """Corners that all images of one window show, px (IMAGES, N, 2)."""

    px: Floats


@dataclass(frozen=True)
class _Problem:
    """What is adjusted: P corners, each of a window w; observed at px (P, IMAGES, 2), from the image's middle."""

    px: Floats
    of: Ints  # (P,) window of each corner
    R: Floats  # (W, IMAGES, 3, 3) from the window's first camera to each
    t: Floats  # (W, IMAGES, 3)
    corner: Floats  # (P, 3) x / z, y / z, 1 / z in the window's first camera
    log_focal: float
    k1: float
    sigma_px: float  # of a corner: a larger image has it in more pixels, whatever its lens turns out to be


def self_calibrate(
    images: Sequence[CornersOfImage], size_px: tuple[int, int], focal_px: float, focal_sigma_rel: float
) -> Lens | None:
    """The lens that the corners of a drive's raw images show; None where there is too little to see.

    `focal_px` with its 1-sigma is what is known beforehand, by the kind of camera or by its field of view. The focal
    length trades against turns and lateral motion in a narrow valley: so it is tried, and the rest adjusted for each.
    """
    middle = 0.5 * (np.array(size_px, dtype=np.float64) - 1.0)
    windows = _windows(images, middle, focal_px)
    sigma_px = _SIGMA_PX * focal_px / _FOCAL_PX
    log_focal, k1 = math.log(focal_px), 0.0
    fitted: _Problem | None = None
    for tried in _TRIED_LOG:
        begun = _begin(windows, math.exp(log_focal), k1, sigma_px)
        if begun is None:
            return None
        at = log_focal + tried
        profile = _profile(begun, at)
        prior = 0.5 * np.square((at - math.log(focal_px)) / focal_sigma_rel)
        log_focal = _lowest(at, profile.sum(axis=1) + prior)
        fitted = _adjust(_at_focal(begun, log_focal))[0]
        k1 = fitted.k1
    assert fitted is not None
    W = len(fitted.R)
    folds = np.arange(W) % min(_FOLDS, W)
    without = [folds != fold for fold in range(min(_FOLDS, W))]
    logs = [_lowest(at, profile[:, some].sum(axis=1) + prior) for some in without]
    k1s = [_adjust(_some_windows(fitted, some))[0].k1 for some in without]
    curvature = _curvature(at, profile.sum(axis=1) + prior)
    sigma_rel = min(max(LEAST_SIGMA_REL, _jackknife(logs), curvature**-0.5), focal_sigma_rel)
    # What the distortion owes to the focal length: to first order it stays the same in pixels, k1 / focal^2
    k1_sigma = math.hypot(max(LEAST_SIGMA_K1, _jackknife(k1s)), 2.0 * k1 * sigma_rel)
    return Lens(
        focal_px=math.exp(log_focal),
        k1=k1,
        focal_sigma_rel=sigma_rel,
        k1_sigma=min(k1_sigma, SIGMA_K1),
        windows=W,
        corners=len(fitted.px),
        turned_rad=sum(float(np.linalg.norm(rotation_log(R[-1]))) for R in fitted.R),
        focal_shown=sigma_rel < 0.5 * focal_sigma_rel,
    )


def _lowest(at: Floats, cost: Floats) -> float:
    """Where a cost is least, by the parabola through the least of its values and its neighbours; within them."""
    k = int(np.clip(np.argmin(cost), 1, len(at) - 2))
    a, b, _ = np.polyfit(at[k - 1 : k + 2] - at[k], cost[k - 1 : k + 2], 2)
    step = -0.5 * b / a if a > 0.0 else 0.0
    return float(np.clip(at[k] + step, at[0], at[-1]))


def _curvature(at: Floats, cost: Floats) -> float:
    k = int(np.clip(np.argmin(cost), 1, len(at) - 2))
    return max(2.0 * float(np.polyfit(at[k - 1 : k + 2] - at[k], cost[k - 1 : k + 2], 2)[0]), 1e-9)


def _jackknife(values: Sequence[float]) -> float:
    """1-sigma of an estimate by what it is without each fold of the data."""
    n = len(values)
    return math.sqrt((n - 1) / n * float(np.square(np.array(values) - np.mean(values)).sum()))


def _profile(problem: _Problem, log_focals: Floats) -> Floats:
    """(F, W) what each window costs at each focal length, the rest adjusted; from the middle outwards."""
    out = np.zeros((len(log_focals), len(problem.R)))
    middle = len(log_focals) // 2
    for ways in (range(middle, len(log_focals)), range(middle - 1, -1, -1)):
        there = problem
        for k in ways:
            there = _adjust(_at_focal(there, float(log_focals[k])))[0]
            if k == middle:
                problem = there
            out[k] = _costs(there)
    return out


def _at_focal(problem: _Problem, log_focal: float) -> _Problem:
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


def _some_windows(problem: _Problem, some: NDArray[np.bool_]) -> _Problem:
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


# --- windows ---


def _windows(images: Sequence[CornersOfImage], middle: Floats, focal_px: float) -> list[_Window]:
    """Windows of the drive, each of images between which corners have moved by a step."""
    found, first = [], 0
    while first < len(images) - IMAGES:
        at = [first]
        for k in range(first + 1, len(images)):
            moved = _flow_px(images[at[-1]], images[k])
            if len(moved) < _LEAST_CORNERS:
                break
            if np.quantile(moved, 1.0 - _MOVED) > _STEP_RAD * focal_px:
                at.append(k)
            if len(at) == IMAGES:
                break
        if len(at) < IMAGES:
            first += 1
            continue
        window = _common(images, at, middle)
        if window is not None:
            found.append(window)
        first = at[IMAGES // 2]
    keep = np.unique(np.linspace(0, len(found) - 1, min(len(found), _MOST_WINDOWS)).round().astype(int))
    return [found[k] for k in keep]


def _flow_px(a: CornersOfImage, b: CornersOfImage) -> Floats:
    """(N,) how far the corners that both show have moved."""
    _, in_a, in_b = np.intersect1d(a.ids, b.ids, assume_unique=True, return_indices=True)
    out: Floats = np.linalg.norm(b.px[in_b] - a.px[in_a], axis=1)
    return out


def _common(images: Sequence[CornersOfImage], at: Sequence[int], middle: Floats) -> _Window | None:
    ids = images[at[0]].ids
    for k in at[1:]:
        ids = np.intersect1d(ids, images[k].ids, assume_unique=True)
    if len(ids) < _LEAST_CORNERS:
        return None
    if len(ids) > _MOST_CORNERS:  # evenly over their ids, which are those of all parts of the image
        ids = ids[np.linspace(0, len(ids) - 1, _MOST_CORNERS).astype(int)]
    return _Window(np.array([images[k].px[np.searchsorted(images[k].ids, ids)] - middle for k in at]))


def _undistorted(px: Floats, focal_px: float, k1: float) -> Floats:
    """(..., 2) normalised coordinates of pixels from the middle, by fixed-point iteration."""
    distorted = px / focal_px
    out = distorted
    for _ in range(8):
        out = distorted / np.maximum(1.0 + k1 * np.square(out).sum(axis=-1, keepdims=True), 0.3)
    return out


def _begin(windows: Sequence[_Window], focal_px: float, k1: float, sigma_px: float) -> _Problem | None:
    """Poses and corners of each window, by its first and last image and by resection of those between."""
    px, of, R, t, corner = [], [], [], [], []
    for window in windows:
        begun = _begin_window(_undistorted(window.px, focal_px, k1))
        if begun is None:
            continue
        keep, R_w, t_w, corner_w = begun
        px.append(window.px[:, keep].transpose(1, 0, 2))
        of.append(np.full(int(keep.sum()), len(R)))
        R.append(R_w)
        t.append(t_w)
        corner.append(corner_w)
    if len(R) < _LEAST_WINDOWS:
        return None
    return _Problem(
        np.concatenate(px),
        np.concatenate(of),
        np.array(R),
        np.array(t),
        np.concatenate(corner),
        math.log(focal_px),
        k1,
        sigma_px,
    )


def _begin_window(xy: Floats) -> tuple[NDArray[np.bool_], Floats, Floats, Floats] | None:
    """Which corners of (IMAGES, N, 2) normalised coordinates begin, poses of the images, and corners (N', 3)."""
    cv2.setRNGSeed(1)
    first, last = xy[0], xy[-1]
    E, inliers = cv2.findEssentialMat(first, last, np.eye(3), cv2.USAC_MAGSAC, 0.999, _TWO_VIEW_PX / _FOCAL_PX, 500)
    if E is None or E.shape != (3, 3) or inliers is None:
        return None
    _, R, t, _, _ = cv2.recoverPose(E, first, last, cameraMatrix=np.eye(3), distanceThresh=1e5, mask=inliers.copy())
    R, t = np.asarray(R, np.float64), np.asarray(t, np.float64).ravel()
    if abs(t[2]) < 0.5:  # no car's
        return None
    P = np.hstack([R, t[:, None]])
    X = cv2.triangulatePoints(np.eye(3, 4), P, first.T, last.T)
    with np.errstate(divide="ignore", invalid="ignore"):
        X = (X[:3] / X[3]).T
    ahead = (X[:, 2] > 0.1) & (X[:, 2] < _FARTHEST) & ((X @ R.T + t)[:, 2] > 0.1)
    keep = np.asarray((inliers.ravel() > 0) & ahead & np.isfinite(X).all(axis=1))
    if keep.sum() < _LEAST_CORNERS:
        return None
    poses_R, poses_t = [np.eye(3)], [np.zeros(3)]
    for seen in xy[1:-1]:
        found, turn, place, _ = cv2.solvePnPRansac(
            X[keep], seen[keep], np.eye(3), np.zeros(4), reprojectionError=2.0 * _TWO_VIEW_PX / _FOCAL_PX,
            iterationsCount=50,
        )  # fmt: skip
        if not found:
            return None
        poses_R.append(np.asarray(cv2.Rodrigues(turn)[0], np.float64))
        poses_t.append(np.asarray(place, np.float64).ravel())
    by_z = 1.0 / X[keep, 2]
    corner = np.column_stack([X[keep, 0] * by_z, X[keep, 1] * by_z, by_z])
    return keep, np.array([*poses_R, R]), np.array([*poses_t, t]), corner


# --- bundle adjustment ---


def _adjust(problem: _Problem) -> tuple[_Problem, float]:
    """Levenberg-Marquardt on robust reprojection errors, the focal length held; and the cost."""
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
    return problem, cost


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


def _project(problem: _Problem) -> tuple[Floats, Floats, Floats, Floats]:
    """Rays turned into each image (P, I, 3), places q (P, I, 3), normalised coordinates u and distorted d (P, I, 2)."""
    rays = np.concatenate([problem.corner[:, :2], np.ones((len(problem.corner), 1))], axis=1)
    turned = np.einsum("pikl,pl->pik", problem.R[problem.of], rays)
    q = turned + problem.corner[:, 2, None, None] * problem.t[problem.of]
    u = q[..., :2] / np.maximum(q[..., 2:], _NEAREST)
    return turned, q, u, u * (1.0 + problem.k1 * np.square(u).sum(axis=-1, keepdims=True))


def _huber(problem: _Problem, q: Floats, d: Floats) -> tuple[Floats, Floats, Floats]:
    """Residuals in sigma (P, I, 2), their weights and costs (P, I)."""
    r = (math.exp(problem.log_focal) * d - problem.px) / problem.sigma_px
    norm = np.sqrt(np.square(r).sum(axis=-1))
    ahead = q[..., 2] > _NEAREST
    weight = np.where(ahead, 1.0 / np.maximum(1.0, norm / _HUBER), 0.0)
    cost = np.where(norm < _HUBER, 0.5 * norm**2, _HUBER * norm - 0.5 * _HUBER**2)
    return r, weight, np.where(ahead, cost, _BEHIND_COST)


def _costs(problem: _Problem) -> Floats:
    """(W,) what each window costs."""
    _, q, _, d = _project(problem)
    return np.bincount(problem.of, _huber(problem, q, d)[2].sum(axis=1), len(problem.R))


def _linearise(problem: _Problem) -> tuple[float, _System]:
    """The cost and the normal equations at the present values."""
    turned, q, u, d = _project(problem)
    r, weight, costs = _huber(problem, q, d)
    focal_px, sigma_px = math.exp(problem.log_focal), problem.sigma_px
    cost = float(costs.sum()) + 0.5 * (problem.k1 / SIGMA_K1) ** 2

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
    J_view = np.zeros((P, IMAGES, 2, poses + 1))
    for k in range(1, IMAGES):
        J_view[:, k, :, 6 * (k - 1) : 6 * k] = J_pose[:, k - 1]
    J_view[..., poses] = J_k1
    J_view, J_corner, r = (x.reshape(P, 2 * IMAGES, -1) for x in (J_view, J_corner, r))
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


def _moved(problem: _Problem, poses: Floats, k1: float, corner: Floats) -> _Problem:
    R, t = problem.R.copy(), problem.t.copy()
    t[:, 1:] += poses[..., 3:]
    for window, steps in zip(R, poses, strict=True):
        for k, step in enumerate(steps, start=1):
            window[k] = rotation_exp(step[:3]) @ window[k]
    moved = problem.corner + corner
    moved[:, 2] = np.maximum(moved[:, 2], 0.0)
    return replace(problem, R=R, t=t, corner=moved, k1=problem.k1 + float(np.clip(k1, -0.2, 0.2)))
