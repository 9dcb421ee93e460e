"""CP edges: points of the road and stations of lanes in the static map, and what they say of the ego (Eqs. 3 and 7).

mapping/landmark_edges.py and mapping/lane_edges.py make the edges. Where X_p of Eq. 3 is, is `LandmarkAnchor`'s choice:
with the window's key node, or in the world since its first sight. docs/method.md has the reasons. Points and their
covariances are complex numbers, as in costs.py.
"""

from __future__ import annotations

import cmath
from dataclasses import dataclass
from itertools import chain

import msgspec
import numpy as np

from birdslam.geometry.arrays import Complexes, Floats, Ints
from birdslam.graph.costs import inflation, point_costs
from birdslam.graph.edges import LARGEST_M
from birdslam.graph.factors.factor import Factor, GraphFrame, Linearised
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.window import EGO_PLACE, KEY_PLACE, Window
from birdslam.types import LandmarkEdge, LandmarkKind

LandmarkKey = tuple[LandmarkKind, int]  # each kind has ids of its own

_NOTHING = 0.0, 0.0, 0.0, 0.0  # of a landmark that shares no error
# What a frame's landmarks share lasts: correlated with itself by .42, .49, .34 from one key frame to the next and by
# .40, .17, .21 to the one after (0005, 0002, 00): in a sum over key frames its variance counts 1 + 2 (r1 + r2) times
SHARED_LASTS = 2.3
_MIN_VARIANCE_M2 = 1e-12  # a landmark without noise must not make the sum singular


