"""Layout of the window's state vector, and so of the rows and columns of its covariance P.

[ego in world (3) | ego nodes (3 each) | vehicles (3 of the pose, 3 of the twist, 2 of the lasting error of its edges)]
"""

from __future__ import annotations

import functools

import numpy as np

from birdslam.geometry.arrays import Floats, Ints

EGO = slice(0, 3)
OF_VEHICLE = 8  # numbers of a vehicle
POSE, TWIST, LASTING = slice(0, 3), slice(3, 6), slice(6, 8)  # of its own numbers


class StateLayout:
    """The layout for `nodes` ego nodes and `vehicles` vehicles."""

    def __init__(self, nodes: int, vehicles: int) -> None:
        first = 3 + 3 * nodes  # of the vehicles
        self.size = first + OF_VEHICLE * vehicles
        self.ego_poses = slice(0, first)  # the newest and the nodes
        of_vehicles = first + np.arange(OF_VEHICLE * vehicles, dtype=np.int64).reshape(vehicles, OF_VEHICLE)
        self.of_vehicles = of_vehicles  # (M, 8)
        self.poses, self.twists = of_vehicles[:, POSE], of_vehicles[:, TWIST]  # (M, 3) each
        # Derivatives of a stationary vehicle's state (M, 8, 11) by itself and by the ego's motion, whose lever arm is
        # zero here: the vehicle is relative to the newest ego
        self.vehicles_stay = np.tile(np.eye(OF_VEHICLE, OF_VEHICLE + 3), (vehicles, 1, 1))
        self.vehicles_stay[:, POSE, OF_VEHICLE:] = -np.eye(3)
        self.ego_moves = [_ego_moves(nodes, node) for node in range(nodes)]

    @staticmethod
    @functools.lru_cache(maxsize=64)
    def of(nodes: int, vehicles: int) -> StateLayout:
        """The cached layout for this number of vehicles; must not be modified."""
        return StateLayout(nodes, vehicles)

    @staticmethod
    def node(k: int) -> slice:
        """The rows of an ego node."""
        return slice(3 + 3 * k, 6 + 3 * k)


def _ego_moves(nodes: int, replaced: int) -> Ints:
    """Index (E, 3 + E) of each derivative of the ego poses by the ego's motion, first, and by the ego poses.

    Into (0, 1, -1, cos, sin, -sin, the lever arm of the turn, y and -x, y of each node, -x of each node). The columns
    of the `replaced` node are zero: it is the newest ego pose, without error relative to it.
    """
    first = 3 + 3 * nodes
    out = np.zeros((first, 3 + first), dtype=np.int64)
    for i in range(0, first, 3):
        out[i : i + 3, 3 + i : 6 + i] = (3, 5, 0), (4, 3, 0), (0, 0, 1)
        out[i : i + 3, :3] = 2 * np.eye(3, dtype=np.int64)
    out[:2, 5] = 6, 7
    out[:3, :3] = np.eye(3, dtype=np.int64)
    for k in range(nodes):
        out[3 + 3 * k, 2], out[4 + 3 * k, 2] = 8 + k, 8 + nodes + k
    out[:, 6 + 3 * replaced : 9 + 3 * replaced] = 0
    return out


def diagonal_blocks(A: Floats, first: int, shape: tuple[int, ...]) -> Floats:
    """View (k, d, d) of k diagonal blocks of `A`, from row `first` on; `shape` is (k, d, d).

    Faster than numpy's as_strided.
    """
    row, column = A.strides
    step = row + column
    return np.ndarray(shape, np.float64, A, first * step, (shape[1] * step, row, column))
