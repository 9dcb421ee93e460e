"""The static map: landmarks of the road with ids, and what their edges say of the ego (Eqs. 3 and 7).

Points are complex numbers x + iy here, and a covariance [[m + a, b], [b, m - a]] is its mean m and its deviator a + ib:
turning by an angle multiplies a point by e^(i angle) and a deviator by its square, and the inverse is (m, -d) / (m^2 -
|d|^2). That halves the numpy calls of the hot loop.
"""

from __future__ import annotations

import cmath
from collections import deque
from dataclasses import dataclass
from itertools import chain

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.se2 import SE2
from birdslam.graph.edges import LARGEST_M
from birdslam.graph.window import KEY_NODE, Rows, Window
from birdslam.types import LANE_LANDMARKS, LandmarkEdge, LanePoint, MapUpdate

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

_LEAST_VARIANCE_M2 = 1e-12  # a landmark without noise must not make the sum singular


@dataclass(slots=True)
class Sightings:
    """The landmarks of one frame: ids, points (N,) in ego, means (N,) and deviators (N,) of their covariances."""

    ids: list[int]
    points: Complexes
    means: Floats
    deviators: Complexes

    def __getitem__(self, rows: Rows | slice) -> Sightings:
        ids = self.ids[rows] if isinstance(rows, slice) else [self.ids[i] for i in rows.tolist()]
        return Sightings(ids, self.points[rows], self.means[rows], self.deviators[rows])


def sightings(edges: tuple[LandmarkEdge, ...]) -> Sightings:
    """The CP edges as arrays, each id once (the last one counts).

    An edge whose covariance is none (not positive definite) or whose numbers are no road's is left out.
    """
    latest = {e.landmark: e for e in edges}
    ids = list(latest)
    flat = chain.from_iterable((e.x_m, e.y_m, *e.cov) for e in latest.values())
    table = np.fromiter(flat, np.float64, 6 * len(ids)).reshape(-1, 6)
    if np.abs(table).max(initial=0.0) > LARGEST_M:
        sane = np.abs(table).max(axis=1) <= LARGEST_M
        ids, table = [i for i, keep in zip(ids, sane.tolist(), strict=True) if keep], table[sane]
    x, y, xx, xy, _, yy = table.T
    out = Sightings(ids, x + 1j * y, 0.5 * (xx + yy) + _LEAST_VARIANCE_M2, 0.5 * (xx - yy) + 1j * xy)
    good = out.means > np.abs(out.deviators)
    return out if good.all() else out[np.flatnonzero(good)]


def sum_of_edges(gaps_m: Complexes, means: Floats, deviators: Complexes) -> tuple[complex, float, complex]:
    """N >= 1 unary edges on one translation as one: their centroid weighted by information, and its covariance.

    Exact for Eq. 7: the sum over i of |t - gap_i|^2 in C_i^-1, and |t - centroid|^2 in C^-1, differ by a constant in t.
    """
    det = means * means - (deviators * deviators.conj()).real
    information, deviation = means / det, -deviators / det
    moment = complex((information * gaps_m + deviation * gaps_m.conj()).sum())
    m, d = float(information.sum()), complex(deviation.sum())
    det_sum = m * m - abs(d) ** 2
    return (m * moment - d * moment.conjugate()) / det_sum, m / det_sum, -d / det_sum


