"""The sliding window of the pose graph: the joint Gaussian of the newest poses, propagated once a frame.

Its state is the newest ego pose in world, a few earlier ego poses, and the newest pose and twist of each vehicle. Older
poses are marginalized: in covariance form their rows are dropped, which is exact. All poses but the first, and their
errors, are *relative to the newest ego*; docs/method.md ("The window") has the state and its charts. Positions are
complex numbers x + iy in metres and headings unit complex numbers e^(i yaw).
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Complexes, Floats
from birdslam.geometry.constant_twist import advance
from birdslam.geometry.se2 import SE2
from birdslam.graph.edges import CvEdges
from birdslam.graph.state_layout import EGO, LASTING, OF_VEHICLE, POSE, TWIST, StateLayout

KEY_NODE = 0  # the ego node to which landmarks are anchored; it is replaced once in `nodes` frames
KEY_PLACE = [3 * KEY_NODE + 3, 3 * KEY_NODE + 4]  # the rows of its place
EGO_PLACE = [0, 1]
PLACE = slice(POSE.start, POSE.start + 2)  # position, of the state of a vehicle


class WindowState(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The state of a `Window`, for checkpoints."""

    frame: int
    node_frames: list[int | None]
    next_node: int
    world: SE2
    at: Complexes
    heading: Complexes
    velocity: Complexes
    turn_radps: Floats
    sigma_rel: Floats
    of_egos: Floats
    with_egos: Floats
    of_vehicles: Floats


