"""The solver of the pose graph: the joint Gaussian of the newest poses, updated once a frame.

All that Eqs. 2-8 say of the present is in the joint distribution of the newest ego pose in the world, a few ego poses
before it, each vehicle's newest pose and each vehicle's velocity. Poses that leave it are marginalised, which in
covariance form means that their rows are dropped: exact, and nothing is factored that could turn out indefinite.

Every pose but the first is kept *relative to the newest ego*, and so is its error: its place and yaw in the ego's axes.
Then a CV edge is linear in the states, whatever the vehicle's yaw: a yaw that turns out to be another one does not turn
what is known of the place, and nothing needs to be linearised again. A CC edge moves all poses by one known transform,
and no Jacobian knows where the world began: the conditioning does not change with the length of the drive.

State vector, in blocks of three: [ego in world | ego nodes | each vehicle's pose and twist]. The first block's error is
xi in T_true = T o (xi as a pose), the tangent (x_m, y_m, yaw_rad) at the pose and gtsam's chart for Pose2. An edge's
covariance is told in the axes of the measured pose, as gtsam's is: a measured yaw does not turn its own noise. A twist
is (x_mps, y_mps, yaw_radps) in the vehicle's own frame, constant over the interval that led to its newest pose.

Positions are complex numbers x + iy and headings unit complex numbers e^(i yaw): composing poses is then multiplying,
and the hot loop, which costs by the call and not by the number, makes half as many calls.

Why not gtsam: with ten vehicles, the same edges and the same lag its fixed-lag smoothers took 2.4 to 4.4 ms a frame;
this takes 0.3 ms (`python -m perf optimizer` measures both). Its Cholesky raises now and then, and plain ISAM2 grows
without bound. Its answers on the same edges are what tests/test_consistency.py holds this module to.
"""

from __future__ import annotations

import cmath
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from birdslam.geometry.planar import advance, pairs, turned, unit
from birdslam.geometry.se2 import SE2

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Rows = NDArray[np.int64]

KEY_NODE = 0  # the ego node that landmarks are tied to; it is renewed once in every round of the nodes
_LEAST = 1e-8 * np.eye(3)  # 0.1 mm, 0.1 mrad: edges more exact than that would cost the covariances their digits
_LEFT_OUT = 1e12 * np.eye(3)  # so uncertain an edge says nothing
_EYE3 = np.eye(3)
_AXES = np.arange(3)


@dataclass(slots=True)
class Edges:
    """The edges that end in the newest frame, as arrays over k CV and v VV edges, and the sum of the CP edges."""

    cv_rows: Rows  # (k,) vehicles' rows in the window
    cv_poses: Floats  # (k, 3) T_ego_vehicle
    cv_covs: Floats  # (k, 3, 3)
    vv_rows: Rows  # (v,)
    vv_dt_s: Floats  # (v,) the interval that the edge spans
    vv_motions: Floats  # (v, 3)
    vv_covs: Floats  # (v, 3, 3)
    cp_gap: Floats | None  # (2,) the sum of Eq. 7: how much further on the key node is, in ego
    cp_cov: Floats  # (2, 2)


