"""Joint Kalman filter of a road's lines: cubics in the ego's frame with common parameters and one covariance.

A new line takes the shape of a known one and is correlated with it, so that a hidden line bends with its neighbours.
The ego's motion moves the curves. An update estimates the curves and the pitch error of the image by iteratively
reweighted least squares with the prediction as the prior.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from birdslam.geometry.arrays import Bools, Floats, Ints
from birdslam.geometry.bev import tilted
from birdslam.geometry.camera import PLANE_AT_M, VerticalCurvature
from birdslam.geometry.se2 import SE2
from birdslam.lanes.curves import across_sigma_m, basis, slope_basis, transform_curves
from birdslam.lanes.paint import LinePoints

Ids = Ints

# Prior of a road's shape in the first image around the searched values: offset, heading, curvature and its rate
SIGMA_SHAPE = np.array([0.0, 0.03, 0.004, 2e-4])
# Deviation of one line from the others
SIGMA_OWN = np.array([0.2, 0.04, 5e-4, 1e-5])
SIGMA_OWN_EDGE = np.array([0.3, 0.02, 5e-4, 1e-5])  # of a road's edge: a mask's border is less precise
# Random walks per metre of travel: common to all lines, and of each line
WALK_SHAPE = np.array([0.0, 0.0, 2e-4, 4e-5])
WALK_OWN = np.array([0.008, 8e-4, 3e-5, 2e-6])
RATE_MEMORY_M = 30.0  # decay of a clothoid's rate of curvature
# The clothoid that ends a bend of radius R is R / 9 to R long (RAA: A is R / 3 to R). On R / 3 its rate is 3 / R^2.
# With 2 / R^2 as 1-sigma the random walk is 2 / R^2 sqrt(6 / R) per root metre
WALK_RATE_OF_BEND = 2.0 * 6.0**0.5
# Errors of the ego's motion per metre of travel: lateral and heading
STEP_SIGMAS = np.array([0.005, 0.001, 0.0, 0.0])
BIN_M = 1.0  # points of a line within one bin are one observation
SIGMA_BIN_M = 0.04  # deviation of paint from a smooth curve
MAX_IN_BIN = 3  # points that count as independent
INDEPENDENT_M = 6.0  # images of the same paint have common errors: they are independent after this distance
GATE_SIGMAS, MIN_GATE_M, MAX_GATE_M = 3.0, 0.25, 0.7
KERNEL_SIGMAS = 2.0  # Cauchy
ITERATIONS = 4
# Common parameters, 1-sigma and correlation length: the road's vertical curvature (2 sigma is the crest of 700 m radius
# that is the tightest for 50 km/h), and the error of the odometry's direction of travel
VERTICAL, DIRECTION, COMMON = 0, 1, 2
SIGMA_COMMON = np.array([7e-4, 0.01])
MEMORY_M = np.array([50.0, 40.0])
MIN_FALL = 0.3  # of a level road's: a crest hides what is beyond
MAX_DISTANCE_M, MAX_SLOPE = 40.0, 2.0  # bounds of a line's offset and slope
MAX_PRIOR_VARIANCE_RATIO = 0.9  # of the vertical curvature: above it the curvature was not measured
_CELLS = 1 << 16  # bins of one line, for keys
_JITTER = 1e-9  # regularizes the correlation matrix


@dataclass(frozen=True)
class Support:
    """What an update saw of one line: the occupied bins of `BIN_M` (floor of x) and the indices of its points."""

    bins: Ids
    points: Ids


@dataclass(frozen=True)
class Tilt:
    """Pitch and vertical curvature of the road against the plane with which the points of an image were projected.

    The plane is the one that fits the image of the road at PLANE_AT_M. The road's height over it is
    v x (x - PLANE_AT_M) / 2 (Dickmanns and Mysliwetz 1992), so that pitch and curvature v are nearly uncorrelated.
    """

    pitch_rad: float = 0.0  # > 0: the camera looks lower than assumed, against the road at PLANE_AT_M
    vertical_per_m: float = 0.0  # vertical curvature; > 0: the road rises ahead

    @property
    def tangent_rad(self) -> float:
        """Pitch of the road under the camera."""
        return self.pitch_rad - 0.5 * self.vertical_per_m * PLANE_AT_M

    def applied(self, x_m: Floats, y_m: Floats, height_m: float) -> tuple[Floats, Floats]:
        """Moves points of the plane to the road."""
        return tilted(x_m, y_m, height_m, self.tangent_rad, self.vertical_per_m)


class LineFilter:
    """State: the curves (n, 4), their common parameters (2,) and the covariance (2 + 4 n, 2 + 4 n) of all."""

    def __init__(self) -> None:
        self.curves: Floats = np.zeros((0, 4))
        self.common: Floats = np.zeros(COMMON)
        self.cov: Floats = np.diag(SIGMA_COMMON**2)

    def __len__(self) -> int:
        return len(self.curves)

    @property
    def vertical(self) -> VerticalCurvature | None:
        """The road's vertical curvature measured by the images, without its prior; None if they add too little."""
        variance, before = self.cov[VERTICAL, VERTICAL], SIGMA_COMMON[VERTICAL] ** 2
        if not len(self) or variance > MAX_PRIOR_VARIANCE_RATIO * before:
            return None
        by_images = 1.0 / (1.0 / variance - 1.0 / before)
        return VerticalCurvature(float(self.common[VERTICAL] * by_images / variance), float(np.sqrt(by_images)))

    def block(self, k: int) -> Floats:
        """(4, 4) covariance of one curve."""
        part = slice(COMMON + 4 * k, COMMON + 4 * k + 4)
        return self.cov[part, part]

    def restart(self, offsets_m: Floats, headings: Floats, curvature_per_m: float, edges: Bools) -> None:
        """Initializes the lines (n,) from the search in the first image; `edges` marks road edges."""
        count = len(offsets_m)
        self.curves = np.zeros((count, 4))
        self.curves[:, 0], self.curves[:, 1], self.curves[:, 2] = offsets_m, headings, curvature_per_m
        self.common = np.zeros(COMMON)
        self.cov = np.zeros((COMMON + 4 * count, COMMON + 4 * count))
        self.cov[:COMMON, :COMMON] = np.diag(SIGMA_COMMON**2)
        self.cov[COMMON:, COMMON:] = _expand_variances(SIGMA_SHAPE**2, np.zeros(4), count)
        self.cov[COMMON:, COMMON:] += np.diag(np.where(edges[:, None], SIGMA_OWN_EDGE, SIGMA_OWN).ravel() ** 2)

    def add(self, offset_m: float, heading: float, like: int, edge: bool) -> None:
        """Adds a line with the curvature of line `like`."""
        count = len(self.curves)
        curve = self.curves[like].copy()
        curve[0], curve[1] = offset_m, heading
        size, at = COMMON + 4 * count, COMMON + 4 * like
        rows = np.vstack([np.eye(size), np.eye(size)[at : at + 4]])
        rows[size, :] = 0.0  # the offset is independent
        self.cov = rows @ self.cov @ rows.T
        self.cov[size:, size:] += np.diag((SIGMA_OWN_EDGE if edge else SIGMA_OWN) ** 2)
        self.curves = np.vstack([self.curves, curve])

    def keep(self, kept: Ids) -> None:
        """Keeps these lines and drops the others."""
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
        self.curves, blocks = transform_curves(self.curves, step)
        for k, block in enumerate(blocks):
            at = COMMON + 4 * k
            J[at : at + 4, at : at + 4] = block
            J[at, DIRECTION] = -step_m
        keep, decay = np.exp(-step_m / RATE_MEMORY_M), np.exp(-step_m / MEMORY_M)
        J[COMMON + 3 :: 4] *= keep
        self.curves[:, 3] *= keep
        J[:COMMON, :COMMON] = np.diag(decay)
        self.common = decay * self.common
        self.cov = J @ self.cov @ J.T
        self.cov[:COMMON, :COMMON] += np.diag((1.0 - decay**2) * SIGMA_COMMON**2)
        shape = WALK_SHAPE**2
        shape[3] += (WALK_RATE_OF_BEND * abs(float(self.curves[:, 2].mean())) ** 2.5) ** 2
        own = _expand_variances(shape + STEP_SIGMAS**2, WALK_OWN**2, count)
        self.cov[COMMON:, COMMON:] += own * step_m

    def valid_lines(self) -> Bools:
        """(n,) whether each curve is plausible; all False if the covariance is invalid."""
        variances = self.cov.diagonal()
        if not (np.isfinite(self.cov).all() and np.all(variances > 0.0)):
            return np.zeros(len(self.curves), bool)
        near = (np.abs(self.curves[:, 0]) < MAX_DISTANCE_M) & (np.abs(self.curves[:, 1]) < MAX_SLOPE)
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
        """Corrects the lines by points of their own class: `of` (N,) of the points, `classes` (n,) of the lines.

        Returns the support of each line and the road's tilt against the plane of the points. Road edges (classes above
        0) do not measure the tilt, since masks widen and narrow for other reasons. `level`: the pitch is unknown, so
        the road is assumed to be a plane and edges measure the tilt too.
        """
        count = len(self.curves)
        prior = np.zeros((COMMON + 4 * count + 1, COMMON + 4 * count + 1))
        scale = np.sqrt(self.cov.diagonal())  # the units differ by orders of magnitude: invert the correlation matrix
        correlated = self.cov / np.outer(scale, scale) + _JITTER * np.eye(len(scale))
        prior[:-1, :-1] = np.linalg.inv(correlated) / np.outer(scale, scale)
        prior[-1, -1] = 1.0 / max(sigma_tilt_rad, 1e-5) ** 2
        mean = np.concatenate([self.common, self.curves.ravel(), [0.0]])
        state = mean.copy()
        state[-1] = first_tilt_rad  # the curves of the first image were found with this tilt
        information, owner = prior, np.zeros(0, np.int64)
        x = points.x_m
        inflation = max(1.0, INDEPENDENT_M / max(travelled_m, 0.5))
        for _ in range(ITERATIONS):
            curves, tilt = state[COMMON:-1].reshape(count, 4), Tilt(float(state[-1]), float(state[VERTICAL]))
            x, y = tilt.applied(points.x_m, points.y_m, height_m)
            by_ray = _ray_derivatives(x, curves, _ray_slopes(x, height_m, tilt.vertical_per_m))
            sigma = np.hypot(points.sigma_m[:, None], by_ray * points.sigma_ray_rad[:, None])
            owner = self._assign_points(x, y, points, sigma, curves, of, classes)
            measures_tilt = (classes == 0) | level
            H, r, variance = _bin_observations(x, y, points.weight, owner, curves, measures_tilt, by_ray, sigma)
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

    def _assign_points(
        self, x: Floats, y: Floats, points: LinePoints, sigma: Floats, curves: Floats, of: Ids, classes: Ids
    ) -> Ints:
        """(N,) the line of each point, -1: none. Only one point of a row belongs to a line.

        Points inside the network's mask come first, then the nearest: kerbstones, joints and rails run beside paint.
        """
        at = basis(x)
        gap = np.abs(y[:, None] - at @ curves.T)
        blocks = np.stack([self.block(k) for k in range(len(curves))])
        spread = np.sqrt(np.maximum(((at @ blocks) * at).sum(axis=2), 0.0)).T
        gate = np.clip(GATE_SIGMAS * np.hypot(spread, sigma), MIN_GATE_M, MAX_GATE_M)
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


