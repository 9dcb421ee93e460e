"""The joint Kalman filter of a road's lines: cubics in the ego's frame that share what a road's lines share.

State: the curves (a, h, c, d) of all lines and what they have in common, with one covariance. A line is born with the
shape of those that are known, and correlated with it, and a road's bend moves all of them together: so a line that a
car hides bends with its neighbours. The ego's motion moves the curves, so that paint seen at 10 m is map at 2 m later.
An update solves for all of it and for the error of the camera's pitch in this image, which all points have in
common, by iteratively reweighted least squares with the prediction as a prior.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from birdslam.geometry.arrays import Bools, Floats, Ints
from birdslam.geometry.bev import tilted
from birdslam.geometry.camera import PLANE_AT_M, VerticalCurvature
from birdslam.geometry.se2 import SE2
from birdslam.lanes.curves import across_sigma_m, basis, moved, slope_basis
from birdslam.lanes.paint import LinePoints

Ids = Ints

# Prior of a road's shape in an image without a past: heading, curvature, its rate, beside what the search has found
SIGMA_SHAPE = np.array([0.0, 0.03, 0.004, 2e-4])
# ... and of one line against the others
SIGMA_OWN = np.array([0.2, 0.04, 5e-4, 1e-5])
SIGMA_OWN_EDGE = np.array([0.3, 0.02, 5e-4, 1e-5])  # of a road's edge: a mask's border wanders more than the road's
# Random walks in a metre of travel, of all lines together and of each
WALK_SHAPE = np.array([0.0, 0.0, 2e-4, 4e-5])
WALK_OWN = np.array([0.008, 8e-4, 3e-5, 2e-6])
RATE_MEMORY_M = 30.0  # a clothoid's rate of curvature dies away over so much travel
# Errors of the ego's motion in a metre of travel, sideways and in heading
STEP_SIGMAS = np.array([0.005, 0.001, 0.0, 0.0])
BIN_M = 1.0  # of a line: its points are one observation
SIGMA_BIN_M = 0.04  # of paint about a smooth curve
MAX_IN_BIN = 3  # points that count as independent
INDEPENDENT_M = 6.0  # images of the same paint err alike: so much travel makes them independent
GATE_SIGMAS, MIN_GATE_M, WIDEST_GATE_M = 3.0, 0.25, 0.7
KERNEL_SIGMAS = 2.0  # Cauchy
ITERATIONS = 4
# What all lines of a road have in common, 1-sigma and the travel over which it lasts: its vertical curvature (the
# tightest crest for 50 km/h, of 700 m radius, is 2 sigma and lasts some 50 m), and the error of the odometry's
# direction of travel (in the mean of a rendered drive 2 to 27 mrad, 11 by RMS; by night 9 tenths of it last over 5 m)
VERTICAL, DIRECTION, COMMON = 0, 1, 2
SIGMA_COMMON = np.array([7e-4, 0.01])
MEMORY_M = np.array([50.0, 40.0])
MIN_FALL = 0.3  # of a level road's: beyond it lies what a crest hides
MAX_DISTANCE_M, STEEPEST = 40.0, 2.0  # of a line's offset and slope: what is beyond has got lost
MAX_OF_PRIOR = 0.9  # of the vertical curvature's variance: what has more left was not measured
_CELLS = 1 << 16  # bins of one line, for keys
_JITTER = 1e-9  # of a correlation


@dataclass(frozen=True)
class Support:
    """What an update saw of one line: which bins of `BIN_M` (floor of x), and the points by their index."""

    bins: Ids
    points: Ids


@dataclass(frozen=True)
class Tilt:
    """How the road of an image lies against the plane that its points were made with.

    Over a crest or through a sag the road leaves that plane, and all lines of an image widen or narrow with the
    distance (Dickmanns and Mysliwetz 1992). The plane is the one that the road's image fits at some PLANE_AT_M, so that
    the road's height over it is v x (x - PLANE_AT_M) / 2: the pitch and the vertical curvature v hardly mix.
    """

    pitch_rad: float = 0.0  # the camera's nose is lower by this amount against the road at PLANE_AT_M
    vertical_per_m: float = 0.0  # vertical curvature; > 0: the road rises ahead

    @property
    def tangent_rad(self) -> float:
        """The same of the road under the camera."""
        return self.pitch_rad - 0.5 * self.vertical_per_m * PLANE_AT_M

    def applied(self, x_m: Floats, y_m: Floats, height_m: float) -> tuple[Floats, Floats]:
        """Where points of the plane lie on the road."""
        return tilted(x_m, y_m, height_m, self.tangent_rad, self.vertical_per_m)


class LineFilter:
    """The curves' means (n, 4), what they have in common (2,), and the covariance (2 + 4 n, 2 + 4 n) of all."""

    def __init__(self) -> None:
        self.curves: Floats = np.zeros((0, 4))
        self.common: Floats = np.zeros(COMMON)
        self.cov: Floats = np.diag(SIGMA_COMMON**2)

    def __len__(self) -> int:
        return len(self.curves)

    @property
    def vertical(self) -> VerticalCurvature | None:
        """The road's vertical curvature by the images alone, without its prior; None where they say next to nothing."""
        variance, before = self.cov[VERTICAL, VERTICAL], SIGMA_COMMON[VERTICAL] ** 2
        if not len(self) or variance > MAX_OF_PRIOR * before:
            return None
        by_images = 1.0 / (1.0 / variance - 1.0 / before)
        return VerticalCurvature(float(self.common[VERTICAL] * by_images / variance), float(np.sqrt(by_images)))

    def block(self, k: int) -> Floats:
        """(4, 4) covariance of one curve."""
        part = slice(COMMON + 4 * k, COMMON + 4 * k + 4)
        return self.cov[part, part]

    def begin(self, offsets_m: Floats, headings: Floats, curvature_per_m: float, edges: Bools) -> None:
        """Lines (n,) of an image without a past, by what the search has found; `edges` are those of the road."""
        count = len(offsets_m)
        self.curves = np.zeros((count, 4))
        self.curves[:, 0], self.curves[:, 1], self.curves[:, 2] = offsets_m, headings, curvature_per_m
        self.common = np.zeros(COMMON)
        self.cov = np.zeros((COMMON + 4 * count, COMMON + 4 * count))
        self.cov[:COMMON, :COMMON] = np.diag(SIGMA_COMMON**2)
        self.cov[COMMON:, COMMON:] = _together(SIGMA_SHAPE**2, np.zeros(4), count)
        self.cov[COMMON:, COMMON:] += np.diag(np.where(edges[:, None], SIGMA_OWN_EDGE, SIGMA_OWN).ravel() ** 2)

    def add(self, offset_m: float, heading: float, like: int, edge: bool) -> None:
        """A further line, with the bend of the line `like`."""
        count = len(self.curves)
        curve = self.curves[like].copy()
        curve[0], curve[1] = offset_m, heading
        size, at = COMMON + 4 * count, COMMON + 4 * like
        rows = np.vstack([np.eye(size), np.eye(size)[at : at + 4]])
        rows[size, :] = 0.0  # its offset is its own
        self.cov = rows @ self.cov @ rows.T
        self.cov[size:, size:] += np.diag((SIGMA_OWN_EDGE if edge else SIGMA_OWN) ** 2)
        self.curves = np.vstack([self.curves, curve])

    def keep(self, kept: Ids) -> None:
        """Drops the other lines."""
        lines = COMMON + 4 * np.asarray(kept, dtype=np.int64)[:, None] + np.arange(4)
        rows = np.concatenate([np.arange(COMMON), lines.ravel()])
        self.curves, self.cov = self.curves[kept], self.cov[np.ix_(rows, rows)]

    def predict(self, T_old_new: SE2) -> None:
        """Moves the curves to the ego's new frame."""
        count = len(self.curves)
        if not count:
            return
        step_m = float(np.hypot(T_old_new.x_m, T_old_new.y_m))
        step = SE2(T_old_new.x_m, T_old_new.y_m + step_m * float(self.common[DIRECTION]), T_old_new.yaw_rad)
        J = np.zeros((COMMON + 4 * count, COMMON + 4 * count))
        self.curves, blocks = moved(self.curves, step)
        for k, block in enumerate(blocks):
            at = COMMON + 4 * k
            J[at : at + 4, at : at + 4] = block
            J[at, DIRECTION] = -step_m
        keep, remains = np.exp(-step_m / RATE_MEMORY_M), np.exp(-step_m / MEMORY_M)
        J[COMMON + 3 :: 4] *= keep
        self.curves[:, 3] *= keep
        J[:COMMON, :COMMON] = np.diag(remains)
        self.common = remains * self.common
        self.cov = J @ self.cov @ J.T
        self.cov[:COMMON, :COMMON] += np.diag((1.0 - remains**2) * SIGMA_COMMON**2)
        own = _together(WALK_SHAPE**2, WALK_OWN**2, count) + _together(STEP_SIGMAS**2, np.zeros(4), count)
        self.cov[COMMON:, COMMON:] += own * step_m

    def sound(self) -> Bools:
        """(n,) which curves are those of a line still; none where the covariance is not."""
        variances = self.cov.diagonal()
        if not (np.isfinite(self.cov).all() and np.all(variances > 0.0)):
            return np.zeros(len(self.curves), bool)
        near = (np.abs(self.curves[:, 0]) < MAX_DISTANCE_M) & (np.abs(self.curves[:, 1]) < STEEPEST)
        out: Bools = np.isfinite(self.curves).all(axis=1) & near
        return out

    def across_sigma_m(self, k: int, x_m: Floats) -> Floats:
        """(N,) 1-sigma of a line's y at x (N,)."""
        return across_sigma_m(basis(x_m), self.block(k))

    def update(
        self,
        points: LinePoints,
        of: Ints,
        classes: Ints,
        height_m: float,
        sigma_tilt_rad: float,
        travelled_m: float,
        first_tilt_rad: float = 0.0,
        level: bool = False,
    ) -> tuple[list[Support], Tilt]:
        """Lines by the points of their own class: `of` (N,) that of the points, `classes` (n,) that of the lines.

        Returns what was seen of each line, and the road's tilt against the plane that the points were made with. The
        road's edges (classes above 0) are no witness of it: a mask's border narrows and widens for its own reasons.
        `level`: of an image whose pitch nobody has measured, which can't tell it from the road's bend, the road is
        taken for a plane, and edges are better than nothing.
        """
        count = len(self.curves)
        prior = np.zeros((COMMON + 4 * count + 1, COMMON + 4 * count + 1))
        scale = np.sqrt(self.cov.diagonal())  # metres beside 1e-5 / m^2: inverted as correlations
        correlated = self.cov / np.outer(scale, scale) + _JITTER * np.eye(len(scale))
        prior[:-1, :-1] = np.linalg.inv(correlated) / np.outer(scale, scale)
        prior[-1, -1] = 1.0 / max(sigma_tilt_rad, 1e-5) ** 2
        mean = np.concatenate([self.common, self.curves.ravel(), [0.0]])
        state = mean.copy()
        state[-1] = first_tilt_rad  # the curves of an image without a past are those of this tilt
        information, owner = prior, np.zeros(0, np.int64)
        x = points.x_m
        inflation = max(1.0, INDEPENDENT_M / max(travelled_m, 0.5))
        for _ in range(ITERATIONS):
            curves, tilt = state[COMMON:-1].reshape(count, 4), Tilt(float(state[-1]), float(state[VERTICAL]))
            x, y = tilt.applied(points.x_m, points.y_m, height_m)
            by_ray = _by_ray(x, y, curves, _fall(x, height_m, tilt.vertical_per_m))
            sigma = np.hypot(points.sigma_m[:, None], by_ray * points.sigma_ray_rad[:, None])
            owner = self._owners(x, y, points, sigma, curves, of, classes)
            witness = (classes == 0) | level
            H, r, variance = _bins(x, y, points.weight, owner, curves, witness, by_ray, sigma)
            H[:, VERTICAL] *= not level
            robust = 1.0 / (1.0 + r**2 / variance / KERNEL_SIGMAS**2)
            scaled = H * (robust / (variance * inflation))[:, None]
            information = prior + scaled.T @ H
            state = state + np.linalg.solve(information, prior @ (mean - state) + scaled.T @ r)
        cells = np.floor(x / BIN_M).astype(np.int64)
        seen = [Support(np.unique(cells[owner == k]), np.flatnonzero(owner == k)) for k in range(count)]
        cov = np.linalg.inv(information)
        self.common, self.curves = state[:COMMON], state[COMMON:-1].reshape(count, 4)
        self.cov = 0.5 * (cov + cov.T)[:-1, :-1]
        return seen, Tilt(float(state[-1]), float(self.common[VERTICAL]))

    def _owners(
        self, x: Floats, y: Floats, points: LinePoints, sigma: Floats, curves: Floats, of: Ids, classes: Ids
    ) -> Ints:
        """(N,) the line that each point is on, -1: none. Of two ridges of a row one alone is the line.

        It is the one that a network's mask has, and of such the nearest: kerbstones, joints and rails run beside paint.
        """
        at = basis(x)
        gap = np.abs(y[:, None] - at @ curves.T)
        blocks = np.stack([self.block(k) for k in range(len(curves))])
        spread = np.sqrt(np.maximum(((at @ blocks) * at).sum(axis=2), 0.0)).T
        gate = np.clip(GATE_SIGMAS * np.hypot(spread, sigma), MIN_GATE_M, WIDEST_GATE_M)
        gap = np.where((gap < gate) & (of[:, None] == classes[None]), gap, np.inf)
        nearest = np.argmin(gap, axis=1)
        off = gap[np.arange(len(x)), nearest]
        order = np.lexsort((off, ~points.masked, points.x_m, nearest))
        order = order[np.isfinite(off[order])]
        of_line, row = nearest[order], points.x_m[order]
        first = np.append(True, (np.diff(of_line) != 0) | (np.diff(row) != 0.0))[: len(order)]
        out = np.full(len(x), -1)
        out[order[first]] = of_line[first]
        return out


