"""Landmarks in the back end, and what CP edges to them say of the ego (Eqs. 3 and 7).

A landmark is a point of the road or a station of a lane; mapping/landmark_edges.py and mapping/lane_edges.py make the
edges. Points and their covariances are complex numbers, as in factors.py.

Where X_p of Eq. 3 is, is a choice (`LandmarkAnchor`):

- "key_frame": where the last keyframe saw the landmark. X_p is carried by the window's key node: the error of the pose
  that put a landmark on the map is the node's own, so that a landmark ties the ego to where it was and never claims to
  know the world better than the ego did. Keyframes are a few frames apart: between them the same points of the same
  road would say the same thing again.
- "first_sight": a point of the world, put there once by the first frame that sees the landmark and known from then on,
  as the paper's text has it: its edge is unary, and X_p no node of the graph. Every frame has CP edges. What a frame
  sees is turned to world by the heading that the CC edges alone give: the edge of Eq. 3 is one on the place, "does not
  constrain the orientation", and so must not depend on it either. Turned by the graph's own heading, a heading that is
  off looks like a place that is off by far more, and the next heading overshoots.
"""

from __future__ import annotations

import cmath
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Literal

import msgspec
import numpy as np

from birdslam.graph.edges import LARGEST_M
from birdslam.graph.factors import (
    Complexes,
    CpEdge,
    Floats,
    Rows,
    inflation,
    landmark_residual,
    point_costs,
    sum_of_points,
)
from birdslam.graph.window import EGO_PLACE, KEY_PLACE, Window
from birdslam.types import LandmarkEdge, LandmarkKind

LandmarkKey = tuple[LandmarkKind, int]  # each kind has ids of its own
LandmarkAnchor = Literal["key_frame", "first_sight"]

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
    yaw_rad: float


