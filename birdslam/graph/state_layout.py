"""Layout of the window's state vector, and so of the rows and columns of its covariance P.

[ego in world (3) | ego nodes (3 each) | vehicles (3 of the pose, 3 of the twist, 2 of the lasting error of its edges)]
"""

from __future__ import annotations

import functools

import numpy as np

from birdslam.geometry.arrays import Floats

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
        # Jacobian of poses relative to the newest ego by its motion, without the lever arm of its turn: (first, 3) of
        # the ego poses, its own first, and (M, 8, 3) of the vehicles
        self.egos_against = -np.tile(np.eye(3), (1 + nodes, 1))
        self.egos_against[EGO] = np.eye(3)
        self.vehicles_against = np.zeros((vehicles, OF_VEHICLE, 3))
        self.vehicles_against[:, POSE] = -np.eye(3)
        self.vehicles_stay = np.tile(np.eye(OF_VEHICLE), (vehicles, 1, 1))  # (M, 8, 8) of stationary vehicles
        # Jacobian of the ego poses by a motion of the newest one, its own adjoint and the nodes' rotation: index of
        # each entry in (0, 1, cos, sin, -sin, and the lever arm of the turn, y and -x)
        self.ego_moves = np.zeros((first, first), dtype=np.int64)
        for i in range(0, first, 3):
            self.ego_moves[i : i + 3, i : i + 3] = (2, 4, 0), (3, 2, 0), (0, 0, 1)
        self.ego_moves[:2, 2] = 5, 6

    @staticmethod
    @functools.lru_cache(maxsize=64)
    def of(nodes: int, vehicles: int) -> StateLayout:
        """The cached layout for this number of vehicles; must not be modified."""
        return StateLayout(nodes, vehicles)

    @staticmethod
    def node(k: int) -> slice:
        """The rows of an ego node."""
        return slice(3 + 3 * k, 6 + 3 * k)


def diagonal_blocks(A: Floats, first: int, shape: tuple[int, ...]) -> Floats:
    """View (k, d, d) of k diagonal blocks of `A`, from row `first` on; `shape` is (k, d, d).

    Faster than numpy's as_strided.
    """
    row, column = A.strides
    step = row + column
    return np.ndarray(shape, np.float64, A, first * step, (shape[1] * step, row, column))