def _ray_slopes(x_m: Floats, height_m: float, vertical_per_m: float) -> Floats:
    """(N,) slope between the camera's ray and the road at x (N,)."""
    level = height_m / x_m
    out: Floats = np.maximum(level + 0.5 * vertical_per_m * x_m, MIN_FALL * level)
    return out


def _ray_derivatives(x: Floats, curves: Floats, fall: Floats) -> Floats:
    """(N, n) lateral shift of points against each curve per unit of the slope of their rays.

    `fall` (N,) is the slope between the rays and the road. The points are taken on the curves: with their measured y
    the derivative is correlated with the residual, which biases the pitch.
    """
    out: Floats = ((slope_basis(x) * x[:, None] - basis(x)) @ curves.T) / fall[:, None]
    return out


def _bin_observations(
    x: Floats,
    y: Floats,
    weight: Floats,
    owner: Ids,
    curves: Floats,
    measures_tilt: Bools,
    by_ray: Floats,
    sigma: Floats,
) -> tuple[Floats, Floats, Floats]:
    """Returns one observation per metre of a line: H (B, 2 + 4 n + 1), residuals (B,) and variances (B,).

    `measures_tilt` (n,) marks the lines that measure the tilt; `by_ray`, `sigma` (N, n) are of each point and line.
    """
    on = np.flatnonzero(owner >= 0)
    line, x, y = owner[on], x[on], y[on]
    sigma = sigma[on, line]
    key, index = np.unique(line * _CELLS + np.floor(x / BIN_M).astype(np.int64) % _CELLS, return_inverse=True)
    counts = np.bincount(index, minlength=len(key))
    weight = weight[on] / sigma**2
    total = np.bincount(index, weight, len(key))
    residual = y - (basis(x) * curves[line]).sum(axis=1)
    by_tilt = np.where(measures_tilt[line], by_ray[on, line], 0.0)
    x_bin, r, tilt = (np.bincount(index, weight * value, len(key)) / total for value in (x, residual, by_tilt))
    variance = np.bincount(index, sigma**2, len(key)) / counts / np.minimum(counts, MAX_IN_BIN) + SIGMA_BIN_M**2
    H = np.zeros((len(key), COMMON + 4 * len(curves) + 1))
    column = COMMON + 4 * (key // _CELLS)
    H[np.arange(len(key))[:, None], column[:, None] + np.arange(4)] = basis(x_bin)
    H[:, VERTICAL], H[:, -1] = -0.5 * tilt * (x_bin - PLANE_AT_M), -tilt
    return H, r, variance


def _expand_variances(common: Floats, own: Floats, count: int) -> Floats:
    """(4 n, 4 n) covariance with variances (4,) common to all lines and variances (4,) of each line."""
    out: Floats = np.kron(np.ones((count, count)), np.diag(common)) + np.kron(np.eye(count), np.diag(own))
    return out
