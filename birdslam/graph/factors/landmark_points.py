"""CP edges: the ego observes road points and lane stations of the static map (Eqs. 3 and 7).

mapping/landmark_edges.py and mapping/lane_edges.py create the edges. `LandmarkAnchor` selects the frame of X_p in
Eq. 3: the window's key node, or the world since the first observation (docs/method.md). Points and their covariances
are complex numbers, as in costs.py.
"""

from __future__ import annotations

import cmath
from dataclasses import dataclass
from itertools import chain

import msgspec
import numpy as np

from birdslam.geometry.arrays import Complexes, Floats, Ints
from birdslam.graph.costs import inflation, point_costs
from birdslam.graph.edges import MAX_M
from birdslam.graph.factors.factor import Factor, GraphFrame, Linearised
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.window import EGO_PLACE, KEY_PLACE, Window
from birdslam.types import LandmarkEdge, LandmarkKind

LandmarkKey = tuple[LandmarkKind, int]  # each kind has ids of its own

_NOTHING = 0.0, 0.0, 0.0, 0.0  # of a landmark without shared error
# The shared error of a frame's landmarks is correlated between key frames: 1 + 2 (r1 + r2) with the autocorrelations
# r1, r2 to the next two key frames
SHARED_VARIANCE_RATIO = 2.3
_MIN_VARIANCE_M2 = 1e-12  # keeps the sum regular for a landmark without noise


@dataclass(slots=True)
class Sightings:
    """The landmarks of one frame: points (N,) in ego, means (N,) and deviators (N,) of their covariances.

    `shared` (2, N): shift of each by 1-sigma of the frame's pitch and of its height; the covariances include it.
    """

    keys: list[LandmarkKey]
    points: Complexes
    means: Floats
    deviators: Complexes
    shared: Complexes

    def __getitem__(self, rows: Ints | slice) -> Sightings:
        keys = self.keys[rows] if isinstance(rows, slice) else [self.keys[i] for i in rows.tolist()]
        return Sightings(keys, self.points[rows], self.means[rows], self.deviators[rows], self.shared[:, rows])


def sightings(edges: tuple[LandmarkEdge, ...]) -> Sightings:
    """The CP edges as arrays, each landmark once (the last edge counts).

    Skips edges with a covariance that is not positive definite or less than its shared part, and implausible positions.
    """
    latest = {(e.kind, e.landmark): e for e in edges}
    keys = list(latest)
    parts = [part for e in latest.values() for part in ((e.x_m, e.y_m), e.cov, e.shared or _NOTHING)]
    table = np.fromiter(chain.from_iterable(parts), np.float64, 10 * len(keys)).reshape(-1, 10)
    if np.abs(table).max(initial=0.0) > MAX_M:
        sane = np.abs(table).max(axis=1) <= MAX_M
        keys, table = [key for key, keep in zip(keys, sane.tolist(), strict=True) if keep], table[sane]
    x, y, xx, xy, _, yy = table.T[:6]
    shared = table.T[6:8] + 1j * table.T[8:]
    out = Sightings(keys, x + 1j * y, 0.5 * (xx + yy) + _MIN_VARIANCE_M2, 0.5 * (xx - yy) + 1j * xy, shared)
    squares = shared * shared
    own_means = out.means - 0.5 * np.abs(squares).sum(axis=0)
    good = own_means > np.abs(out.deviators - 0.5 * squares.sum(axis=0))
    return out if good.all() else out[np.flatnonzero(good)]


def landmark_residual(points: Complexes, node: complex, heading: complex, anchored: Complexes) -> Complexes:
    """Residuals (N,) of Eq. 3 in ego: the displacement of an ego node that each landmark implies.

    `points` (N,) are the landmarks in ego, `anchored` (N,) the same landmarks in the node's frame; `node` and `heading`
    are the node's pose in ego.
    """
    return points - node - heading * anchored  # Eq. 3