class Window:
    """The joint Gaussian of one epoch, which begins at `frame`, with `nodes` earlier ego poses.

    The covariance P is stored in three parts: ego poses, vehicles with ego poses, and vehicles. If `together`, edges
    connect vehicles, and the last part is one block. Else it has a block for each vehicle, without the correlation
    between vehicles, which nothing reads: docs/method.md ("Vehicles and the ego").
    """

    def __init__(self, nodes: int, frame: int, together: bool = False) -> None:
        self.nodes = nodes
        self.frame = frame
        self.node_frames: list[int | None] = [None] * nodes
        self.next_node = 0  # the node that the newest ego pose replaces in the next frame
        self.world = SE2()  # T_world_ego
        # Poses in ego, of the ego nodes and then the vehicles; twists of the vehicles
        self.at = np.zeros(nodes, np.complex128)
        self.heading = np.ones(nodes, np.complex128)
        self.velocity = np.zeros(0, np.complex128)  # in the vehicle's own frame, m/s
        self.turn_radps = np.zeros(0)
        # (M, 2) 1-sigma of each vehicle's last CV edge along and across the line of sight, fractions of its distance
        self.sigma_rel = np.zeros((0, 2))
        self.layout = StateLayout.of(nodes, 0)
        self.together = together
        self.of_egos = np.zeros((self.layout.size, self.layout.size))  # (E, E)
        self.with_egos = np.zeros((0, OF_VEHICLE, self.layout.size))  # (M, 8, E)
        # (B, 8k, 8k): one block of k = M vehicles together, or B = M blocks of one
        self.of_vehicles = np.zeros((1, 0, 0) if together else (0, OF_VEHICLE, OF_VEHICLE))

    def state(self) -> WindowState:
        """Returns the state for `from_state`, without a copy of the arrays."""
        return WindowState(**{name: getattr(self, name) for name in WindowState.__struct_fields__})

    @staticmethod
    def from_state(state: WindowState, together: bool) -> Window:
        """Returns the window of this state. Raises ValueError for inconsistent shapes."""
        nodes, M = len(state.node_frames), len(state.velocity)
        layout, window = StateLayout.of(nodes, M), Window(nodes, state.frame, together)
        E, n = layout.ego_poses.stop, OF_VEHICLE * M
        sizes = len(state.at), len(state.heading), len(state.turn_radps), len(state.sigma_rel)
        shapes = state.of_egos.shape, state.with_egos.shape, state.of_vehicles.shape
        blocks = (1, n, n) if together else (M, OF_VEHICLE, OF_VEHICLE)
        fit = sizes == (nodes + M, nodes + M, M, M) and shapes == ((E, E), (M, OF_VEHICLE, E), blocks)
        if not fit or not 0 <= state.next_node < nodes:
            raise ValueError(f"a window of {nodes} nodes and {M} vehicles with arrays of {sizes}, {shapes}")
        for name in WindowState.__struct_fields__:
            setattr(window, name, getattr(state, name))
        window.layout = layout
        return window

    # --- read access ---

    @property
    def ego_cov(self) -> Floats:
        """(3, 3) of the newest ego pose, a view."""
        return self.of_egos[EGO, EGO]

    @property
    def each_vehicle(self) -> Floats:
        """Covariances (M, 8, 8) of the vehicles' states."""
        if not self.together:
            return self.of_vehicles
        M = len(self.velocity)
        return np.einsum("isit->ist", self.of_vehicles.reshape(M, OF_VEHICLE, M, OF_VEHICLE))

    @property
    def _variances(self) -> Floats:
        """Variances (M, 8) of the vehicles' states, a view."""
        B, n, _ = self.of_vehicles.shape
        return self.of_vehicles.reshape(B, n * n)[:, :: n + 1].reshape(-1, OF_VEHICLE)

    @property
    def P(self) -> Floats:
        """A copy (n, n) of the whole covariance; without `together`, zero between vehicles."""
        n = self.layout.ego_poses.stop
        P = np.zeros((self.layout.size, self.layout.size))
        P[:n, :n] = self.of_egos
        P[n:, :n] = self.with_egos.reshape(-1, n)
        P[:n, n:] = P[n:, :n].T
        if self.together:
            P[n:, n:] = self.of_vehicles[0]
        else:
            for first, block in zip(range(n, len(P), OF_VEHICLE), self.of_vehicles, strict=True):
                P[first : first + OF_VEHICLE, first : first + OF_VEHICLE] = block
        return P

    def set_P(self, P: Floats) -> None:
        """Sets the whole covariance of a window with `together`."""
        n = self.layout.ego_poses.stop
        self.of_egos = P[:n, :n].copy()
        self.with_egos = P[n:, :n].copy().reshape(-1, OF_VEHICLE, n)
        self.of_vehicles = P[None, n:, n:].copy()

    @property
    def is_finite(self) -> bool:
        """Whether all variances are finite; else the window must be restarted."""
        return math.isfinite(self.of_egos.trace() + self._variances.sum())

    @property
    def is_keyframe(self) -> bool:
        """Whether the newest ego pose becomes the key node: one frame in `nodes`."""
        return self.next_node == KEY_NODE

    def key_node(self) -> tuple[complex, complex, Floats]:
        """Returns position and heading of the key node in ego, and the covariance (2, 2) of its position."""
        rows = StateLayout.node(KEY_NODE)
        return complex(self.at[KEY_NODE]), complex(self.heading[KEY_NODE]), self.of_egos[rows, rows][:2, :2]

    def has_pose(self, frame: int) -> bool:
        """Whether a CC edge can start at `frame`: the newest pose, or a node that it does not replace."""
        return frame == self.frame or (frame in self.node_frames and frame != self.node_frames[self.next_node])

    # --- propagation ---

    def motion_since_newest(self, motion: SE2, from_frame: int) -> SE2:
        """Returns the ego's motion since the newest frame, from that since `from_frame`, a pose of the window."""
        if from_frame == self.frame:
            return motion
        base = self.node_frames.index(from_frame)
        return _se2(self.at[base], self.heading[base]) @ motion

    def propagate(
        self,
        motion: SE2,
        cov: Floats,
        from_frame: int,
        to_frame: int,
        dt_s: Floats,
        twist_growth: Sequence[float],
        kept: Floats | None = None,
    ) -> None:
        """Propagates the ego by `motion`, since the newest frame: the CC edge of Eq. 2.

        The edge, with `cov` (3, 3), starts at the frame `from_frame`. Each vehicle is propagated over `dt_s` (M,) with
        its twist, whose variances grow by `twist_growth` (3,) per second: the constant-velocity factor. A vehicle with
        `dt_s` 0 keeps its pose. Of the lasting errors the fractions `kept` (M, 2) remain, the rest is new.
        """
        node = self._replace_oldest_node()
        self.world = self.world @ motion  # Eq. 2 with residual zero
        F = self._move_poses(motion, dt_s)
        if kept is not None:
            F[:, LASTING, LASTING] *= kept[:, None]
        if node == 0:  # once in `nodes` frames, against the accumulation of rounding errors
            self.of_egos = 0.5 * (self.of_egos + self.of_egos.T)
            self.of_vehicles = 0.5 * (self.of_vehicles + self.of_vehicles.transpose(0, 2, 1))
            self.heading /= np.abs(self.heading)
        if any(twist_growth) and len(dt_s):
            self._variances[:, TWIST] += dt_s[:, None] * twist_growth
        J, base = self._ego_transition(motion, node), self.node_frames.index(from_frame)
        if base == node:
            self._move_errors(J, F, cov)
        else:
            self._move_errors(J, F, np.zeros((3, 3)))
            self._add_motion_noise(J[:, :3], F[:, :, OF_VEHICLE:], cov, base)
        if kept is not None:
            self._variances[:, LASTING] = 1.0
        self.frame, self.next_node = to_frame, (node + 1) % self.nodes

    def _replace_oldest_node(self) -> int:
        """Replaces the oldest node, which is marginalized, by the newest ego pose; returns the index of the node.

        Its error is set in `_ego_transition`.
        """
        node = self.next_node
        self.at[node], self.heading[node] = 0j, 1.0 + 0j  # relative to the newest ego pose, which is the same
        self.node_frames[node] = self.frame
        return node

    def _move_poses(self, T_ego_next: SE2, dt_s: Floats) -> Floats:
        """Expresses all poses relative to the next ego pose and propagates vehicles.

        Returns the derivatives (M, 8, 11) of each vehicle's next state by its state and by the ego's motion.
        """
        n, back = self.nodes, cmath.rect(1.0, -T_ego_next.yaw_rad)
        self.at = (self.at - complex(T_ego_next.x_m, T_ego_next.y_m)) * back
        self.heading = self.heading * back
        if not len(dt_s):
            return self.layout.vehicles_stay
        way, self.heading[n:], g, d = advance(self.heading[n:], self.velocity, self.turn_radps, dt_s)
        self.at[n:] += way
        F = self.layout.vehicles_stay.copy()
        place = np.zeros((len(F), F.shape[2]), np.complex128)  # x + iy of the next place
        place[:, :2], place[:, 2] = (back, 1j * back), 1j * way  # by the pose
        place[:, 3], place[:, 4], place[:, 5] = g, 1j * g, d  # by the twist
        place[:, 8:10], place[:, 10] = (-1.0, -1j), -1j * self.at[n:]  # by the ego's motion
        F[:, :2] = place.view(np.float64).reshape(*place.shape, 2).transpose(0, 2, 1)
        F[:, 2, 5] = dt_s
        return F

    def _ego_transition(self, T_ego_next: SE2, node: int) -> Floats:
        """Returns the derivatives (E, 3 + E) of the next ego poses by the ego's motion and by the ego poses.

        The replaced `node` starts without error.
        """
        T, turn = T_ego_next.inverse(), T_ego_next.yaw_rad
        c, s = math.cos(turn), -math.sin(turn)
        at = self.at[: self.nodes]
        values = 0.0, 1.0, -1.0, c, s, -s, T.y_m, -T.x_m, *at.imag.tolist(), *(-at.real).tolist()
        return np.array(values).take(self.layout.ego_moves[node])

    def _move_errors(self, J: Floats, F: Floats, cov: Floats) -> None:
        """Propagates P with the transitions of ego poses and vehicles, and the noise `cov` (3, 3) of the ego's motion.

        The motion is a further state with this covariance, which all poses relative to the ego have in common.
        """
        E, (B, size, _) = len(J), self.of_vehicles.shape
        P = np.zeros((3 + E, 3 + E))
        P[:3, :3], P[3:, 3:] = cov, self.of_egos
        self.of_egos = J @ P @ J.T
        if not len(F):
            return
        M, n = F.shape[0], F.shape[2]
        C = np.zeros((M, n, 3 + E))
        C[:, :OF_VEHICLE, 3:], C[:, OF_VEHICLE:, :3] = self.with_egos, cov
        self.with_egos = ((F @ C).reshape(-1, 3 + E) @ J.T).reshape(M, OF_VEHICLE, E)
        if not self.together:
            V = np.zeros((M, n, n))
            V[:, :OF_VEHICLE, :OF_VEHICLE], V[:, OF_VEHICLE:, OF_VEHICLE:] = self.of_vehicles, cov
            self.of_vehicles = F @ V @ F.transpose(0, 2, 1)
            return
        F, G = F[:, :, :OF_VEHICLE], np.ascontiguousarray(F[:, :, OF_VEHICLE:]).reshape(size, 3)
        FV = (F @ self.of_vehicles.reshape(M, OF_VEHICLE, size)).reshape(size, size)
        moved = (F @ FV.T.reshape(M, OF_VEHICLE, size)).reshape(size, size)  # F (F V)' = F V F'
        self.of_vehicles = (moved + G @ cov @ G.T).reshape(B, size, size)

    def _add_motion_noise(self, G: Floats, G_vehicles: Floats, cov: Floats, base: int) -> None:
        """Adds the noise `cov` (3, 3) of a motion that starts at the node `base`, and the error of that node.

        `G` (E, 3) and `G_vehicles` (M, 8, 3) are the derivatives of the states by the ego's motion.
        """
        B, size, _ = self.of_vehicles.shape
        there = StateLayout.node(base)
        of_node = np.linalg.inv(-G[there])
        G_base, G_base_vehicles = G @ of_node, G_vehicles @ of_node
        moved = (G, G_vehicles, cov), (G_base, G_base_vehicles, self.of_egos[there, there].copy())
        in_common, with_node = self.with_egos[:, :, there], self.of_egos[there].copy()
        more = G_base_vehicles.reshape(B, size, 3) @ in_common.reshape(B, size, 3).transpose(0, 2, 1)
        self.of_vehicles += more + more.transpose(0, 2, 1)
        self.with_egos = self.with_egos + G_base_vehicles @ with_node + in_common @ G_base.T
        more = G_base @ with_node
        self.of_egos += more + more.T
        for of_egos, of_vehicles, C in moved:
            self.of_egos += of_egos @ C @ of_egos.T
            self.with_egos += of_vehicles @ C @ of_egos.T
            blocks = of_vehicles.reshape(B, size, 3)
            self.of_vehicles += blocks @ C @ blocks.transpose(0, 2, 1)

    def drift(self, along: complex, variance: float, across_variance: float) -> None:
        """Adds variances (m^2) along and across the unit vector `along` in ego to the position of the ego in world.

        Poses relative to the ego do not change.
        """
        c, s = along.real, along.imag
        xy = (variance - across_variance) * c * s
        xx, yy = variance * c * c + across_variance * s * s, variance * s * s + across_variance * c * c
        self.of_egos[:2, :2] += ((xx, xy), (xy, yy))

    def turn_drift(self, variance: float) -> None:
        """Adds a variance (rad^2) to the yaw of the ego in world."""
        self.of_egos[2, 2] += variance

    # --- corrections ---

    def shift_egos(self, dx: Floats) -> None:
        """Adds `dx` (E,) to the ego poses."""
        self.world = self.world @ SE2(*dx[:3].tolist())
        n = self.nodes
        self.at[:n] += dx[3::3] + 1j * dx[4::3]
        self.heading[:n] *= np.exp(1j * dx[5::3])

    def shift_vehicles(self, rows: Sequence[int] | slice, dx: Floats) -> None:
        """Adds `dx` (k, 8) to the means of vehicles `rows` (k,), each listed once."""
        self.at[self.nodes :][rows] += dx[:, 0] + 1j * dx[:, 1]
        self.heading[self.nodes :][rows] *= np.exp(1j * dx[:, 2])
        self.velocity[rows] += dx[:, 3] + 1j * dx[:, 4]
        self.turn_radps[rows] += dx[:, 5]

    def shift(self, dx: Floats) -> None:
        """Adds `dx` (n,) to all means."""
        n = self.layout.ego_poses.stop
        self.shift_egos(dx[:n])
        self.shift_vehicles(slice(None), dx[n:].reshape(-1, OF_VEHICLE))

    def flip_headings(self, rows: Sequence[int]) -> None:
        """Turns vehicles `rows` (k,) by 180 degrees with an unchanged velocity: front and rear look alike."""
        sign = np.ones((len(self.velocity), OF_VEHICLE))
        sign[rows, TWIST.start : TWIST.start + 2] = -1.0
        self.with_egos *= sign[:, :, None]
        sign = sign.reshape(self.of_vehicles.shape[:2])
        self.of_vehicles *= sign[:, :, None] * sign[:, None]
        self.heading[self.nodes :][rows] *= -1.0
        self.velocity[rows] *= -1.0

    # --- addition and removal of vehicles ---

    def place_vehicles(self, seen: CvEdges, twist_covs: Floats, lasting: Floats, sigma_rel: Floats) -> None:
        """Starts vehicles at their detections with zero twist, uncorrelated with all other states.

        `lasting` (k, 2, 2) and `sigma_rel` (k, 2) belong to their edges: lasting_error.py.
        """
        self.at[self.nodes :][seen.rows], self.heading[self.nodes :][seen.rows] = seen.at, seen.heading
        self._renew(seen.rows, POSE, seen.covs)
        self.set_twists(seen.rows, np.zeros(len(seen.rows)), np.zeros(len(seen.rows)), twist_covs)
        self._renew(seen.rows, LASTING, np.eye(2))
        self._relate(seen.rows, PLACE, LASTING, -lasting)  # the position is the edge minus its error
        self.sigma_rel[seen.rows] = sigma_rel

    def set_twists(self, rows: Sequence[int], velocity: Complexes | Floats, turn_radps: Floats, covs: Floats) -> None:
        """Sets the twists of vehicles `rows` (k,) with `covs` (k, 3, 3), uncorrelated with all other states."""
        self.velocity[rows], self.turn_radps[rows] = velocity, turn_radps
        self._renew(rows, TWIST, covs)

    def _renew(self, rows: Sequence[int], numbers: slice, covs: Floats) -> None:
        """Sets the covariance (k, n, n) of these states of each vehicle, without correlations."""
        self.with_egos[rows, numbers] = 0.0
        V, block, within = self._by_vehicle(rows)
        V[block, within, numbers] = 0.0
        V[block, :, :, within, numbers] = 0.0
        V[block, within, numbers, within, numbers] = covs

    def _relate(self, rows: Sequence[int], numbers: slice, others: slice, covs: Floats) -> None:
        """Sets the covariances (k, n, m) between two groups of states of each vehicle."""
        V, block, within = self._by_vehicle(rows)
        V[block, within, numbers, within, others] = covs
        V[block, within, others, within, numbers] = covs.transpose(0, 2, 1)

    def _by_vehicle(self, rows: Sequence[int]) -> tuple[Floats, Any, Any]:
        """Returns a view (B, k, 8, k, 8) of `of_vehicles`, and block and index within the block of vehicles `rows`."""
        B, size, _ = self.of_vehicles.shape
        V = self.of_vehicles.reshape(B, size // OF_VEHICLE, OF_VEHICLE, size // OF_VEHICLE, OF_VEHICLE)
        return (V, 0, rows) if self.together else (V, rows, 0)

    def select(self, rows: Sequence[int]) -> None:
        """Keeps the vehicles `rows` in this order; -1 reserves a row for a new one (`place_vehicles`)."""
        n, M = self.nodes, len(rows)
        kept, old = [k for k, row in enumerate(rows) if row >= 0], [row for row in rows if row >= 0]
        before_V, self.layout = self.of_vehicles, StateLayout.of(n, M)
        self.at = np.concatenate([self.at[:n], _selected(self.at[n:], kept, old, M, 0.0)])
        self.heading = np.concatenate([self.heading[:n], _selected(self.heading[n:], kept, old, M, 1.0)])
        self.velocity = _selected(self.velocity, kept, old, M, 0.0)
        self.turn_radps = _selected(self.turn_radps, kept, old, M, 0.0)
        self.sigma_rel = _selected(self.sigma_rel, kept, old, M, 0.0)
        self.with_egos = _selected(self.with_egos, kept, old, M, 0.0)
        if not self.together:
            self.of_vehicles = _selected(before_V, kept, old, M, 0.0)
            return
        of_vehicle = np.arange(OF_VEHICLE)
        source, target = ((OF_VEHICLE * np.array([k], np.int64).T + of_vehicle).ravel() for k in (old, kept))
        self.of_vehicles = np.zeros((1, OF_VEHICLE * M, OF_VEHICLE * M))
        self.of_vehicles[0][np.ix_(target, target)] = before_V[0][np.ix_(source, source)]


def _selected(numbers: NDArray[Any], kept: Sequence[int], old: Sequence[int], M: int, new: float) -> NDArray[Any]:
    """Returns (M, ...) with rows `old` of `numbers` at `kept`, and the value `new` elsewhere."""
    out = np.full((M, *numbers.shape[1:]), new, numbers.dtype)
    out[kept] = numbers[old]
    return out


def _se2(at: complex, heading: complex) -> SE2:
    return SE2(float(at.real), float(at.imag), cmath.phase(heading))
