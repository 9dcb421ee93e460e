"""Where the state vector of the window, and so the rows and columns of its covariance P, holds what.

[ego in world (3) | ego nodes (3 each) | vehicles (3 of the pose and 3 of the twist each)]
"""

from __future__ import annotations

import numpy as np

from birdslam.geometry.planar import Floats

EGO = slice(0, 3)


class StateLayout:
    """Of `nodes` ego nodes and `vehicles` vehicles."""

    def __init__(self, nodes: int, vehicles: int) -> None:
        first = 3 + 3 * nodes  # of the vehicles
        self.size = first + 6 * vehicles
        self.ego_poses = slice(0, first)  # the newest and the nodes
        self.nodes = slice(3, first)
        self.vehicles = slice(first, self.size)
        self.of_vehicles = first + np.arange(6 * vehicles, dtype=np.int64).reshape(vehicles, 6)  # (M, 6)
        self.poses, self.twists = self.of_vehicles[:, :3], self.of_vehicles[:, 3:]  # (M, 3) each
        self.twist_rows = self.twists.ravel()
        # (nodes + M, 3) of all poses but the newest ego's
        self.moved = np.concatenate([3 + np.arange(3 * nodes, dtype=np.int64).reshape(nodes, 3), self.poses])
        own = np.empty((vehicles, 9), dtype=np.int64)
        own[:, :3] = np.arange(3)
        own[:, 3:] = self.of_vehicles
        self.own = own[:, :, None], own[:, None, :]  # of (M, 9, 9): the ego's and each vehicle's own part of P

    @staticmethod
    def node(k: int) -> slice:
        """The rows of an ego node."""
        return slice(3 + 3 * k, 6 + 3 * k)


def diagonal(P: Floats) -> Floats:
    """(n,) view of the diagonal of `P` (n, n), which is C-contiguous; numpy's own is read-only."""
    return P.reshape(-1)[:: len(P) + 1]


def diagonal_blocks(A: Floats, first: int, count: int, size: int) -> Floats:
    """(count, size, size) view of the blocks on the diagonal of `A` that begin at `first` and every third row after it.

    numpy's as_strided makes the same view, but takes several microseconds for it, this less than one.
    """
    row, column = A.strides
    return np.ndarray((count, size, size), np.float64, A, first * (row + column), (3 * (row + column), row, column))
