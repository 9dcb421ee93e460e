"""The joint Kalman filter of a road's lines: cubics in the ego's frame that share what a road's lines share.

State: the curves (a, h, c, d) of all lines, with one covariance. A line is born with the shape of those that are known,
and correlated with it, and a road's bend moves all of them together: so a line that a car hides bends with its
neighbours. The ego's motion moves the curves, so that paint seen at 10 m is map at 2 m later. An update solves for all
curves and for the error of the camera's pitch in this image, which all points have in common, by iteratively reweighted
least squares with the prediction as a prior.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from birdslam.geometry.arrays import Bools, Floats, Ints
from birdslam.geometry.se2 import SE2
from birdslam.lanes.curves import across_sigma_m, basis, moved, slope_basis
from birdslam.lanes.paint import LinePoints
from birdslam.lanes.road_view import tilted

Ids = Ints

# Prior of a road's shape in an image without a past: heading, curvature, its rate, beside what the search has found
SIGMA_SHAPE = np.array([0.0, 0.03, 0.004, 2e-4])
# ... and of one line against the others
SIGMA_OWN = np.array([0.2, 0.04, 2e-3, 3e-5])
SIGMA_OWN_EDGE = np.array([0.3, 0.02, 5e-4, 1e-5])  # of a road's edge: a mask's border wanders more than the road's
# Random walks in a metre of travel, of all lines together and of each
WALK_SHAPE = np.array([0.0, 0.0, 2e-4, 4e-5])
WALK_OWN = np.array([0.008, 8e-4, 3e-5, 2e-6])
RATE_MEMORY_M = 30.0  # a clothoid's rate of curvature dies away over so much travel
# Errors of the ego's motion in a metre of travel, sideways and in heading
STEP_SIGMA_M, STEP_SIGMA_RAD = 0.005, 0.001
BIN_M = 1.0  # of a line: its points are one observation
SIGMA_BIN_M = 0.04  # of paint about a smooth curve
MOST_IN_BIN = 3  # points that count as independent
INDEPENDENT_M = 6.0  # images of the same paint err alike: so much travel makes them independent
GATE_SIGMAS, LEAST_GATE_M, WIDEST_GATE_M = 3.0, 0.25, 0.7
KERNEL_SIGMAS = 2.0  # Cauchy
ITERATIONS = 4
FARTHEST_M, STEEPEST = 40.0, 2.0  # of a line's offset and slope: what is beyond has got lost
_CELLS = 1 << 16  # bins of one line, for keys
_JITTER = 1e-9  # of a correlation


@dataclass(frozen=True)
class Support:
    """What an update saw of one line: which bins of `BIN_M` (floor of x), and the points by their index."""

    bins: Ids
    points: Ids


class LineFilter:
    """The curves' means (n, 4) and their covariance (4 n, 4 n)."""

    def __init__(self) -> None:
        self.curves: Floats = np.zeros((0, 4))
        self.cov: Floats = np.zeros((0, 0))

    def __len__(self) -> int:
        return len(self.curves)

    def block(self, k: int) -> Floats:
        """(4, 4) covariance of one curve."""
        part = slice(4 * k, 4 * k + 4)
        return self.cov[part, part]

    def begin(self, offsets_m: Floats, headings: Floats, curvature_per_m: float, edges: Bools) -> None:
        """Lines (n,) of an image without a past, by what the search has found; `edges` are those of the road."""
        count = len(offsets_m)
        self.curves = np.zeros((count, 4))
        self.curves[:, 0], self.curves[:, 1], self.curves[:, 2] = offsets_m, headings, curvature_per_m
        self.cov = _together(SIGMA_SHAPE**2, np.zeros(4), count)
        self.cov += np.diag(np.where(edges[:, None], SIGMA_OWN_EDGE, SIGMA_OWN).ravel() ** 2)

    def add(self, offset_m: float, heading: float, like: int, edge: bool) -> None:
        """A further line, with the bend of the line `like`."""
        count = len(self.curves)
        curve = self.curves[like].copy()
        curve[0], curve[1] = offset_m, heading
        rows = np.vstack([np.eye(4 * count), np.eye(4 * count)[4 * like : 4 * like + 4]])
        rows[4 * count, :] = 0.0  # its offset is its own
        self.cov = rows @ self.cov @ rows.T
        self.cov[4 * count :, 4 * count :] += np.diag((SIGMA_OWN_EDGE if edge else SIGMA_OWN) ** 2)
        self.curves = np.vstack([self.curves, curve])

    def keep(self, kept: Ids) -> None:
        """Drops the other lines."""
        rows = (4 * np.asarray(kept, dtype=np.int64)[:, None] + np.arange(4)).ravel()
        self.curves, self.cov = self.curves[kept], self.cov[np.ix_(rows, rows)]

    def predict(self, T_old_new: SE2) -> None:
        """Moves the curves to the ego's new frame."""
        count = len(self.curves)
        if not count:
            return
        step_m = float(np.hypot(T_old_new.x_m, T_old_new.y_m))
        J = np.zeros((4 * count, 4 * count))
        keep = np.exp(-step_m / RATE_MEMORY_M)
        sideways = np.tile([-1.0, 0.0, 0.0, 0.0], count)
        turned = np.tile([0.0, -1.0, 0.0, 0.0], count)
        self.curves, blocks = moved(self.curves, T_old_new)
        for k, block in enumerate(blocks):
            J[4 * k : 4 * k + 4, 4 * k : 4 * k + 4] = block
        J[3::4] *= keep
        self.curves[:, 3] *= keep
        self.cov = J @ self.cov @ J.T + _together(WALK_SHAPE**2 * step_m, WALK_OWN**2 * step_m, count)
        self.cov += np.outer(sideways, sideways) * STEP_SIGMA_M**2 * step_m
        self.cov += np.outer(turned, turned) * STEP_SIGMA_RAD**2 * step_m

    def sound(self) -> Bools:
        """(n,) which curves are those of a line still; none where the covariance is not."""
        variances = self.cov.diagonal()
        if not (np.isfinite(self.cov).all() and np.all(variances > 0.0)):
            return np.zeros(len(self.curves), bool)
        near = (np.abs(self.curves[:, 0]) < FARTHEST_M) & (np.abs(self.curves[:, 1]) < STEEPEST)
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
    ) -> tuple[list[Support], float]:
        """Lines by the points of their own class: `of` (N,) that of the points, `classes` (n,) that of the lines.

        Returns what was seen of each line, and the tilt of the camera against the pitch that the points were made with.
        """
        count = len(self.curves)
        size = 4 * count + 1
        prior = np.zeros((size, size))
        scale = np.sqrt(self.cov.diagonal())  # metres beside 1e-5 / m^2: inverted as correlations
        correlated = self.cov / np.outer(scale, scale) + _JITTER * np.eye(4 * count)
        prior[:-1, :-1] = np.linalg.inv(correlated) / np.outer(scale, scale)
        prior[-1, -1] = 1.0 / max(sigma_tilt_rad, 1e-5) ** 2
        mean = np.concatenate([self.curves.ravel(), [0.0]])
        state = mean.copy()
        state[-1] = first_tilt_rad  # the curves of an image without a past are those of this tilt
        information, owner = prior, np.zeros(0, np.int64)
        x = points.x_m
        inflation = max(1.0, INDEPENDENT_M / max(travelled_m, 0.5))
        for _ in range(ITERATIONS):
            curves, tilt = state[:-1].reshape(count, 4), float(state[-1])
            x, y = tilted(points.x_m, points.y_m, height_m, tilt)
            owner = self._owners(x, y, points, curves, of, classes)
            H, r, variance = _bins(x, y, points, owner, curves, height_m)
            robust = 1.0 / (1.0 + r**2 / variance / KERNEL_SIGMAS**2)
            scaled = H * (robust / (variance * inflation))[:, None]
            information = prior + scaled.T @ H
            state = state + np.linalg.solve(information, prior @ (mean - state) + scaled.T @ r)
        cells = np.floor(x / BIN_M).astype(np.int64)
        seen = [Support(np.unique(cells[owner == k]), np.flatnonzero(owner == k)) for k in range(count)]
        cov = np.linalg.inv(information)
        self.curves = state[:-1].reshape(count, 4)
        self.cov = 0.5 * (cov + cov.T)[:-1, :-1]
        return seen, float(state[-1])

    def _owners(self, x: Floats, y: Floats, points: LinePoints, curves: Floats, of: Ids, classes: Ids) -> Ints:
        """(N,) the line that each point is on, -1: none. Of two ridges of a row one alone is the line.

        It is the one that a network's mask has, and of such the nearest: kerbstones, joints and rails run beside paint.
        """
        at = basis(x)
        gap = np.abs(y[:, None] - at @ curves.T)
        blocks = np.stack([self.block(k) for k in range(len(curves))])
        spread = np.sqrt(np.maximum(((at @ blocks) * at).sum(axis=2), 0.0)).T
        gate = np.clip(GATE_SIGMAS * np.hypot(spread, points.sigma_m[:, None]), LEAST_GATE_M, WIDEST_GATE_M)
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