class WindowState(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """All that a window holds; see there."""

    frame: int
    node_frames: list[int | None]
    next_node: int
    world: SE2
    at: Complexes
    heading: Complexes
    velocity: Complexes
    turn_radps: Floats
    P: Floats


class Window:
    """The joint Gaussian of one epoch, which begins at `frame`. `nodes` ego poses are kept beside the newest."""

    def __init__(self, nodes: int, frame: int) -> None:
        self.nodes = nodes
        self.frame = frame
        self.node_frames: list[int | None] = [None] * nodes
        self.next_node = 0  # where the newest ego pose goes when the ego moves on
        self.world = SE2()  # T_world_ego
        # Poses in ego, of the ego nodes and then the vehicles; twists of the vehicles
        self.at = np.zeros(nodes, dtype=np.complex128)
        self.heading = np.ones(nodes, dtype=np.complex128)
        self.velocity = np.zeros(0, dtype=np.complex128)  # in the vehicle's own frame, m/s
        self.turn_radps = np.zeros(0)
        self.P = np.zeros((3 + 3 * nodes, 3 + 3 * nodes))
        self._index()

    def state(self) -> WindowState:
        """For `taken_up`; the arrays are the window's own."""
        return WindowState(**{name: getattr(self, name) for name in WindowState.__struct_fields__})

    @staticmethod
    def taken_up(state: WindowState) -> Window:
        """The window that had this state. Raises ValueError where its arrays do not belong together."""
        nodes, M = len(state.node_frames), len(state.velocity)
        n = 3 + 3 * nodes + 6 * M
        sizes = len(state.at), len(state.heading), len(state.turn_radps), state.P.shape
        if sizes != (nodes + M, nodes + M, M, (n, n)) or not 0 <= state.next_node < nodes:
            raise ValueError(f"a window of {nodes} nodes and {M} vehicles with arrays of {sizes}")
        window = Window(nodes, state.frame)
        for name in WindowState.__struct_fields__:
            setattr(window, name, getattr(state, name))
        window._index()
        return window

    def _index(self) -> None:
        """Where in P the vehicles begin, and the ego's and each vehicle's own (9, 9) stand."""
        M = len(self.velocity)
        self.vehicles_at = 3 + 3 * self.nodes
        own = np.empty((M, 9), dtype=np.int64)
        own[:, :3] = _AXES
        own[:, 3:] = self.vehicles_at + np.arange(6 * M).reshape(M, 6)
        self.own = own[:, :, None], own[:, None, :]
        self._poses_of, self._twists_of = own[:, 3:6], own[:, 6:]
        self._twist_variances = (own[:, 6:] * (len(self.P) + 1)).ravel()  # where they stand in P's memory
        self._carry = np.eye(self.vehicles_at)  # how the ego's motion moves the errors of the ego poses
        step = 3 * self._carry.strides[0] + 24
        self._carry_nodes = np.ndarray((self.nodes, 2, 2), np.float64, self._carry, step, (step, *self._carry.strides))

    def knows(self, frame: int) -> bool:
        """Whether a CC edge can start at `frame`: the newest, or a node that the newest will not take the place of."""
        return frame == self.frame or (frame in self.node_frames and frame != self.node_frames[self.next_node])

    def predict(
        self, motion: SE2, cov: Floats, from_frame: int, to_frame: int, dt_s: Floats, twist_growth: Floats
    ) -> SE2:
        """The ego goes by `motion` with `cov` (3, 3) since the known frame `from_frame`: the CC edge of Eq. 2.

        Each vehicle drives on for `dt_s` (M,) with the twist it has, its variances grown by `twist_growth` (M, 3): the
        constant-velocity factor. A vehicle with `dt_s` 0 stays at the pose it was last seen at. Returns how far the
        ego went since the newest frame.
        """
        node, vehicles_at, P = self.next_node, self.vehicles_at, self.P
        rows = slice(3 + 3 * node, 6 + 3 * node)
        self.at[node], self.heading[node] = 0.0, 1.0  # the ego as it was becomes a node: no distance from itself
        P[rows] = P[:, rows] = 0.0  # and no doubt
        self.node_frames[node] = self.frame
        base = node if from_frame == self.frame else self.node_frames.index(from_frame)
        T_ego_next = motion if base == node else _se2(self.at[base], self.heading[base]) @ motion
        self.world = self.world @ T_ego_next

        back = cmath.exp(-1j * T_ego_next.yaw_rad)
        self.at -= complex(T_ego_next.x_m, T_ego_next.y_m)
        self.at *= back
        self.heading *= back
        way, heading, partial = advance(self.heading[self.nodes :], self.velocity, self.turn_radps, dt_s)
        self.at[self.nodes :] += way
        self.heading[self.nodes :] = heading
        partial[:, :2] *= back
        F = np.zeros((len(dt_s), 3, 6))
        F[:, :2] = pairs(partial)
        F[:, 2, 2], F[:, 2, 5] = 1.0, dt_s

        P.reshape(-1)[self._twist_variances] += twist_growth.ravel()
        if node == 0:  # now and then, so that rounding can't add up
            P = 0.5 * (P + P.T)
            self.heading /= np.abs(self.heading)
        self._carry[:3, :3] = T_ego_next.inverse().adjoint()
        self._carry_nodes[:] = (back.real, -back.imag), (back.imag, back.real)
        for once_more in (False, True):  # F P, and then F (F P)' = F P F'
            P = P.T.copy() if once_more else P
            P[:vehicles_at] = self._carry @ P[:vehicles_at]
            vehicles = P[vehicles_at:].reshape(-1, 6, len(P))
            vehicles[:, :3] = F @ vehicles
        G = np.zeros((len(P), 3))  # the ego's noise moves all that is told from the ego
        G[:3] = _EYE3
        self._against(G[3:vehicles_at].reshape(-1, 3, 3), self.at[: self.nodes])
        self._against(G[vehicles_at:].reshape(-1, 6, 3), self.at[self.nodes :])
        if base != node:  # a longer edge: so does the doubt about where it began
            there = slice(3 + 3 * base, 6 + 3 * base)
            G_base = G @ np.linalg.inv(-G[there])
            P = P + G_base @ P[there] + (G_base @ P[there]).T + G_base @ P[there, there] @ G_base.T
        P += G @ cov @ G.T
        self.P, self.frame, self.next_node = P, to_frame, (node + 1) % self.nodes
        return T_ego_next

    def drift(self, along: complex, variance: float) -> None:
        """The ego, and with it all that is told from it, may have come this much further in the world than was told.

        `along` is the direction in ego, of length 1, `variance` in m^2. Between what is in sight nothing changes.
        """
        self.P[:2, :2] += variance * np.outer((along.real, along.imag), (along.real, along.imag))

    @staticmethod
    def _against(G: Floats, at: Complexes) -> None:
        """To the first rows of each of `G` (N, 3 or more, 3): how poses `at` (N,) move when the ego that they are told
        from does."""
        G[:, 0, 0] = G[:, 1, 1] = G[:, 2, 2] = -1.0
        G[:, 0, 2] = at.imag
        G[:, 1, 2] = -at.real

    def correct(self, edges: Edges, gate: float, hold: bool = False) -> list[int]:
        """CV, VV and CP of the newest frame, all at once: the minimum of Eq. 8, linearised at the prediction.

        A CV edge whose squared Mahalanobis distance is past `gate` has its covariance multiplied by the square of the
        excess; past four times `gate` it is left out. `hold` keeps the ego where it is (standstill). Returns which CV
        edges were left out. Where the numbers leave all bounds, P is NaN afterwards and the window is of no more use.
        """
        k, v, g = len(edges.cv_rows), len(edges.vv_rows), edges.cp_gap is not None
        left_out: list[int] = []
        if k + v + g == 0:
            return left_out
        n = 3 * (k + v)
        index = np.empty(n + 2 * g, dtype=np.int64)  # every edge measures states of the window directly
        gap = np.empty(n + 2 * g)
        blocks = edges.cv_covs
        if k:
            poses, measured = self.nodes + edges.cv_rows, unit(edges.cv_poses[:, 2])
            blocks = turned(blocks, measured)
            swing = measured * self.heading[poses].conj()
            if (swing.real < 0.0).any():
                self._turn_about(edges.cv_rows[swing.real < 0.0])
                swing = np.where(swing.real < 0.0, -swing, swing)
            index[: 3 * k] = self._poses_of[edges.cv_rows].ravel()
            _gaps(gap[: 3 * k], edges.cv_poses, self.at[poses], swing)
        if v:
            twists, straight = (self.velocity[edges.vv_rows], self.turn_radps[edges.vv_rows]), np.ones(v, np.complex128)
            way, heading, partial = advance(straight, *twists, edges.vv_dt_s)
            measured = unit(edges.vv_motions[:, 2])
            over = np.empty(3 * v)
            _gaps(over, edges.vv_motions, way, measured * heading.conj())
            H = np.zeros((v, 3, 3))
            H[:, :2] = pairs(partial)[:, :, 3:]
            H[:, 2, 2] = edges.vv_dt_s
            back = np.linalg.inv(H)
            index[3 * k : n] = self._twists_of[edges.vv_rows].ravel()
            gap[3 * k : n] = (back @ over.reshape(v, 3, 1)).ravel()
            covs = back @ turned(edges.vv_covs, measured) @ back.transpose(0, 2, 1)
            blocks = np.concatenate([blocks, covs])
        if edges.cp_gap is not None:
            index[n:] = 3 + 3 * KEY_NODE, 4 + 3 * KEY_NODE
            gap[n:] = edges.cp_gap

        PHt = self.P[:, index]
        S = PHt[index]
        row = S.strides[0]
        diagonal: Floats = np.ndarray((k + v, 3, 3), np.float64, S, 0, (3 * row + 24, row, 8))  # a view of the blocks
        diagonal += blocks
        diagonal += _LEAST
        if k:
            r = gap[: 3 * k].reshape(k, 3, 1)
            distance = (r * np.linalg.solve(diagonal[:k], r)).reshape(k, 3).sum(axis=1)
            if distance.max() > gate:
                wild = distance > 4.0 * gate
                left_out = np.flatnonzero(wild).tolist()
                excess = np.where(wild, 1.0, np.maximum(1.0, distance / gate) ** 2)
                diagonal[:k] += (excess - 1.0)[:, None, None] * blocks[:k] + wild[:, None, None] * _LEFT_OUT
        if g:
            S[n:, n:] += edges.cp_cov + _LEAST[:2, :2]

        L, failed = lapack.dpotrf(S, lower=1)
        if failed:  # no numbers of a road: nothing here is a covariance any more, which the caller sees
            self.P[:] = np.nan
            return left_out
        L_inverse, _ = lapack.dtrtri(L, lower=1)
        W = L_inverse @ PHt.T  # P H' S^-1 H P = W'W
        dx = (L_inverse @ gap) @ W
        kept = self.P[:3, :3].copy() if hold else None
        self.P -= W.T @ W
        if kept is not None:
            dx[:3] = 0.0
            self.P[:3, :3] = kept
        self.world = self.world @ SE2(*dx[:3].tolist())
        nodes, vehicles = dx[3 : self.vehicles_at].reshape(-1, 3), dx[self.vehicles_at :].reshape(-1, 6)
        moved = np.concatenate([nodes, vehicles[:, :3]])
        self.at += moved[:, 0] + 1j * moved[:, 1]
        self.heading *= unit(moved[:, 2])
        self.velocity += vehicles[:, 3] + 1j * vehicles[:, 4]
        self.turn_radps += vehicles[:, 5]
        return left_out

    # --- vehicles come and go ---

    def place(self, rows: Rows, poses: Floats, covs: Floats, twist_cov: Floats) -> None:
        """Vehicles `rows` (k,) begin anew at `poses` (k, 3) in ego, at rest give or take, independent of all else."""
        self.at[self.nodes + rows] = poses[:, 0] + 1j * poses[:, 1]
        self.heading[self.nodes + rows] = unit(poses[:, 2])
        self._renew(rows, 0, turned(covs, self.heading[self.nodes + rows]))
        self.retwist(rows, np.zeros(len(rows), dtype=np.complex128), np.zeros(len(rows)), twist_cov)

    def retwist(self, rows: Rows, velocity: Complexes, turn_radps: Floats, covs: Floats) -> None:
        """Vehicles `rows` (k,) get new twists with `covs` (k, 3, 3), independent of all else; their poses stay."""
        self.velocity[rows], self.turn_radps[rows] = velocity, turn_radps
        self._renew(rows, 3, covs)

    def _renew(self, rows: Rows, first: int, covs: Floats) -> None:
        """Three axes of the vehicles `rows`, from `first` on, get new variances and no correlation."""
        M, axes = len(self.velocity), slice(first, first + 3)
        chosen = slice(None) if len(rows) == M else rows
        self.P[self.vehicles_at :].reshape(M, 6, len(self.P))[chosen, axes] = 0.0
        self.P[:, self.vehicles_at :].reshape(len(self.P), M, 6)[:, chosen, axes] = 0.0
        index = self.vehicles_at + 6 * rows[:, None] + (_AXES + first)
        self.P[index[:, :, None], index[:, None, :]] = covs

    def _turn_about(self, rows: Rows) -> None:
        """Vehicles `rows` (k,) have their front where their back was; they move as before.

        Front and back of a car look alike: a CV edge that contradicts the heading by more than a right angle says
        which end is the front, and leaves the motion as it is.
        """
        sign = np.ones(len(self.P))
        sign[self._twists_of[rows, :2].ravel()] = -1.0
        self.P *= sign[:, None] * sign
        self.heading[self.nodes + rows] *= -1.0
        self.velocity[rows] *= -1.0

    def select(self, rows: Rows) -> None:
        """Keeps the vehicles `rows` in that order; -1 makes room for a new one, to be placed next."""
        kept, n, vehicles_at = np.flatnonzero(rows >= 0), self.nodes, self.vehicles_at
        old, M = rows[kept], len(rows)
        first, own = np.arange(vehicles_at), vehicles_at + np.arange(6)
        source, target = (np.concatenate([first, (6 * at[:, None] + own).ravel()]) for at in (old, kept))
        P = np.zeros((vehicles_at + 6 * M, vehicles_at + 6 * M))
        P[np.ix_(target, target)] = self.P[np.ix_(source, source)]
        at, heading = np.zeros(n + M, dtype=np.complex128), np.ones(n + M, dtype=np.complex128)
        velocity, turn_radps = np.zeros(M, dtype=np.complex128), np.zeros(M)
        at[:n], at[n + kept] = self.at[:n], self.at[n + old]
        heading[:n], heading[n + kept] = self.heading[:n], self.heading[n + old]
        velocity[kept], turn_radps[kept] = self.velocity[old], self.turn_radps[old]
        self.P, self.at, self.heading, self.velocity, self.turn_radps = P, at, heading, velocity, turn_radps
        self._index()


def _se2(at: complex, heading: complex) -> SE2:
    return SE2(at.real, at.imag, cmath.phase(heading))


def _gaps(out: Floats, measured: Floats, at: Complexes, swing: Complexes) -> None:
    """To `out` (3N,): how much further on, and turned, poses `measured` (N, 3) are than those at `at`."""
    gap = measured[:, 0] + 1j * measured[:, 1] - at
    out[0::3] = gap.real
    out[1::3] = gap.imag
    np.arctan2(swing.imag, swing.real, out=out[2::3])
