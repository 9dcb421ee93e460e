"""The window of the pose graph: the joint Gaussian of the newest poses, moved on once a frame.

It has the newest ego pose in the world, a few ego poses before it, each vehicle's newest pose and its twist. Poses that
leave it are marginalised: in covariance form their rows are dropped, which is exact. All poses but the first are
*relative to the newest ego*, and so are their errors, in its axes; docs/method.md ("The window") has the state, its
charts and the reasons. Positions are complex numbers x + iy in metres and headings unit complex numbers e^(i yaw);
P is an array and takes few calls of numpy, the mean, a dozen poses, is Python's own numbers.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence

import msgspec
import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.constant_twist import advance
from birdslam.geometry.se2 import SE2
from birdslam.graph.costs import Complexes, Cov, Rows
from birdslam.graph.state_layout import EGO, StateLayout, diagonal

KEY_NODE = 0  # the ego node that landmarks are tied to; it is renewed once in every round of the nodes
KEY_PLACE = [3 * KEY_NODE + 3, 3 * KEY_NODE + 4]  # the rows of its place
EGO_PLACE = [0, 1]


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


_MEANS = {"at": np.complex128, "heading": np.complex128, "velocity": np.complex128, "turn_radps": np.float64}


class Window:
    """The joint Gaussian of one epoch, which begins at `frame`. `nodes` ego poses are kept beside the newest."""

    def __init__(self, nodes: int, frame: int) -> None:
        self.nodes = nodes
        self.frame = frame
        self.node_frames: list[int | None] = [None] * nodes
        self.next_node = 0  # where the newest ego pose goes when the ego moves on
        self.world = SE2()  # T_world_ego
        # Poses in ego, of the ego nodes and then the vehicles; twists of the vehicles
        self.at = [0j] * nodes
        self.heading = [1.0 + 0j] * nodes
        self.velocity: list[complex] = []  # in the vehicle's own frame, m/s
        self.turn_radps: list[float] = []
        self.layout = StateLayout.of(nodes, 0)
        self.P = np.zeros((self.layout.size, self.layout.size))

    def state(self) -> WindowState:
        """For `from_state`; P is the window's own."""
        fields = {name: getattr(self, name) for name in WindowState.__struct_fields__}
        return WindowState(**fields | {name: np.array(fields[name], kind) for name, kind in _MEANS.items()})

    @staticmethod
    def from_state(state: WindowState) -> Window:
        """The window that had this state. Raises ValueError where its arrays do not belong together."""
        nodes, M = len(state.node_frames), len(state.velocity)
        layout = StateLayout.of(nodes, M)
        sizes = len(state.at), len(state.heading), len(state.turn_radps), state.P.shape
        if sizes != (nodes + M, nodes + M, M, (layout.size, layout.size)) or not 0 <= state.next_node < nodes:
            raise ValueError(f"a window of {nodes} nodes and {M} vehicles with arrays of {sizes}")
        window = Window(nodes, state.frame)
        for name in WindowState.__struct_fields__:
            value = getattr(state, name)
            setattr(window, name, value.tolist() if name in _MEANS else value)
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
        return math.isfinite(sum(diagonal(self.P).tolist()))

    @property
    def is_keyframe(self) -> bool:
        """Whether the newest ego pose is going to be the key node: one frame in `nodes`."""
        return self.next_node == KEY_NODE

    def key_node(self) -> tuple[complex, complex, Floats]:
        """The key node's place and heading in ego, and the covariance (2, 2) of its place."""
        rows = StateLayout.node(KEY_NODE)
        return self.at[KEY_NODE], self.heading[KEY_NODE], self.P[rows, rows][:2, :2]

    def has_pose(self, frame: int) -> bool:
        """Whether a CC edge can start at `frame`: the newest, or a node that the newest will not take the place of."""
        return frame == self.frame or (frame in self.node_frames and frame != self.node_frames[self.next_node])

    # --- from frame to frame ---

    def propagate(
        self,
        motion: SE2,
        cov: Floats,
        from_frame: int,
        to_frame: int,
        dt_s: Sequence[float],
        twist_growth: Sequence[float],
    ) -> SE2:
        """The ego goes by `motion` with `cov` (3, 3) since the known frame `from_frame`: the CC edge of Eq. 2.

        Each vehicle drives on for its `dt_s` (M,) with the twist it has, whose variances grow by `twist_growth` (3,)
        a second: the constant-velocity factor. A vehicle with `dt_s` 0 stays at the pose it was last seen at. Returns
        how far the ego went since the newest frame.
        """
        node = self._replace_oldest_node()
        base = self.node_frames.index(from_frame)
        T_ego_next = motion if base == node else _se2(self.at[base], self.heading[base]) @ motion
        self.world = self.world @ T_ego_next  # Eq. 2, of a CC edge with the residual zero
        back = cmath.rect(1.0, -T_ego_next.yaw_rad)
        F = self._move_poses(T_ego_next, back, dt_s)
        if any(twist_growth):
            of_vehicles = diagonal(self.P)[self.layout.vehicles].reshape(-1, 6)
            of_vehicles[:, 3:] += np.array(dt_s)[:, None] * twist_growth
        if node == 0:  # now and then, so that rounding can't add up
            self.P += self.P.T.copy()
            self.P *= 0.5
            self.heading = [heading / abs(heading) for heading in self.heading]
        self._move_errors(T_ego_next, back, F)
        self._add_motion_noise(cov, None if base == node else base)
        self.frame, self.next_node = to_frame, (node + 1) % self.nodes
        return T_ego_next

    def _replace_oldest_node(self) -> int:
        """The newest ego pose takes the place of the oldest node, which is marginalised; which node that is."""
        node = self.next_node
        rows = StateLayout.node(node)
        self.at[node], self.heading[node] = 0j, 1.0 + 0j  # relative to the newest ego pose, which it still is itself
        self.P[rows] = self.P[:, rows] = 0.0  # and so without error
        self.node_frames[node] = self.frame
        return node

    def _move_poses(self, T_ego_next: SE2, back: complex, dt_s: Sequence[float]) -> Floats:
        """All poses, relative to the next ego pose, whose axes are turned by `back`; vehicles drive on.

        Returns (M, 3, 6) how the errors of a vehicle's pose and twist move its next pose.
        """
        step, n = complex(T_ego_next.x_m, T_ego_next.y_m), self.nodes
        at = [(before - step) * back for before in self.at]
        heading = [before * back for before in self.heading]
        c, s = back.real, back.imag
        rows: list[float] = []
        for k, (velocity, turn_radps, passed_s) in enumerate(zip(self.velocity, self.turn_radps, dt_s, strict=True), n):
            way, heading[k], g, d = advance(heading[k], velocity, turn_radps, passed_s)
            at[k] += way
            rows += (c, -s, -way.imag, g.real, -g.imag, d.real)
            rows += (s, c, way.real, g.imag, g.real, d.imag)
            rows += (0.0, 0.0, 1.0, 0.0, 0.0, passed_s)
        self.at, self.heading = at, heading
        return np.fromiter(rows, np.float64, len(rows)).reshape(-1, 3, 6)

    def _move_errors(self, T_ego_next: SE2, back: complex, F: Floats) -> None:
        """P of the moved poses: J P J', where J is block-diagonal."""
        egos, vehicles, size = self.layout.ego_poses, self.layout.vehicles, self.layout.size
        T, c, s = T_ego_next.inverse(), back.real, back.imag
        J = np.array((0.0, 1.0, c, s, -s, T.y_m, -T.x_m)).take(self.layout.ego_moves)
        P = self.P
        for _ in range(2):  # J P, and then J (J P)' = J P J'
            out = np.empty((size, size))
            np.matmul(J, P[egos], out[egos])
            of_vehicles, moved = P[vehicles].reshape(-1, 6, size), out[vehicles].reshape(-1, 6, size)
            np.matmul(F, of_vehicles, moved[:, :3])
            moved[:, 3:] = of_vehicles[:, 3:]
            P = out.T
        self.P = out

    def _add_motion_noise(self, cov: Floats, base: int | None) -> None:
        """The noise of the ego's motion `cov` (3, 3) moves all that is relative to the ego.

        So does, where the motion did not start at the newest pose but at the node `base`, the error of that node.
        """
        P, layout, at = self.P, self.layout, np.array(self.at)
        G = layout.against.copy()
        G[layout.x_rows, 2] = at.imag
        G[layout.y_rows, 2] = -at.real
        if base is not None:
            there = StateLayout.node(base)
            G_base = G @ np.linalg.inv(-G[there])
            P = P + G_base @ P[there] + (G_base @ P[there]).T + G_base @ P[there, there] @ G_base.T
        P += G @ cov @ G.T
        self.P = P

    def drift(self, along: complex, variance: float, across_variance: float) -> None:
        """The ego, and with it all that is relative to it, may have come this much further in the world than its edge
        says.

        `along` is the direction in ego, of length 1, the variances along it and across it are in m^2. Between what is
        in sight nothing changes.
        """
        c, s = along.real, along.imag
        self.P[:2, :2] += variance * np.outer((c, s), (c, s)) + across_variance * np.outer((-s, c), (-s, c))

    def turn_drift(self, variance: float) -> None:
        """The ego, and with it all that is relative to it, may have turned this much more in the world (rad^2)."""
        self.P[2, 2] += variance

    # --- corrections ---

    def shift(self, dx: Sequence[float]) -> None:
        """Moves the mean by `dx` (n,)."""
        self.world = self.world @ SE2(*dx[:3])
        at, heading, velocity, turn_radps = self.at, self.heading, self.velocity, self.turn_radps
        for k, i in enumerate(self.layout.poses_firsts):
            at[k] += complex(dx[i], dx[i + 1])
            heading[k] *= cmath.rect(1.0, dx[i + 2])
        for row, i in enumerate(self.layout.firsts):
            velocity[row] += complex(dx[i + 3], dx[i + 4])
            turn_radps[row] += dx[i + 5]

    def flip_headings(self, rows: Sequence[int]) -> None:
        """Vehicles `rows` (k,) have their front where their back was, and move as before: front and back look alike."""
        sign = np.ones(len(self.P))
        sign[self.layout.twists[rows, :2].ravel()] = -1.0
        self.P *= sign[:, None] * sign
        for row in rows:
            self.heading[self.nodes + row] *= -1.0
            self.velocity[row] *= -1.0

    # --- vehicles come and go ---

    def place_vehicle(self, row: int, at: complex, heading: complex, cov: Cov, twist_cov: Floats) -> None:
        """The vehicle `row` begins anew in ego, with `cov` in the ego's axes, at rest give or take, independent of all
        else."""
        self.at[self.nodes + row], self.heading[self.nodes + row] = at, heading
        self._renew(self.layout.poses[[row]], np.reshape(cov, (3, 3)))
        self.set_twists([row], [(0j, 0.0)], twist_cov)

    def set_twists(self, rows: Sequence[int], twists: Sequence[tuple[complex, float]], covs: Floats) -> None:
        """Vehicles `rows` (k,) get new twists with `covs` (k, 3, 3), independent of all else; their poses stay."""
        for row, (velocity, turn_radps) in zip(rows, twists, strict=True):
            self.velocity[row], self.turn_radps[row] = velocity, turn_radps
        self._renew(self.layout.twists[rows], covs)

    def _renew(self, numbers: Rows, covs: Floats) -> None:
        """Each three numbers (k, 3) of the state get their covariance (k, 3, 3), and no correlation with others."""
        P, all_of_them = self.P, numbers.reshape(-1)
        P[all_of_them] = 0.0
        P[:, all_of_them] = 0.0
        P[numbers[:, :, None], numbers[:, None]] = covs

    def select(self, rows: Sequence[int]) -> None:
        """Keeps the vehicles `rows` in that order; -1 makes room for a new one, to be placed next."""
        n, before, self.layout = self.nodes, self.layout, StateLayout.of(self.nodes, len(rows))
        kept, old = [k for k, row in enumerate(rows) if row >= 0], [row for row in rows if row >= 0]
        egos = np.arange(before.ego_poses.stop)
        source = np.concatenate([egos, before.of_vehicles[old].ravel()])
        target = np.concatenate([egos, self.layout.of_vehicles[kept].ravel()])
        P = np.zeros((self.layout.size, self.layout.size))
        P[np.ix_(target, target)] = self.P[np.ix_(source, source)]
        self.P = P
        self.at = self.at[:n] + [0j if row < 0 else self.at[n + row] for row in rows]
        self.heading = self.heading[:n] + [1.0 + 0j if row < 0 else self.heading[n + row] for row in rows]
        self.velocity = [0j if row < 0 else self.velocity[row] for row in rows]
        self.turn_radps = [0.0 if row < 0 else self.turn_radps[row] for row in rows]


def _se2(at: complex, heading: complex) -> SE2:
    return SE2(at.real, at.imag, cmath.phase(heading))