@dataclass(slots=True)
class Sightings:
    """The landmarks of one frame: points (N,) in ego, means (N,) and deviators (N,) of their covariances.

    `shared` (2, N): how far 1-sigma of the frame's pitch and of its height moves each, which is in these covariances.
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
    """The CP edges as arrays, each landmark once (the last one counts).

    An edge whose covariance is none (not positive definite), less than what it shares, or whose numbers are no road's
    is left out.
    """
    latest = {(e.kind, e.landmark): e for e in edges}
    keys = list(latest)
    parts = [part for e in latest.values() for part in ((e.x_m, e.y_m), e.cov, e.shared or _NOTHING)]
    table = np.fromiter(chain.from_iterable(parts), np.float64, 10 * len(keys)).reshape(-1, 10)
    if np.abs(table).max(initial=0.0) > LARGEST_M:
        sane = np.abs(table).max(axis=1) <= LARGEST_M
        keys, table = [key for key, keep in zip(keys, sane.tolist(), strict=True) if keep], table[sane]
    x, y, xx, xy, _, yy = table.T[:6]
    shared = table.T[6:8] + 1j * table.T[8:]
    out = Sightings(keys, x + 1j * y, 0.5 * (xx + yy) + _MIN_VARIANCE_M2, 0.5 * (xx - yy) + 1j * xy, shared)
    squares = shared * shared
    own_means = out.means - 0.5 * np.abs(squares).sum(axis=0)
    good = own_means > np.abs(out.deviators - 0.5 * squares.sum(axis=0))
    return out if good.all() else out[np.flatnonzero(good)]


def landmark_residual(points: Complexes, node: complex, heading: complex, anchored: Complexes) -> Complexes:
    """(N,) how much further on, in ego, each landmark says that an ego node is.

    `points` (N,) are where the landmarks are, in ego, `anchored` (N,) the same landmarks as that node saw them, which
    stands at `node` with `heading` in ego.
    """
    return points - node - heading * anchored  # Eq. 3


def sum_of_points(
    residuals: Complexes, means: Floats, deviators: Complexes, shared: Complexes
) -> tuple[complex, float, complex]:
    """N >= 1 unary edges on one translation as one: their centroid weighted by information, and its covariance.

    Where they share nothing it is exact: the sum over p of the costs of t - residual_p, and the cost of t - centroid,
    differ by a constant in t. An error that moves the points by a row of `shared` (K, N) moves the centroid by their
    weighted mean, which no number of points averages away.
    """
    det = means * means - (deviators * deviators.conj()).real
    information, deviation = means / det, -deviators / det
    moment = complex((information * residuals + deviation * residuals.conj()).sum())  # Eq. 7, and its two sums below
    m, d = float(information.sum()), complex(deviation.sum())
    det_sum = m * m - abs(d) ** 2
    centroid = (m * moment - d * moment.conjugate()) / det_sum
    each = information * shared + deviation * shared.conj()
    together = each.sum(axis=1)
    # Of the weighted sum of residuals: m and d, with what is shared added up as a whole in place of point by point
    more = 0.5 * (SHARED_LASTS * np.vdot(together, together).real - np.vdot(each, each).real)
    turned = 0.5 * complex(SHARED_LASTS * (together * together).sum() - (each * each).sum())
    C, D = m / det_sum, -d / det_sum
    spread, skew = C * C + abs(D) ** 2, 2.0 * C * D
    mean = C + spread * more + (skew * turned.conjugate()).real
    return centroid, mean, D + skew * more + C * C * turned + D * D * turned.conjugate()


class LandmarksState(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """All that `LandmarkPoints` keeps; see there."""

    anchored: Sightings
    information: Floats
    moment: Complexes
    frames: Ints
    yaw_rad: float


class LandmarkPoints(Factor):
    """CP edges of the ego to the landmarks of the last frame that had such edges.

    With key_frame as their anchor only key frames have CP edges; with first_sight all frames do.
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
        """No landmarks yet."""
        self._seen: Sightings | None = None  # of the newest frame; None: its CP edges do not count
        self._known_now = np.zeros(0, np.int64), np.zeros(0, np.int64)  # `_known` of these
        self._row: dict[LandmarkKey, int] = {}
        self._anchored = sightings(())  # in the ego of the keyframe, or in world
        # Sums over the frames that each was seen in: information, information times position in world, frames
        self._information = np.zeros(0)
        self._moment = np.zeros(0, dtype=np.complex128)
        self._frames = np.zeros(0, dtype=np.int64)
        self._yaw_rad = 0.0  # of the ego in world by the CC edges alone

    def state(self) -> LandmarksState:
        """The landmarks and where they are."""
        return LandmarksState(
            anchored=self._anchored,
            information=self._information,
            moment=self._moment,
            frames=self._frames,
            yaw_rad=self._yaw_rad,
        )

    def resume(self, state: LandmarksState) -> None:
        """Goes on from there. Raises ValueError where the arrays do not belong together."""
        points = state.anchored
        parts = (points.points, points.means, points.deviators, state.information, state.moment, state.frames)
        if any(len(part) != len(points.keys) for part in parts):
            raise ValueError(f"{len(points.keys)} landmarks with arrays of {[len(part) for part in parts]}")
        self._row = {key: row for row, key in enumerate(points.keys)}
        self._anchored, self._yaw_rad = points, state.yaw_rad
        self._information, self._moment, self._frames = state.information, state.moment, state.frames

    def predict(self, frame: GraphFrame, window: Window) -> None:
        """The ego's heading by the CC edges alone."""
        self._yaw_rad += frame.motion.yaw_rad

    def linearise(self, frame: GraphFrame, window: Window) -> Linearised | None:
        """The frame's edges to known landmarks as one edge on a place: the ego's, or that of the key node.

        A landmark whose squared Mahalanobis distance is past the gate weighs less by the square of the excess. What
        all landmarks of a frame share, their sum does not average away.
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
        # An outlier is one for which the node's own uncertainty does not account either
        (xx, xy), (_, yy) = node_cov.tolist()
        distances = point_costs(residuals, means + 0.5 * (xx + yy), deviators + complex(0.5 * (xx - yy), xy))  # Eq. 5
        if distances.max() > self._gate:
            excess = inflation(distances, self._gate)
            means, deviators, shared = means * excess, deviators * excess, shared * np.sqrt(excess)
        gap, m, d = sum_of_points(residuals, means, deviators, shared)  # Eq. 7
        return Linearised([gap.real, gap.imag], place, np.array([[[m + d.real, d.imag], [d.imag, m - d.real]]]))

    def known_in_ego(self, window: Window) -> tuple[Complexes, Complexes, complex] | None:
        """Of the known landmarks that the newest frame sees: where it sees them (k,), and where they are (k,), in ego.

        Third the heading in ego, a unit number, of what the frame sees. None where none is known. They must be anchored
        in the world.
        """
        if self._seen is None:
            return None
        now, then = self._known_now
        return (self._seen.points[now], *self._in_ego(then, window)) if len(now) else None

    def _in_ego(self, rows: Ints, window: Window) -> tuple[Complexes, complex]:
        """Known landmarks in ego, and the heading there of what a frame sees: that of the CC edges alone."""
        T = window.world
        there = (self._anchored.points[rows] - complex(T.x_m, T.y_m)) * cmath.exp(-1j * T.yaw_rad)
        return there, cmath.exp(1j * (self._yaw_rad - T.yaw_rad))

    def conclude(self, frame: GraphFrame, window: Window) -> None:
        """Anchors the frame's landmarks, now that the ego is corrected.

        A landmark that is out of sight settles: it goes on the map where it was seen in enough frames, at its mean over
        them, weighted by information. A lane's stations do not: their lane is on the map.
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
        """Which of a frame's landmarks are known, and the row where each of these is kept."""
        row = self._row
        rows = np.array([row.get(key, -1) for key in seen.keys], dtype=np.int64)
        now = np.flatnonzero(rows >= 0)
        return now, rows[now]
