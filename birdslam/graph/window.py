"""The solver of the pose graph: the joint Gaussian of the newest poses, moved on and corrected once a frame.

All that Eqs. 2-8 say of the present is in the joint distribution of the newest ego pose in the world, a few ego poses
before it, each vehicle's newest pose and each vehicle's velocity. Poses that leave it are marginalised, which in
covariance form means that their rows are dropped: exact, and nothing is factored that could turn out indefinite.

Every pose but the first is kept *relative to the newest ego*, and so is its error: its place and yaw in the ego's axes.
Then a CV edge is linear in the state, whatever the vehicle's yaw: a yaw that turns out to be another one does not turn
what is known of the place, and nothing needs to be linearised again. A CC edge moves all poses by one known transform,
and no Jacobian depends on where the world began: the conditioning does not change with the length of the drive.

State vector (state_layout.py), in blocks of three: [ego in world | ego nodes | each vehicle's pose and twist]. The
first block's error is xi in T_true = T o (xi as a pose), the tangent (x_m, y_m, yaw_rad) at the pose and gtsam's chart
for Pose2. An edge's covariance is given in the axes of the measured pose, as gtsam's is: a measured yaw does not turn
its own noise. A twist is (x_mps, y_mps, yaw_radps) in the vehicle's own frame, constant over the interval that led to
its newest pose.

Positions are complex numbers x + iy and headings unit complex numbers e^(i yaw): composing poses is then multiplying.
A frame costs by the number of numpy calls, not by the size of the arrays, and this halves the calls.

Why not gtsam: with ten vehicles, the same edges and the same lag its fixed-lag smoothers took 2.4 to 4.4 ms a frame;
this takes 0.3 ms (`python -m perf optimizer` measures both). Its Cholesky raises now and then, and plain ISAM2 grows
without bound. Its answers on the same edges are what tests/test_consistency.py holds this module to.
"""

from __future__ import annotations

import cmath
import functools
import math
from typing import Any

import msgspec
import numpy as np

from birdslam.geometry.planar import Complexes, Floats, advance, pairs, turned, unit
from birdslam.geometry.se2 import SE2
from birdslam.graph.factors import (
    Cost,
    CpEdge,
    CvEdges,
    Rows,
    VvEdges,
    chained,
    collective_cost,
    cv_cost,
    dynamic_cost,
    inflation,
    pose_costs,
    vv_cost,
)
from birdslam.graph.state_layout import EGO, StateLayout, diagonal, diagonal_blocks

KEY_NODE = 0  # the ego node that landmarks are tied to; it is renewed once in every round of the nodes
KEY_PLACE = np.r_[StateLayout.node(KEY_NODE)][:2]
EGO_PLACE = np.r_[EGO][:2]
_LEAST = 1e-8 * np.eye(3)  # 0.1 mm, 0.1 mrad: edges more exact than that would cost the covariances their digits
_LEFT_OUT = 1e12 * np.eye(3)  # so uncertain an edge says nothing
_EYE3 = np.eye(3)