class Landmarks:
    """The landmarks of the last frame that had CP edges, anchored as `anchor` says; see the module."""

    def __init__(self, capacity: int, anchor: LandmarkAnchor = "key_frame") -> None:
        self._capacity = capacity
        self._fixed = anchor == "first_sight"
        self._row: dict[LandmarkKey, int] = {}
        self._tied = sightings(())  # in the ego of the keyframe; where fixed, in world
        # Sums over the frames that each was seen in: information, information times position in world, frames
        self._information = np.zeros(0)
        self._moment = np.zeros(0, dtype=np.complex128)
        self._frames = np.zeros(0, dtype=np.int64)
        self._yaw_rad = 0.0  # of the ego in world by the CC edges alone

    def __len__(self) -> int:
        return len(self._row)

    def state(self) -> LandmarksState:
        """For `from_state`; the arrays are the landmarks' own."""
        return LandmarksState(
            tied=self._tied,
            information=self._information,
            moment=self._moment,
            frames=self._frames,
            yaw_rad=self._yaw_rad,
        )

    @staticmethod
    def from_state(state: LandmarksState, capacity: int, anchor: LandmarkAnchor = "key_frame") -> Landmarks:
        """The landmarks that had this state. Raises ValueError where its arrays do not belong together."""
        tied = state.tied
        parts = (tied.points, tied.means, tied.deviators, state.information, state.moment, state.frames)
        if any(len(part) != len(tied.keys) for part in parts):
            raise ValueError(f"{len(tied.keys)} landmarks with arrays of {[len(part) for part in parts]}")
        out = Landmarks(capacity, anchor)
        out._row = {key: row for row, key in enumerate(tied.keys)}
        out._tied, out._information, out._moment, out._frames = tied, state.information, state.moment, state.frames
        out._yaw_rad = state.yaw_rad
        return out

    def turn(self, yaw_rad: float) -> None:
        """The ego turned by so much since the last frame, as its CC edge says."""
        self._yaw_rad += yaw_rad

    def sum_of_edges(self, seen: Sightings, window: Window, gate: float, common_variance: float) -> CpEdge | None:
        """A frame's CP edges to known landmarks as one edge; None where none is known.

        A landmark whose squared Mahalanobis distance is past `gate` weighs less by the square of the excess.
        `common_variance` in m^2 is of what all landmarks of a frame share, which their sum does not average away.
        """
        now, then = self._known(seen)
        if not len(now):
            return None
        points, means, deviators = seen.points[now], seen.means[now], seen.deviators[now]
        if self._fixed:  # known, where the world has it
            place, node_cov = EGO_PLACE, window.ego_cov[:2, :2]
            there, off = self._in_ego(then, window)
            residuals = landmark_residual(there, 0.0, off, points)  # Eq. 3
        else:
            place = KEY_PLACE
            node, heading, node_cov = window.key_node()
            residuals = landmark_residual(points, node, heading, self._tied.points[then])  # Eq. 3
            means = means + self._tied.means[then]
            deviators = deviators + heading * heading * self._tied.deviators[then]
        # An outlier is one for which the node's own uncertainty does not account either
        (xx, xy), (_, yy) = node_cov.tolist()
        distances = point_costs(residuals, means + 0.5 * (xx + yy), deviators + complex(0.5 * (xx - yy), xy))  # Eq. 5
        if distances.max() > gate:
            excess = inflation(distances, gate)
            means, deviators = means * excess, deviators * excess
        gap, m, d = sum_of_points(residuals, means, deviators)  # Eq. 7
        m += common_variance
        return CpEdge((gap.real, gap.imag), np.array([[m + d.real, d.imag], [d.imag, m - d.real]]), place)

    def vehicle_residuals(
        self, seen: Sightings, window: Window, rows: Sequence[int], places: Sequence[complex]
    ) -> tuple[Complexes, int]:
        """The CP edges of vehicles (Eq. 7) that a frame sees at `places` (k,) in ego, those of each summed.

        How much further on, in ego, the vehicles `rows` (k,) of the window stand (k,), and the number of edges of each:
        0 where no landmark is known. All landmarks weigh alike. They must be anchored at their first sight.
        """
        now, then = self._known(seen)
        if not len(now):
            return np.zeros(len(rows), np.complex128), 0
        there, off = self._in_ego(then, window)
        ego = complex(landmark_residual(there, 0.0, off, seen.points[now]).mean())  # Eq. 7
        at = np.array([window.at[window.nodes + row] for row in rows])
        return ego + off * np.array(places) - at, len(now)  # Eq. 3, of the vehicle

    def _in_ego(self, rows: Rows, window: Window) -> tuple[Complexes, complex]:
        """Known landmarks in ego, and the heading there of what a frame sees: that of the CC edges alone."""
        T = window.world
        there = (self._tied.points[rows] - complex(T.x_m, T.y_m)) * cmath.exp(-1j * T.yaw_rad)
        return there, cmath.exp(1j * (self._yaw_rad - T.yaw_rad))

    def tie(self, seen: Sightings, window: Window, least_frames: int) -> list[tuple[float, float]]:
        """Ties a frame's landmarks to the ego, now that it is corrected; returns those that settled, in world.

        A landmark that is out of sight settles: it is on the map where it was seen in `least_frames` frames, at its
        mean over them, weighted by information. A lane's stations do not: their lane is on the map.
        """
        seen = seen[: self._capacity]
        old, before = self._known(seen)
        out_of_sight = np.ones(len(self._frames), np.bool_)
        out_of_sight[before] = False
        settles = np.flatnonzero(out_of_sight & (self._frames >= least_frames)).tolist()
        gone = [row for row in settles if self._tied.keys[row][0] is LandmarkKind.ROAD_POINT]
        settled = [(p.real, p.imag) for p in (self._moment[gone] / self._information[gone]).tolist()] if gone else []

        T = window.world
        information = 1.0 / seen.means
        at = complex(T.x_m, T.y_m)
        moment = information * (at + seen.points * cmath.exp(1j * T.yaw_rad))
        if self._fixed:
            fixed = at + seen.points * cmath.exp(1j * self._yaw_rad)
            fixed[old] = self._tied.points[before]
            seen = Sightings(seen.keys, fixed, seen.means, seen.deviators)
        frames = np.ones(len(seen.keys), dtype=np.int64)
        for sums, kept in ((information, self._information), (moment, self._moment), (frames, self._frames)):
            sums[old] += kept[before]
        self._information, self._moment, self._frames = information, moment, frames
        self._row = {key: row for row, key in enumerate(seen.keys)}
        self._tied = seen
        return settled

    def _known(self, seen: Sightings) -> tuple[Rows, Rows]:
        """Which of a frame's landmarks are known, and the row where each of these is kept."""
        row = self._row
        rows = np.array([row.get(key, -1) for key in seen.keys], dtype=np.int64)
        now = np.flatnonzero(rows >= 0)
        return now, rows[now]