def _fall(x_m: Floats, height_m: float, vertical_per_m: float) -> Floats:
    """(N,) how steeply a ray from the camera meets the road at x (N,): at a crest's far end it touches."""
    level = height_m / x_m
    out: Floats = np.maximum(level + 0.5 * vertical_per_m * x_m, MIN_FALL * level)
    return out


def _by_ray(x: Floats, y: Floats, curves: Floats, fall: Floats) -> Floats:
    """(N, n) how far points move across each curve when the slopes of their rays grow: they come nearer, and inwards.

    `fall` (N,) is how steeply the rays meet the road. So a pixel's row is more than its column where lines bend.
    """
    out: Floats = ((slope_basis(x) @ curves.T) * x[:, None] - y[:, None]) / fall[:, None]
    return out


def _bins(
    x: Floats, y: Floats, weight: Floats, owner: Ids, curves: Floats, witness: Bools, by_ray: Floats, sigma: Floats
) -> tuple[Floats, Floats, Floats]:
    """The observations, one for a metre of a line: H (B, 2 + 4 n + 1), residuals (B,) and variances (B,).

    `witness` (n,) are the lines that say how the road lies; `by_ray`, `sigma` (N, n) of each point against each line.
    """
    on = np.flatnonzero(owner >= 0)
    line, x, y = owner[on], x[on], y[on]
    sigma = sigma[on, line]
    key, index = np.unique(line * _CELLS + np.floor(x / BIN_M).astype(np.int64) % _CELLS, return_inverse=True)
    counts = np.bincount(index, minlength=len(key))
    weight = weight[on] / sigma**2
    total = np.bincount(index, weight, len(key))
    residual = y - (basis(x) * curves[line]).sum(axis=1)
    by_tilt = np.where(witness[line], by_ray[on, line], 0.0)
    x_bin, r, tilt = (np.bincount(index, weight * value, len(key)) / total for value in (x, residual, by_tilt))
    variance = np.bincount(index, sigma**2, len(key)) / counts / np.minimum(counts, MAX_IN_BIN) + SIGMA_BIN_M**2
    H = np.zeros((len(key), COMMON + 4 * len(curves) + 1))
    column = COMMON + 4 * (key // _CELLS)
    H[np.arange(len(key))[:, None], column[:, None] + np.arange(4)] = basis(x_bin)
    H[:, VERTICAL], H[:, -1] = -0.5 * tilt * (x_bin - PLANE_AT_M), -tilt
    return H, r, variance


def _together(common: Floats, own: Floats, count: int) -> Floats:
    """(4 n, 4 n) variances (4,) that all lines have in common, and that each has for itself."""
    out: Floats = np.kron(np.ones((count, count)), np.diag(common)) + np.kron(np.eye(count), np.diag(own))
    return out
