"""Landmarks in the back end: those of the last keyframe, and what CP edges to them say of the ego (Eqs. 3 and 7).

A landmark is a point of the road or a station of a lane; mapping/landmark_edges.py and mapping/lane_edges.py make the
edges. Points and their covariances are complex numbers, as in factors.py.
"""

from __future__ import annotations

import cmath
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import chain

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.planar import Complexes, Floats
from birdslam.graph.edges import LARGEST_M
from birdslam.graph.factors import CpEdge, Rows, inflation, landmark_residual, point_costs, sum_of_points
from birdslam.graph.window import Window
from birdslam.types import LandmarkEdge, LandmarkKind

LandmarkKey = tuple[LandmarkKind, int]  # each kind has ids of its own

_LEAST_VARIANCE_M2 = 1e-12  # a landmark without noise must not make the sum singular


@dataclass(slots=True)
class Sightings:
    """The landmarks of one frame: points (N,) in ego, means (N,) and deviators (N,) of their covariances."""

    keys: list[LandmarkKey]
    points: Complexes
    means: Floats
    deviators: Complexes

    def __getitem__(self, rows: Rows | slice) -> Sightings:
        keys = self.keys[rows] if isinstance(rows, slice) else [self.keys[i] for i in rows.tolist()]
        return Sightings(keys, self.points[rows], self.means[rows], self.deviators[rows])


def sightings(edges: tuple[LandmarkEdge, ...]) -> Sightings:
    """The CP edges as arrays, each landmark once (the last one counts).

    An edge whose covariance is none (not positive definite) or whose numbers are no road's is left out.
    """
    latest = {(e.kind, e.landmark): e for e in edges}
    keys = list(latest)
    flat = chain.from_iterable((e.x_m, e.y_m, *e.cov) for e in latest.values())
    table = np.fromiter(flat, np.float64, 6 * len(keys)).reshape(-1, 6)
    if np.abs(table).max(initial=0.0) > LARGEST_M:
        sane = np.abs(table).max(axis=1) <= LARGEST_M
        keys, table = [key for key, keep in zip(keys, sane.tolist(), strict=True) if keep], table[sane]
    x, y, xx, xy, _, yy = table.T
    out = Sightings(keys, x + 1j * y, 0.5 * (xx + yy) + _LEAST_VARIANCE_M2, 0.5 * (xx - yy) + 1j * xy)
    good = out.means > np.abs(out.deviators)
    return out if good.all() else out[np.flatnonzero(good)]


class LandmarksState(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """All that `Landmarks` holds; see there."""

    tied: Sightings
    information: Floats
    moment: Complexes
    frames: Rows


class Landmarks:
    """The landmarks in sight at the last keyframe: those that the window's key node is tied to.

    The position X_p of Eq. 3 is carried by that node: the error of the pose that put a landmark on the map is the
    node's own, so a landmark ties the ego to where it was and never claims to know the world better than the ego did.
    Keyframes are a few frames apart: between them the same points of the same road would say the same thing again.
    """

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._row: dict[LandmarkKey, int] = {}
        self._tied = sightings(())  # in the ego of the keyframe
        # Sums over the keyframes that each was seen in: information, information times position in world, frames
        self._information = np.zeros(0)
        self._moment = np.zeros(0, dtype=np.complex128)
        self._frames = np.zeros(0, dtype=np.int64)

    def __len__(self) -> int:
        return len(self._row)

    def state(self) -> LandmarksState:
        """For `from_state`; the arrays are the landmarks' own."""
        return LandmarksState(tied=self._tied, information=self._information, moment=self._moment, frames=self._frames)

    @staticmethod
    def from_state(state: LandmarksState, capacity: int) -> Landmarks:
        """The landmarks that had this state. Raises ValueError where its arrays do not belong together."""
        tied = state.tied
        parts = (tied.points, tied.means, tied.deviators, state.information, state.moment, state.frames)
        if any(len(part) != len(tied.keys) for part in parts):
            raise ValueError(f"{len(tied.keys)} landmarks with arrays of {[len(part) for part in parts]}")
        out = Landmarks(capacity)
        out._row = {key: row for row, key in enumerate(tied.keys)}
        out._tied, out._information, out._moment, out._frames = tied, state.information, state.moment, state.frames
        return out

    def sum_of_edges(
        self, seen: Sightings, window: Window, gate: float, common_variance: float, place_errs: bool = True
    ) -> CpEdge | None:
        """A keyframe's CP edges to known landmarks as one edge to the key node before; None where none is known.

        A landmark whose squared Mahalanobis distance is past `gate` weighs less by the square of the excess.
        `common_variance` in m^2 is of what all landmarks of a frame share, which their sum does not average away.
        Without `place_errs` the place that the key node saw a landmark at is taken for known.
        """
        rows = self._rows(seen)
        now = np.flatnonzero(rows >= 0)
        if not len(now):
            return None
        then = rows[now]
        node, heading, node_cov = window.key_node()
        residuals = landmark_residual(seen.points[now], node, heading, self._tied.points[then])  # Eq. 3
        means, deviators = seen.means[now], seen.deviators[now]
        if place_errs:
            means = means + self._tied.means[then]
            deviators = deviators + heading * heading * self._tied.deviators[then]
        # An outlier is one for which the key node's own uncertainty does not account either
        (xx, xy), (_, yy) = node_cov.tolist()
        distances = point_costs(residuals, means + 0.5 * (xx + yy), deviators + complex(0.5 * (xx - yy), xy))  # Eq. 5
        if distances.max() > gate:
            excess = inflation(distances, gate)
            means, deviators = means * excess, deviators * excess
        gap, m, d = sum_of_points(residuals, means, deviators)  # Eq. 7
        m += common_variance
        return CpEdge(np.array([gap.real, gap.imag]), np.array([[m + d.real, d.imag], [d.imag, m - d.real]]))

    def tie(self, seen: Sightings, window: Window, least_frames: int) -> list[tuple[float, float]]:
        """Ties a keyframe's landmarks to the ego, now that it is corrected; returns those that settled, in world.

        A landmark that is out of sight settles: it is on the map where it was seen in `least_frames` keyframes, at
        its mean over them, weighted by information. A lane's stations do not: their lane is on the map.
        """
        seen = seen[: self._capacity]
        rows = self._rows(seen)
        gone = np.ones(len(self._row), dtype=np.bool_)
        gone[rows[rows >= 0]] = False
        gone &= (self._frames >= least_frames) & _are_road_points(self._row)
        settled = [(p.real, p.imag) for p in (self._moment[gone] / self._information[gone]).tolist()]

        T = window.world
        information = 1.0 / seen.means
        moment = information * (seen.points * cmath.exp(1j * T.yaw_rad) + complex(T.x_m, T.y_m))
        old = np.flatnonzero(rows >= 0)
        frames = np.ones(len(rows), dtype=np.int64)
        for sums, before in ((information, self._information), (moment, self._moment), (frames, self._frames)):
            sums[old] += before[rows[old]]
        self._information, self._moment, self._frames = information, moment, frames
        self._row = {key: row for row, key in enumerate(seen.keys)}
        self._tied = seen
        return settled

    def _rows(self, seen: Sightings) -> Rows:
        """(N,) where each landmark is kept; -1: nowhere yet."""
        return np.array([self._row.get(key, -1) for key in seen.keys], dtype=np.int64)


def _are_road_points(keys: Iterable[LandmarkKey]) -> NDArray[np.bool_]:
    return np.array([kind is LandmarkKind.ROAD_POINT for kind, _ in keys], dtype=np.bool_)