@functools.cache
def solver() -> Any:
    """LAPACK, which takes 22 MB and a second to load: who solves asks for it at the start, the others never."""
    from scipy.linalg import lapack

    return lapack


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
        self.layout = StateLayout(nodes, 0)
        self.P = np.zeros((self.layout.size, self.layout.size))

    def state(self) -> WindowState:
        """For `from_state`; the arrays are the window's own."""
        return WindowState(**{name: getattr(self, name) for name in WindowState.__struct_fields__})

    @staticmethod
    def from_state(state: WindowState) -> Window:
        """The window that had this state. Raises ValueError where its arrays do not belong together."""
        nodes, M = len(state.node_frames), len(state.velocity)
        layout = StateLayout(nodes, M)
        sizes = len(state.at), len(state.heading), len(state.turn_radps), state.P.shape
        if sizes != (nodes + M, nodes + M, M, (layout.size, layout.size)) or not 0 <= state.next_node < nodes:
            raise ValueError(f"a window of {nodes} nodes and {M} vehicles with arrays of {sizes}")
        window = Window(nodes, state.frame)
        for name in WindowState.__struct_fields__:
            setattr(window, name, getattr(state, name))
        window.layout = layout
        return window

    # --- what is known ---

    @property
    def ego_cov(self) -> Floats:
        """(3, 3) of the newest ego pose, a view."""
        return self.P[EGO, EGO]

    @property
    def is_finite(self) -> bool:
        """False: numbers that no road has, and the window is of no more use."""
        return math.isfinite(self.P.trace())

    @property
    def is_keyframe(self) -> bool:
        """Whether the newest ego pose is going to be the key node: one frame in `nodes`."""
        return self.next_node == KEY_NODE

    def key_node(self) -> tuple[complex, complex, Floats]:
        """The key node's place and heading in ego, and the covariance (2, 2) of its place."""
        rows = StateLayout.node(KEY_NODE)
        return complex(self.at[KEY_NODE]), complex(self.heading[KEY_NODE]), self.P[rows, rows][:2, :2]

    def knows(self, frame: int) -> bool:
        """Whether a CC edge can start at `frame`: the newest, or a node that the newest will not take the place of."""
        return frame == self.frame or (frame in self.node_frames and frame != self.node_frames[self.next_node])

    # --- from frame to frame ---

    def propagate(
        self, motion: SE2, cov: Floats, from_frame: int, to_frame: int, dt_s: Floats, twist_growth: Floats
    ) -> SE2:
        """The ego goes by `motion` with `cov` (3, 3) since the known frame `from_frame`: the CC edge of Eq. 2.

        Each vehicle drives on for `dt_s` (M,) with the twist it has, its variances grown by `twist_growth` (M, 3): the
        constant-velocity factor. A vehicle with `dt_s` 0 stays at the pose it was last seen at. Returns how far the
        ego went since the newest frame.
        """
        node = self._ego_becomes_node()
        base = self.node_frames.index(from_frame)
        T_ego_next = motion if base == node else _se2(self.at[base], self.heading[base]) @ motion
        self.world = chained(self.world, T_ego_next)
        back = cmath.exp(-1j * T_ego_next.yaw_rad)
        F = self._move_poses(T_ego_next, back, dt_s)
        diagonal(self.P)[self.layout.twist_rows] += twist_growth.ravel()
        if node == 0:  # now and then, so that rounding can't add up
            self.P = 0.5 * (self.P + self.P.T)
            self.heading /= np.abs(self.heading)
        self._move_errors(T_ego_next, back, F)
        self._add_motion_noise(cov, None if base == node else base)
        self.frame, self.next_node = to_frame, (node + 1) % self.nodes
        return T_ego_next

    def _ego_becomes_node(self) -> int:
        """The newest ego pose takes the place of the oldest node, which is marginalised; which node that is."""
        node = self.next_node
        rows = StateLayout.node(node)
        self.at[node], self.heading[node] = 0.0, 1.0  # told from the newest ego pose, which it still is itself
        self.P[rows] = self.P[:, rows] = 0.0  # and so without error
        self.node_frames[node] = self.frame
        return node

    def _move_poses(self, T_ego_next: SE2, back: complex, dt_s: Floats) -> Floats:
        """All poses, told from the next ego pose, whose axes are turned by `back`; vehicles drive on.

        Returns (M, 3, 6) how the errors of a vehicle's pose and twist move its next pose.
        """
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
        return F

    def _move_errors(self, T_ego_next: SE2, back: complex, F: Floats) -> None:
        """P of the moved poses: J P J', where J is block-diagonal."""
        egos, vehicles = self.layout.ego_poses, self.layout.vehicles
        J = np.eye(egos.stop)
        J[EGO, EGO] = T_ego_next.inverse().adjoint()
        diagonal_blocks(J, 3, self.nodes, 2)[:] = (back.real, -back.imag), (back.imag, back.real)
        P = self.P
        for once_more in (False, True):  # J P, and then J (J P)' = J P J'
            P = P.T.copy() if once_more else P
            P[egos] = J @ P[egos]
            of_vehicles = P[vehicles].reshape(-1, 6, len(P))
            of_vehicles[:, :3] = F @ of_vehicles
        self.P = P

    def _add_motion_noise(self, cov: Floats, base: int | None) -> None:
        """The noise of the ego's motion `cov` (3, 3) moves all that is told from the ego; so does, where the motion did
        not start at the newest pose but at the node `base`, the error of that node."""
        P, layout = self.P, self.layout
        G = np.zeros((layout.size, 3))
        G[EGO] = _EYE3
        _against(G[layout.nodes].reshape(-1, 3, 3), self.at[: self.nodes])
        _against(G[layout.vehicles].reshape(-1, 6, 3), self.at[self.nodes :])
        if base is not None:
            there = StateLayout.node(base)
            G_base = G @ np.linalg.inv(-G[there])
            P = P + G_base @ P[there] + (G_base @ P[there]).T + G_base @ P[there, there] @ G_base.T
        P += G @ cov @ G.T
        self.P = P

    def drift(self, along: complex, variance: float, across_variance: float) -> None:
        """The ego, and with it all that is told from it, may have come this much further in the world than was told.

        `along` is the direction in ego, of length 1, the variances along it and across it are in m^2. Between what is
        in sight nothing changes.
        """
        c, s = along.real, along.imag
        self.P[:2, :2] += variance * np.outer((c, s), (c, s)) + across_variance * np.outer((-s, c), (-s, c))

    def turn_drift(self, variance: float) -> None:
        """The ego, and with it all that is told from it, may have turned this much more in the world (rad^2)."""
        self.P[2, 2] += variance

    # --- the edges of a frame ---

    def minimise(
        self,
        cv: CvEdges,
        vv: VvEdges,
        cp: CpEdge | None,
        gate: float,
        hold: bool = False,
        ends_alike: bool = True,
    ) -> list[int]:
        """The minimum of Eq. 8 over the edges of the newest frame, all at once, linearised at the prediction.

        A CV edge whose squared Mahalanobis distance is past `gate` has its covariance multiplied by the square of the
        excess; past four times `gate` it is an outlier and left out. `hold` keeps the ego where it is (standstill).
        `ends_alike`: a CV edge may take the front of a vehicle for its back.
        Returns which CV edges are outliers. Where the numbers leave all bounds, the window is not finite afterwards.
        """
        if not len(cv.rows) + len(vv.rows) + (cp is not None):
            return []
        cost = self._cost(cv, vv, cp, ends_alike)
        PHt = self.P[:, cost.index]
        S = PHt[cost.index]  # of the residuals: what the window does not know, and the edges' own noise
        outliers = _add_noise(S, cost, len(cv.rows), gate)
        lapack = solver()
        L, failed = lapack.dpotrf(S, lower=1, overwrite_a=1)
        if failed:  # no numbers of a road: nothing here is a covariance any more, which the caller sees
            self.P[:] = np.nan
            return outliers
        L_inverse, _ = lapack.dtrtri(L, lower=1, overwrite_c=1)
        W = L_inverse @ PHt.T  # P H' S^-1 H P = W'W
        dx = (L_inverse @ cost.residual) @ W  # Eq. 8: where the sum of the window's own cost and F is least
        held = self.ego_cov.copy() if hold else None
        self.P -= W.T @ W
        if held is not None:
            dx[EGO] = 0.0
            self.P[EGO, EGO] = held
        self.shift(dx)
        return outliers

    def _cost(self, cv: CvEdges, vv: VvEdges, cp: CpEdge | None, ends_alike: bool) -> Cost:
        """F of Eq. 8 as far as it is of this frame."""
        layout = self.layout
        vehicles, headings = self.nodes + cv.rows, unit(cv.poses[:, 2])
        opposed = (headings * self.heading[vehicles].conj()).real < 0.0
        if ends_alike and opposed.any():
            self._turn_about(cv.rows[opposed])
        seen = cv_cost(cv, headings, layout.poses[cv.rows], self.at[vehicles], self.heading[vehicles])
        moved = None
        if len(vv.rows):
            moved = vv_cost(vv, layout.twists[vv.rows], self.velocity[vv.rows], self.turn_radps[vv.rows])
        return collective_cost(dynamic_cost(seen, moved), cp)

    def shift(self, dx: Floats) -> None:
        """Moves the mean by `dx` (n,)."""
        layout = self.layout
        self.world = self.world @ SE2(*dx[EGO].tolist())
        moved, changed = dx[layout.moved].T, dx[layout.twists].T
        self.at.real += moved[0]
        self.at.imag += moved[1]
        self.heading *= unit(moved[2])
        self.velocity.real += changed[0]
        self.velocity.imag += changed[1]
        self.turn_radps += changed[2]

    def _turn_about(self, rows: Rows) -> None:
        """Vehicles `rows` (k,) have their front where their back was; they move as before.

        Front and back of a car look alike: a CV edge that contradicts the heading by more than a right angle says
        which end is the front, and leaves the motion as it is.
        """
        sign = np.ones(len(self.P))
        sign[self.layout.twists[rows, :2].ravel()] = -1.0
        self.P *= sign[:, None] * sign
        self.heading[self.nodes + rows] *= -1.0
        self.velocity[rows] *= -1.0

    # --- vehicles come and go ---

    def place(self, rows: Rows, poses: Floats, covs: Floats, twist_cov: Floats) -> None:
        """Vehicles `rows` (k,) begin anew at `poses` (k, 3) in ego, at rest give or take, independent of all else."""
        self.at[self.nodes + rows] = poses[:, 0] + 1j * poses[:, 1]
        self.heading[self.nodes + rows] = unit(poses[:, 2])
        self._renew(self.layout.poses[rows], turned(covs, self.heading[self.nodes + rows]))
        self.retwist(rows, np.zeros(len(rows), dtype=np.complex128), np.zeros(len(rows)), twist_cov)

    def retwist(self, rows: Rows, velocity: Complexes, turn_radps: Floats, covs: Floats) -> None:
        """Vehicles `rows` (k,) get new twists with `covs` (k, 3, 3), independent of all else; their poses stay."""
        self.velocity[rows], self.turn_radps[rows] = velocity, turn_radps
        self._renew(self.layout.twists[rows], covs)

    def _renew(self, states: Rows, covs: Floats) -> None:
        """The numbers `states` (k, 3) of the state get covariances `covs` (k, 3, 3), and no correlation with others."""
        every = states.ravel()
        self.P[every] = 0.0
        self.P[:, every] = 0.0
        self.P[states[:, :, None], states[:, None, :]] = covs

    def select(self, rows: Rows) -> None:
        """Keeps the vehicles `rows` in that order; -1 makes room for a new one, to be placed next."""
        kept, n, M = np.flatnonzero(rows >= 0), self.nodes, len(rows)
        before, old, self.layout = self.layout, rows[kept], StateLayout(n, M)
        egos = np.arange(before.ego_poses.stop)
        source = np.concatenate([egos, before.of_vehicles[old].ravel()])
        target = np.concatenate([egos, self.layout.of_vehicles[kept].ravel()])
        P = np.zeros((self.layout.size, self.layout.size))
        P[np.ix_(target, target)] = self.P[np.ix_(source, source)]
        at, heading = np.zeros(n + M, dtype=np.complex128), np.ones(n + M, dtype=np.complex128)
        velocity, turn_radps = np.zeros(M, dtype=np.complex128), np.zeros(M)
        at[:n], at[n + kept] = self.at[:n], self.at[n + old]
        heading[:n], heading[n + kept] = self.heading[:n], self.heading[n + old]
        velocity[kept], turn_radps[kept] = self.velocity[old], self.turn_radps[old]
        self.P, self.at, self.heading, self.velocity, self.turn_radps = P, at, heading, velocity, turn_radps