def sum_of_points(
    residuals: Complexes, means: Floats, deviators: Complexes, shared: Complexes
) -> tuple[complex, float, complex]:
    """Combines N >= 1 unary edges on one translation: their information-weighted centroid and its covariance.

    Exact without shared errors: the sum over p of the costs of t - residual_p and the cost of t - centroid differ by a
    constant in t. An error that moves the points by a row of `shared` (K, N) moves the centroid by their weighted mean,
    however many points there are.
    """
    det = means * means - (deviators * deviators.conj()).real
    information, deviation = means / det, -deviators / det
    moment = complex((information * residuals + deviation * residuals.conj()).sum())  # Eq. 7, and its two sums below
    m, d = float(information.sum()), complex(deviation.sum())
    det_sum = m * m - abs(d) ** 2
    centroid = (m * moment - d * moment.conjugate()) / det_sum
    each = information * shared + deviation * shared.conj()
    together = each.sum(axis=1)
    # m and d of the weighted sum of residuals; the shared part is summed before it is squared
    more = 0.5 * (SHARED_VARIANCE_RATIO * np.vdot(together, together).real - np.vdot(each, each).real)
    turned = 0.5 * complex(SHARED_VARIANCE_RATIO * (together * together).sum() - (each * each).sum())
    C, D = m / det_sum, -d / det_sum
    spread, skew = C * C + abs(D) ** 2, 2.0 * C * D
    mean = C + spread * more + (skew * turned.conjugate()).real
    return centroid, mean, D + skew * more + C * C * turned + D * D * turned.conjugate()


