"""The solver of the pose graph: the joint Gaussian of the newest poses, updated once a frame.

All that Eqs. 2-8 say of the present is in the joint distribution of the newest ego pose in the world, a few ego poses
before it, each vehicle's newest pose and each vehicle's velocity. Poses that leave it are marginalised, which in
covariance form means that their rows are dropped: exact, and nothing is factored that could turn out indefinite.

Every pose but the first is kept *relative to the newest ego*. Then a CV edge measures a state directly, a CC edge moves
all poses by one known transform, and no Jacobian knows where the world began: the conditioning does not change with the
length of the drive.

State vector, in blocks of three: [ego in world | ego nodes | vehicle poses | vehicle twists]. A pose's error is xi in
T_true = T o (xi as a pose), the tangent (x_m, y_m, yaw_rad) at the pose and gtsam's chart for Pose2. An edge's error is
the measured pose seen from the estimated one, Eq. 2 from its other end: a measured yaw does not turn its own noise. A
twist is (x_mps, y_mps, yaw_radps) in the vehicle's own frame, constant over the interval that led to its newest pose.

Positions are complex numbers x + iy and headings unit complex numbers e^(i yaw): composing poses is then multiplying,
and the hot loop, which costs by the call and not by the number, makes half as many calls.

Why not gtsam: with ten vehicles and the same lag its fixed-lag smoothers took 1.4 to 2.7 ms a frame where this takes
0.27 ms (`python -m perf optimizer` measures both), its Cholesky raises now and then, and plain ISAM2 grows without
bound. Its answers on the same edges are what tests/test_graph.py holds this module to.
"""

from __future__ import annotations