class LandmarksState(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """All that `Landmarks` holds; see there."""

    tied: Sightings
    information: Floats
    moment: Complexes
    frames: Rows


class Landmarks:
    """The landmarks in sight at the last key frame: those that the window's `KEY_NODE` is tied to.

    The position X_p of Eq. 3 is carried by that node: the error of the pose that put a landmark on the map is the
    node's own, so a landmark ties the ego to where it was and never claims to know the world better than the ego did.
    Key frames are a few frames apart: between them the same points of the same road would say the same thing again.
    """

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._row: dict[int, int] = {}  # by id
        self._tied = sightings(())  # in the ego of the key frame
        # Sums over the key frames that each was seen in: information, information times position in world, frames
        self._information = np.zeros(0)
        self._moment = np.zeros(0, dtype=np.complex128)
        self._frames = np.zeros(0, dtype=np.int64)

    def __len__(self) -> int:
        return len(self._row)

    def state(self) -> LandmarksState:
        """For `taken_up`; the arrays are the landmarks' own."""
        return LandmarksState(tied=self._tied, information=self._information, moment=self._moment, frames=self._frames)

    @staticmethod
    def taken_up(state: LandmarksState, capacity: int) -> Landmarks:
        """The landmarks that had this state. Raises ValueError where its arrays do not belong together."""
        tied = state.tied
        parts = (tied.points, tied.means, tied.deviators, state.information, state.moment, state.frames)
        if any(len(part) != len(tied.ids) for part in parts):
            raise ValueError(f"{len(tied.ids)} landmarks with arrays of {[len(part) for part in parts]}")
        out = Landmarks(capacity)
        out._row = {i: row for row, i in enumerate(tied.ids)}
        out._tied, out._information, out._moment, out._frames = tied, state.information, state.moment, state.frames
        return out

    def edge(self, seen: Sightings, window: Window, gate: float) -> tuple[complex, float, complex] | None:
        """The sum of a key frame's edges as one on the last key node's place in ego.

        A landmark whose squared Mahalanobis distance is past `gate` weighs less by the square of the excess.
        """
        rows = self._rows(seen)
        now = np.flatnonzero(rows >= 0)
        if not len(now):
            return None
        then = rows[now]
        node, heading = complex(window.at[KEY_NODE]), complex(window.heading[KEY_NODE])
        gaps = seen.points[now] - node - heading * self._tied.points[then]  # Eq. 3
        means = seen.means[now] + self._tied.means[then]
        deviators = seen.deviators[now] + heading * heading * self._tied.deviators[then]
        # The node's own doubt counts in what is wild
        at = 3 + 3 * KEY_NODE
        (xx, xy), (_, yy) = window.P[at : at + 2, at : at + 2].tolist()
        m, d = means + 0.5 * (xx + yy), deviators + complex(0.5 * (xx - yy), xy)
        distances = (m * (gaps * gaps.conj()).real - (d.conj() * gaps * gaps).real) / (m * m - (d * d.conj()).real)
        if distances.max() > gate:
            excess = np.maximum(1.0, distances / gate) ** 2
            means, deviators = means * excess, deviators * excess
        return sum_of_edges(gaps, means, deviators)

    def see(self, seen: Sightings, window: Window, least_frames: int) -> list[tuple[float, float]]:
        """Ties a key frame's landmarks to the ego, now that it is corrected; returns those that settled, in world.

        A landmark that is out of sight settles: it is on the map where it was seen in `least_frames` key frames, at
        its mean over them, weighted by information. A lane's stations do not: their lane is on the map.
        """
        seen = seen[: self._capacity]
        rows = self._rows(seen)
        gone = np.ones(len(self._row), dtype=np.bool_)
        gone[rows[rows >= 0]] = False
        gone &= (self._frames >= least_frames) & (np.fromiter(self._row, np.int64, len(gone)) < LANE_LANDMARKS)
        settled = [(p.real, p.imag) for p in (self._moment[gone] / self._information[gone]).tolist()]

        T = window.world
        information = 1.0 / seen.means
        moment = information * (seen.points * cmath.exp(1j * T.yaw_rad) + complex(T.x_m, T.y_m))
        old = np.flatnonzero(rows >= 0)
        frames = np.ones(len(rows), dtype=np.int64)
        for sums, before in ((information, self._information), (moment, self._moment), (frames, self._frames)):
            sums[old] += before[rows[old]]
        self._information, self._moment, self._frames = information, moment, frames
        self._row = {i: row for row, i in enumerate(seen.ids)}
        self._tied = seen
        return settled

    def _rows(self, seen: Sightings) -> Rows:
        """(N,) where each landmark is kept; -1: nowhere yet."""
        return np.array([self._row.get(i, -1) for i in seen.ids], dtype=np.int64)


class PendingState(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """All that `PendingMap` holds; see there."""

    frame_id: int
    landmarks: list[tuple[float, float]]
    lanes: list[tuple[SE2, tuple[LanePoint, ...]]]


class PendingMap:
    """What the map gained and nobody has asked for yet; the oldest go past `landmarks` points or `frames` of lanes.

    Lane points are turned into world only when they are asked for.
    """

    def __init__(self, landmarks: int, frames: int) -> None:
        self._capacity = landmarks, frames
        self.begin(0)

    def begin(self, epoch: int) -> None:
        self._epoch, self._frame_id = epoch, 0
        self._landmarks: deque[tuple[float, float]] = deque(maxlen=self._capacity[0])
        self._lanes: deque[tuple[SE2, tuple[LanePoint, ...]]] = deque(maxlen=self._capacity[1])

    def state(self) -> PendingState:
        """For `take_up`."""
        return PendingState(frame_id=self._frame_id, landmarks=list(self._landmarks), lanes=list(self._lanes))

    def take_up(self, state: PendingState, epoch: int) -> None:
        """Goes on where the map of this state was."""
        self.begin(epoch)
        self._frame_id = state.frame_id
        self._landmarks.extend(state.landmarks)
        self._lanes.extend(state.lanes)

    def add(
        self, frame_id: int, landmarks_m: list[tuple[float, float]], T_world_ego: SE2, lanes: tuple[LanePoint, ...]
    ) -> None:
        """`landmarks_m` in world, `lanes` in ego."""
        self._frame_id = frame_id
        self._landmarks.extend(landmarks_m)
        if lanes:
            self._lanes.append((T_world_ego, lanes))

    def take(self) -> MapUpdate | None:
        if not self._landmarks and not self._lanes:
            return None
        lanes_m = [
            (x, y) for T, points in self._lanes for x, y in (T @ np.array([(p.x_m, p.y_m) for p in points])).tolist()
        ]
        lane_ids = tuple(p.lane for _, points in self._lanes for p in points)
        out = MapUpdate(
            epoch=self._epoch,
            frame_id=self._frame_id,
            landmarks_m=tuple(self._landmarks),
            lanes_m=tuple(lanes_m),
            lane_ids=lane_ids if any(lane >= 0 for lane in lane_ids) else (),
        )
        self._landmarks.clear()
        self._lanes.clear()
        return out