def _bins(
    x: Floats, y: Floats, points: LinePoints, owner: Ids, curves: Floats, height_m: float
) -> tuple[Floats, Floats, Floats]:
    """The observations, one for a metre of a line: H (B, 4 n + 1), residuals (B,) and variances (B,)."""
    on = np.flatnonzero(owner >= 0)
    line, x, y, sigma = owner[on], x[on], y[on], points.sigma_m[on]
    key, index = np.unique(line * _CELLS + np.floor(x / BIN_M).astype(np.int64) % _CELLS, return_inverse=True)
    counts = np.bincount(index, minlength=len(key))
    weight = points.weight[on] / sigma**2
    total = np.bincount(index, weight, len(key))
    at, curve = basis(x), curves[line]
    residual = y - (at * curve).sum(axis=1)
    slope = (slope_basis(x) * curve).sum(axis=1)
    by_tilt = (slope * x - y) * x / height_m
    x_bin, r, tilt = (np.bincount(index, weight * value, len(key)) / total for value in (x, residual, by_tilt))
    variance = np.bincount(index, sigma**2, len(key)) / counts / np.minimum(counts, MOST_IN_BIN) + SIGMA_BIN_M**2
    H = np.zeros((len(key), 4 * len(curves) + 1))
    column = 4 * (key // _CELLS)
    H[np.arange(len(key))[:, None], column[:, None] + np.arange(4)] = basis(x_bin)
    H[:, -1] = -tilt
    return H, r, variance


def _together(common: Floats, own: Floats, count: int) -> Floats:
    """(4 n, 4 n) variances (4,) that all lines have in common, and that each has for itself."""
    out: Floats = np.kron(np.ones((count, count)), np.diag(common)) + np.kron(np.eye(count), np.diag(own))
    return out