import cmath
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from birdslam.planar import advance, gaps, inverse_adjoint
from birdslam.se2 import SE2

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
    cp_gap: Floats | None  # (2,) the sum of Eq. 7: how much further on the key node is, in its axes
    cp_cov: Floats  # (2, 2)


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

    def _index(self) -> None:
        """Where in P the vehicles' poses and twists begin, and the ego's and each vehicle's own (9, 9) stand."""
        M = len(self.velocity)
        self.pose_at = 3 + 3 * self.nodes
        self.twist_at = self.pose_at + 3 * M
        own = np.empty((M, 9), dtype=np.int64)
        own[:, :3] = _AXES
        own[:, 3:6] = self.pose_at + 3 * np.arange(M)[:, None] + _AXES
        own[:, 6:] = own[:, 3:6] + 3 * M
        self._own_rows, self._own_columns = own[:, :, None], own[:, None, :]
        self._poses_of, self._twists_of = own[:, 3:6], own[:, 6:]

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
        node, pose_at, twist_at, P = self.next_node, self.pose_at, self.twist_at, self.P
        rows = slice(3 + 3 * node, 6 + 3 * node)
        self.at[node], self.heading[node] = 0.0, 1.0  # the ego as it was becomes a node: no distance from itself
        P[rows] = P[:, rows] = 0.0  # and no doubt
        self.node_frames[node] = self.frame
        base = node if from_frame == self.frame else self.node_frames.index(from_frame)
        T_ego_next = motion if base == node else _se2(self.at[base], self.heading[base]) @ motion
        self.world = self.world @ T_ego_next

        at, heading, turn, push = advance(self.velocity, self.turn_radps, dt_s)
        self.at[self.nodes :] += self.heading[self.nodes :] * at
        self.heading[self.nodes :] *= heading
        back = cmath.exp(-1j * T_ego_next.yaw_rad)
        self.at -= complex(T_ego_next.x_m, T_ego_next.y_m)
        self.at *= back
        self.heading *= back

        P.reshape(-1)[twist_at * (len(P) + 1) :: len(P) + 1] += twist_growth.ravel()
        if node == 0:  # now and then, so that rounding can't add up
            P = 0.5 * (P + P.T)
            self.heading /= np.abs(self.heading)
        ego = T_ego_next.inverse().adjoint()
        for once_more in (False, True):  # F P, and then F (F P)' = F P F'
            P = P.T.copy() if once_more else P
            P[:3] = ego @ P[:3]
            vehicles, twists = P[pose_at:twist_at].reshape(-1, 3, len(P)), P[twist_at:].reshape(-1, 3, len(P))
            vehicles[:] = turn @ vehicles + push @ twists
        G = np.zeros((len(P), 3))  # the ego's noise moves all that is told from the ego
        G[:3] = _EYE3
        np.negative(inverse_adjoint(self.at, self.heading), out=G[3:twist_at].reshape(-1, 3, 3))
        if base != node:  # a longer edge: so does the doubt about where it began
            G_base = G @ motion.inverse().adjoint()
            there = slice(3 + 3 * base, 6 + 3 * base)
            P = P + G_base @ P[there] + (G_base @ P[there]).T + G_base @ P[there, there] @ G_base.T
        P += G @ cov @ G.T
        self.P, self.frame, self.next_node = P, to_frame, (node + 1) % self.nodes
        return T_ego_next

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
            poses = self.nodes + edges.cv_rows
            turned = np.exp(1j * edges.cv_poses[:, 2]) * self.heading[poses].conj()
            if turned.real.min() < 0.0:
                self._turn_about(edges.cv_rows[turned.real < 0.0])
                turned = np.where(turned.real < 0.0, -turned, turned)
            index[: 3 * k] = self._poses_of[edges.cv_rows].ravel()
            gaps(gap[: 3 * k], edges.cv_poses, self.at[poses], self.heading[poses], turned)
        if v:
            at, heading, _, push = advance(self.velocity[edges.vv_rows], self.turn_radps[edges.vv_rows], edges.vv_dt_s)
            over = np.empty(3 * v)
            gaps(over, edges.vv_motions, at, heading, np.exp(1j * edges.vv_motions[:, 2]) * heading.conj())
            back = np.linalg.inv(push)
            index[3 * k : n] = self._twists_of[edges.vv_rows].ravel()
            gap[3 * k : n] = (back @ over.reshape(v, 3, 1)).ravel()
            blocks = np.concatenate([blocks, back @ edges.vv_covs @ back.transpose(0, 2, 1)])
        if edges.cp_gap is not None:
            index[n:] = 3 + 3 * KEY_NODE, 4 + 3 * KEY_NODE
            gap[n:] = edges.cp_gap

        PHt = self.P[:, index]
        S = PHt[index]
        edge = np.arange(k + v)
        squares = S[:n, :n].reshape(k + v, 3, k + v, 3)
        diagonal = squares[edge, :, edge, :] + blocks + _LEAST
        if k:
            r = gap[: 3 * k].reshape(k, 3, 1)
            distance = (r * np.linalg.solve(diagonal[:k], r)).reshape(k, 3).sum(axis=1)
            if distance.max() > gate:
                wild = distance > 4.0 * gate
                left_out = np.flatnonzero(wild).tolist()
                excess = np.where(wild, 1.0, np.maximum(1.0, distance / gate) ** 2)
                diagonal[:k] += (excess - 1.0)[:, None, None] * blocks[:k] + wild[:, None, None] * _LEFT_OUT
        squares[edge, :, edge, :] = diagonal
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
        poses, twists = dx[3 : self.twist_at].reshape(-1, 3), dx[self.twist_at :].reshape(-1, 3)
        self.at += self.heading * (poses[:, 0] + 1j * poses[:, 1])
        self.heading *= np.exp(1j * poses[:, 2])
        self.velocity += twists[:, 0] + 1j * twists[:, 1]
        self.turn_radps += twists[:, 2]
        return left_out

    def in_world(self, ahead_s: Floats | None, changes: Floats) -> tuple[Floats, Floats, Floats]:
        """Vehicles in world, driven on by `ahead_s` (M,), if any, past their newest pose: poses (M, 3), velocities
        (M, 2), and the covariances (M, 5, 5) of both. `changes` (3,): twists' variances grow by so much a second.
        """
        M = len(self.velocity)
        at, heading = self.at[self.nodes :], self.heading[self.nodes :]
        J = np.zeros((M, 5, 9))  # from the errors of (ego in world, vehicle's pose, twist)
        if ahead_s is not None:
            drive, swing, turn, push = advance(self.velocity, self.turn_radps, ahead_s)
            at, heading = at + heading * drive, heading * swing
            J[:, :3, 3:6], J[:, :3, 6:] = turn, push
        else:
            J[:, :3, 3:6] = _EYE3
        J[:, :3, :3] = inverse_adjoint(at, heading)  # the ego's own error, seen at the vehicle
        ego = cmath.exp(1j * self.world.yaw_rad)
        at, heading = at * ego + complex(self.world.x_m, self.world.y_m), heading * ego
        velocity = heading * self.velocity
        # An error of the heading (third row so far) turns the velocity; one of the twist is turned into world
        J[:, 3] = -velocity.imag[:, None] * J[:, 2]
        J[:, 4] = velocity.real[:, None] * J[:, 2]
        J[:, 3, 6] += heading.real
        J[:, 4, 7] += heading.real
        J[:, 3, 7] -= heading.imag
        J[:, 4, 6] += heading.imag
        C = self.P[self._own_rows, self._own_columns]
        if ahead_s is not None:
            C[:, _AXES + 6, _AXES + 6] += ahead_s[:, None] * changes
        covs: Floats = J @ C @ J.transpose(0, 2, 1)
        variances = covs.reshape(M, 25)[:, ::6]
        np.maximum(variances, 0.0, out=variances)  # where all is known, rounding has either sign
        poses = np.empty((M, 3))
        poses[:, 0], poses[:, 1] = at.real, at.imag
        np.arctan2(heading.imag, heading.real, out=poses[:, 2])
        return poses, velocity.view(np.float64).reshape(M, 2), covs

    # --- vehicles come and go ---

    def place(self, rows: Rows, poses: Floats, covs: Floats, twist_cov: Floats) -> None:
        """Vehicles `rows` (k,) begin anew at `poses` (k, 3) in ego, at rest give or take, independent of all else."""
        self.at[self.nodes + rows] = poses[:, 0] + 1j * poses[:, 1]
        self.heading[self.nodes + rows] = np.exp(1j * poses[:, 2])
        self._renew(self._poses_of[rows], covs)
        self.retwist(rows, np.zeros((len(rows), 3)), twist_cov)

    def retwist(self, rows: Rows, twists: Floats, covs: Floats) -> None:
        """Vehicles `rows` (k,) get new `twists` (k, 3), independent of all else; their poses stay."""
        self.velocity[rows] = twists[:, 0] + 1j * twists[:, 1]
        self.turn_radps[rows] = twists[:, 2]
        self._renew(self._twists_of[rows], covs)

    def _renew(self, index: Rows, covs: Floats) -> None:
        self.P[index.ravel()] = 0.0
        self.P[:, index.ravel()] = 0.0
        self.P[index[:, :, None], index[:, None, :]] = covs

    def _turn_about(self, rows: Rows) -> None:
        """Vehicles `rows` (k,) have their front where their back was; they move as before.

        Front and back of a car look alike: a CV edge that contradicts the heading by more than a right angle says
        which end is the front, and leaves the motion as it is.
        """
        sign = np.ones(len(self.P))
        sign[self._poses_of[rows, :2].ravel()] = sign[self._twists_of[rows, :2].ravel()] = -1.0
        self.P *= sign[:, None] * sign
        self.heading[self.nodes + rows] *= -1.0
        self.velocity[rows] *= -1.0

    def select(self, rows: Rows) -> None:
        """Keeps the vehicles `rows` in that order; -1 makes room for a new one, to be placed next."""
        kept, n = np.flatnonzero(rows >= 0), self.nodes
        old, M = rows[kept], len(rows)
        blocks = np.arange(1 + n)
        source = np.concatenate([blocks, 1 + n + old, 1 + n + len(self.velocity) + old])
        target = np.concatenate([blocks, 1 + n + kept, 1 + n + M + kept])
        source, target = ((3 * b[:, None] + _AXES).ravel() for b in (source, target))
        P = np.zeros((self.pose_at + 6 * M, self.pose_at + 6 * M))
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