def _se2(at: complex, heading: complex) -> SE2:
    return SE2(float(at.real), float(at.imag), cmath.phase(heading))


def _against(G: Floats, at: Complexes) -> None:
    """To the first rows of each of `G` (N, 3 or more, 3): how poses `at` (N,) move when the ego that they are told from
    does."""
    G[:, 0, 0] = G[:, 1, 1] = G[:, 2, 2] = -1.0
    G[:, 0, 2] = at.imag
    G[:, 1, 2] = -at.real


def _add_noise(S: Floats, cost: Cost, cv_edges: int, gate: float) -> list[int]:
    """Adds the edges' covariances to that of their residuals, `S`: of CV edges past `gate` more than their own.

    The first `cv_edges` of the blocks are CV. Returns which of them are outliers.
    """
    blocks = diagonal_blocks(S, 0, len(cost.covs), 3)
    blocks += cost.covs
    blocks += _LEAST
    outliers: list[int] = []
    if cv_edges:
        distances = pose_costs(cost.residual[: 3 * cv_edges], blocks[:cv_edges])
        if distances.max() > gate:
            left_out = distances > 4.0 * gate
            outliers = np.flatnonzero(left_out).tolist()
            excess = np.where(left_out, 1.0, inflation(distances, gate))
            more = (excess - 1.0)[:, None, None] * cost.covs[:cv_edges]
            blocks[:cv_edges] += more + left_out[:, None, None] * _LEFT_OUT
    if cost.cp_cov is not None:
        S[-2:, -2:] += cost.cp_cov + _LEAST[:2, :2]
    return outliers