class LandmarksState(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The state of `LandmarkPoints`."""

    anchored: Sightings
    information: Floats
    moment: Complexes
    frames: Ints
    yaw_rad: float


class LandmarkPoints(Factor):
    """CP edges from the ego to known landmarks.

    With the anchor key_frame only key frames have CP edges; with first_sight all frames do.
    """

    name = "CP"
    equation = "Eqs. 3 and 7"
    state_type = LandmarksState

    def __init__(self, config: GraphConfig) -> None:
        self._capacity = config.max_landmarks
        self._in_world = config.landmark_anchor == "first_sight"
        self._gate = config.landmark_gate_sigma**2
        self._least_frames = config.landmark_least_frames
        self.begin()

    def __len__(self) -> int:
        return len(self._row)

    def begin(self) -> None:
        """Clears the landmarks."""
        self._seen: Sightings | None = None  # of the newest frame; None: its CP edges are not used
        self._known_now = np.zeros(0, np.int64), np.zeros(0, np.int64)  # `_known` of these
        self._row: dict[LandmarkKey, int] = {}
        self._anchored = sightings(())  # in the ego of the keyframe, or in world
        # Sums over the frames with each landmark: information, information times position in world, count
        self._information = np.zeros(0)
        self._moment = np.zeros(0, dtype=np.complex128)
        self._frames = np.zeros(0, dtype=np.int64)
        self._yaw_rad = 0.0  # of the ego in world by the CC edges alone

    def state(self) -> LandmarksState:
        """The landmarks and their positions."""
        return LandmarksState(
            anchored=self._anchored,
            information=self._information,
            moment=self._moment,
            frames=self._frames,
            yaw_rad=self._yaw_rad,
        )

    def resume(self, state: LandmarksState) -> None:
        """Restores the state. Raises ValueError if the arrays are inconsistent."""
        points = state.anchored
        parts = (points.points, points.means, points.deviators, state.information, state.moment, state.frames)
        if any(len(part) != len(points.keys) for part in parts):
            raise ValueError(f"{len(points.keys)} landmarks with arrays of {[len(part) for part in parts]}")
        self._row = {key: row for row, key in enumerate(points.keys)}
        self._anchored, self._yaw_rad = points, state.yaw_rad
        self._information, self._moment, self._frames = state.information, state.moment, state.frames

    def predict(self, frame: GraphFrame, window: Window) -> None:
        """Integrates the ego's heading from CC edges only."""
        self._yaw_rad += frame.motion.yaw_rad

    def linearise(self, frame: GraphFrame, window: Window) -> Linearised | None:
        """The frame's edges to known landmarks as one edge on the position of the ego or of the key node.

        A landmark with a squared Mahalanobis distance beyond the gate is down-weighted by the square of the excess. The
        shared error of a frame's landmarks does not average out.
        """
        seen = self._seen = sightings(frame.measurements.cp) if self._in_world or window.is_keyframe else None
        if seen is None:
            return None
        now, then = self._known_now = self._known(seen)
        if not len(now):
            return None
        points, means, deviators, shared = seen.points[now], seen.means[now], seen.deviators[now], seen.shared[:, now]
        if self._in_world:
            place, node_cov = EGO_PLACE, window.ego_cov[:2, :2]
            there, off = self._in_ego(then, window)
            residuals = landmark_residual(there, 0.0, off, points)  # Eq. 3
        else:
            place = KEY_PLACE
            node, heading, node_cov = window.key_node()
            residuals = landmark_residual(points, node, heading, self._anchored.points[then])  # Eq. 3
            means = means + self._anchored.means[then]
            deviators = deviators + heading * heading * self._anchored.deviators[then]
            shared = np.concatenate([shared, heading * self._anchored.shared[:, then]])
        # The test for outliers includes the node's own uncertainty
        (xx, xy), (_, yy) = node_cov.tolist()
        distances = point_costs(residuals, means + 0.5 * (xx + yy), deviators + complex(0.5 * (xx - yy), xy))  # Eq. 5
        if distances.max() > self._gate:
            excess = inflation(distances, self._gate)
            means, deviators, shared = means * excess, deviators * excess, shared * np.sqrt(excess)
        gap, m, d = sum_of_points(residuals, means, deviators, shared)  # Eq. 7
        return Linearised([gap.real, gap.imag], place, np.array([[[m + d.real, d.imag], [d.imag, m - d.real]]]))

    def known_in_ego(self, window: Window) -> tuple[Complexes, Complexes, complex] | None:
        """The observed (k,) and the known (k,) positions in ego of the newest frame's known landmarks, and a heading.

        The heading in ego, a unit number, is that of the observations. None without known landmarks. Needs landmarks
        that are anchored in the world.
        """
        if self._seen is None:
            return None
        now, then = self._known_now
        return (self._seen.points[now], *self._in_ego(then, window)) if len(now) else None

    def _in_ego(self, rows: Ints, window: Window) -> tuple[Complexes, complex]:
        """Known landmarks in ego, and the heading of a frame's observations there, from CC edges only."""
        T = window.world
        there = (self._anchored.points[rows] - complex(T.x_m, T.y_m)) * cmath.exp(-1j * T.yaw_rad)
        return there, cmath.exp(1j * (self._yaw_rad - T.yaw_rad))

    def conclude(self, frame: GraphFrame, window: Window) -> None:
        """Anchors the frame's landmarks at the corrected ego pose.

        A landmark out of sight is added to the map at its information-weighted mean, if it was observed in enough
        frames. Lane stations are not added, since the map has their lane.
        """
        if self._seen is None:
            return
        seen, (old, before) = self._seen, self._known_now
        if len(seen.keys) > self._capacity:
            seen = seen[: self._capacity]
            old, before = self._known(seen)
        out_of_sight = np.ones(len(self._frames), np.bool_)
        out_of_sight[before] = False
        settles = np.flatnonzero(out_of_sight & (self._frames >= self._least_frames)).tolist()
        gone = [row for row in settles if self._anchored.keys[row][0] is LandmarkKind.ROAD_POINT]
        if gone:
            frame.settled = [(p.real, p.imag) for p in (self._moment[gone] / self._information[gone]).tolist()]

        T = window.world
        information = 1.0 / seen.means
        at = complex(T.x_m, T.y_m)
        moment = information * (at + seen.points * cmath.exp(1j * T.yaw_rad))
        if self._in_world:
            places = at + seen.points * cmath.exp(1j * self._yaw_rad)
            places[old] = self._anchored.points[before]
            seen = Sightings(seen.keys, places, seen.means, seen.deviators, seen.shared)
        frames = np.ones(len(seen.keys), dtype=np.int64)
        for sums, so_far in ((information, self._information), (moment, self._moment), (frames, self._frames)):
            sums[old] += so_far[before]
        self._information, self._moment, self._frames = information, moment, frames
        self._row = {key: row for row, key in enumerate(seen.keys)}
        self._anchored = seen

    def _known(self, seen: Sightings) -> tuple[Ints, Ints]:
        """Indices of a frame's landmarks that are known, and their rows in the state."""
        row = self._row
        rows = np.array([row.get(key, -1) for key in seen.keys], dtype=np.int64)
        now = np.flatnonzero(rows >= 0)
        return now, rows[now]
