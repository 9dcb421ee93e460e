"""Where the state vector of the window, and so the rows and columns of its covariance P, holds what.

[ego in world (3) | ego nodes (3 each) | vehicles (3 of the pose and 3 of the twist each)]
"""

from __future__ import annotations

import functools

import numpy as np

from birdslam.geometry.arrays import Floats

EGO = slice(0, 3)


class StateLayout:
    """Of `nodes` ego nodes and `vehicles` vehicles."""

    def __init__(self, nodes: int, vehicles: int) -> None:
        first = 3 + 3 * nodes  # of the vehicles
        self.size = first + 6 * vehicles
        self.ego_poses = slice(0, first)  # the newest and the nodes
        self.vehicles = slice(first, self.size)
        self.firsts = range(first, self.size, 6)  # rows of the vehicles: three of the pose, three of the twist
        self.poses_firsts = (*range(3, first, 3), *self.firsts)  # of all poses but the newest ego's
        of_vehicles = first + np.arange(6 * vehicles, dtype=np.int64).reshape(vehicles, 6)
        self.poses, self.twists = of_vehicles[:, :3], of_vehicles[:, 3:]  # (M, 3) each
        self.of_vehicles = of_vehicles  # (M, 6)
        # Of all poses but the newest ego's, nodes and then vehicles: the rows of their places, and (n, 3) how they move
        # when the ego does that they are relative to, but for the lever of its turn
        moved = np.concatenate([3 + np.arange(3 * nodes, dtype=np.int64).reshape(nodes, 3), self.poses])
        self.x_rows, self.y_rows = moved[:, 0], moved[:, 1]
        self.against = np.zeros((self.size, 3))
        self.against[EGO] = np.eye(3)
        for axis in range(3):
            self.against[moved[:, axis], axis] = -1.0
        # When the newest ego pose moves: where each entry of the Jacobian of the ego poses, its own adjoint and the
        # nodes' turn, stands in (0, 1, cos, sin, -sin, and the lever of the turn, y and -x)
        self.ego_moves = np.zeros((first, first), dtype=np.int64)
        for i in range(0, first, 3):
            self.ego_moves[i : i + 3, i : i + 3] = (2, 4, 0), (3, 2, 0), (0, 0, 1)
        self.ego_moves[:2, 2] = 5, 6
        own = np.empty((vehicles, 9), dtype=np.int64)
        own[:, :3] = np.arange(3)
        own[:, 3:] = of_vehicles
        # (M, 9, 9) of the numbers of P in a row: the ego's and each vehicle's own part
        self.own = own[:, :, None] * self.size + own[:, None, :]
        # (3, M) of them: xx, xy and yy of each vehicle's place
        self.places = np.array([self.own[:, 3, 3], self.own[:, 3, 4], self.own[:, 4, 4]])

    @staticmethod
    @functools.lru_cache(maxsize=64)
    def of(nodes: int, vehicles: int) -> StateLayout:
        """The layout, which nobody may change: vehicles come and go, a few in each number."""
        return StateLayout(nodes, vehicles)

    @staticmethod
    def node(k: int) -> slice:
        """The rows of an ego node."""
        return slice(3 + 3 * k, 6 + 3 * k)


def diagonal(P: Floats) -> Floats:
    """(n,) view of the diagonal of `P` (n, n), which is C-contiguous; numpy's own is read-only."""
    return P.reshape(-1)[:: len(P) + 1]


def diagonal_blocks(A: Floats, first: int, shape: tuple[int, ...]) -> Floats:
    """(k, d, d) view of k blocks on the diagonal of `A`, from row `first` on; `shape` is (k, d, d).

    numpy's as_strided makes the same view, but takes several microseconds for it, this less than one.
    """
    row, column = A.strides
    step = row + column
    return np.ndarray(shape, np.float64, A, first * step, (shape[1] * step, row, column))
